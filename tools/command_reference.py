"""Writes docs/commands.md from the command line itself; `--check` only compares.

python tools/command_reference.py
"""

from __future__ import annotations

import inspect
import re
import shlex
import sys
import typing
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

import generated
from typer.models import ArgumentInfo, OptionInfo

from hdbridge.cli import PANELS, load

PAGE = generated.DOCS / "commands.md"

_INTRODUCTION = """# Commands

Every command, option and exit status; `hdbridge COMMAND --help` adds the ranges.

Results go to standard output, progress and remarks to standard error. A result replaces only a result of its
kind, never an input or a file of a profile or a recording; a folder for measurements is new or empty. A
proposed model is `PROFILE/pending.yaml` until `hdbridge model commit`.

Options before the command: `-v` logs the bus traffic to standard error (`-vv`: every SDO transfer), `--log
FILE` appends the log as JSON lines (`date`, `level`, `where`, `event`, facts), `--install-completion`,
`--version`.

**Ctrl-C** (SIGTERM, SIGQUIT, SIGHUP) stops the axis from the next period on, and keeps what was measured. The
third one ends the program at once.

**Exit status**

- 0: done
- 1: an error in hdbridge itself
- 2: bad input; nothing was written, nothing moved
- 3: the bus cannot be opened, or went away
- 4: the drive is absent, refuses, is not the one expected, or reports a fault
- 5: the supervision stopped the axis while it moved
- 6: a result could not be written, for example to a full disk; it is printed
- 7: the daemon was not reached, or refused; nothing moved
- 130: Ctrl-C; the axis was stopped, the record kept

## Arguments and options of several commands

The commands below list these without a description.

"""

_COMMON = 2
"""Number of commands from which an option that they share is described only once."""

_MANY = 4
"""Number of commands in a group from which the options that all of them share are not listed for each."""

_SETS = {
    "*axis*": ("--interface", "--channel", "--force", "--borrow", "--simulate", "--truth", "--seed"),
    "*CSV*": ("--columns", "--units", "--unwrap"),
    "*homing*": (
        *("--method", "--switch-velocity", "--zero-velocity", "--acceleration", "--offset", "--timeout"),
    ),
    "*fleet*": (
        *("--out", "--manifest", "--model", "--models", "--scheduler", "--workers", "--memory", "--limit"),
        *("--pages", "--timeout"),
    ),
}
"""Sets of options that many commands share, by the name of the set."""

_VALUES = {int: "INTEGER", float: "NUMBER", str: "TEXT", Path: "FILE"}


@dataclass(frozen=True)
class Parameter:
    """Argument or option of a command."""

    names: tuple[str, ...]
    """Names of an option, with dashes; for an argument, its placeholder."""
    value: str
    """Placeholder of the option's value; empty for a switch."""
    help: str
    default: str
    is_option: bool
    required: bool
    many: bool


@dataclass(frozen=True)
class Command:
    """Command with its name as typed by a user, its help text and its parameters."""

    name: str
    text: str
    parameters: tuple[Parameter, ...]

    @property
    def usage(self) -> str:
        """Heading of the command's section: name and arguments."""
        words = ["hdbridge", self.name]
        for each in self.parameters:
            if not each.is_option:
                word = each.names[0] + ("..." if each.many else "")
                words.append(word if each.required else f"[{word}]")
        return " ".join(words)


def commands() -> Iterator[Command]:
    """Yields all commands in the order of the overview; those of a group have its name as a prefix."""
    for panel in PANELS.values():
        for name in panel:
            loaded = load(name)
            for registered in loaded.registered_commands:
                yield _command("", registered)
            for group in loaded.registered_groups:
                assert group.typer_instance is not None
                for registered in group.typer_instance.registered_commands:
                    if not registered.hidden:
                        yield _command(f"{name} ", registered)


def page() -> str:
    """Returns the whole page."""
    known = list(commands())
    users: dict[Parameter, list[str]] = {}
    for command in known:
        for each in command.parameters:
            users.setdefault(each, []).append(command.name)
    common = {each: names for each, names in users.items() if len(names) >= _COMMON}
    names = Counter(each.names[0] for each in users)
    shared = sorted(common.items(), key=lambda item: (item[0].is_option, item[0].names[0].lstrip("-")))
    sets = "; ".join(f"{name}: `{'`, `'.join(options)}`" for name, options in _SETS.items())
    parts = [
        _INTRODUCTION
        + "\n".join(_common_item(*each, names) for each in shared)
        + f"\n\nEvery `ctl` command has `--at`, every `model` command `--twin`. Sets of options: {sets}.\n"
    ]
    for panel, members in PANELS.items():
        parts.append(f"## {panel}\n")
        for name in members:
            group = [each for each in known if each.name.split()[0] == name]
            general = frozenset.intersection(*(frozenset(each.parameters) for each in group))
            general = general if len(group) >= _MANY else frozenset()
            parts += (_section(each, common, general) for each in group)
    return "\n".join(parts)


def _section(command: Command, common: Container[Parameter], general: Container[Parameter]) -> str:
    """Returns the section of a command, without the ``general`` options of its group."""
    lines = [f"### `{command.usage}`", "", command.text, ""]
    own = [_item(each) for each in command.parameters if each not in common]
    shared = [
        each.names[0]
        for each in command.parameters
        if each in common and each not in general and each.is_option
    ]
    also = [name for name, members in _SETS.items() if set(members) <= set(shared)]
    in_sets = {each for name in also for each in _SETS[name]}
    ending = " options" if also else ""
    also = [*(f"`{each}`" for each in shared if each not in in_sets), *also]
    if also:
        own.append(f"- {', '.join(also)}{ending}")
    return "\n".join([*lines, *own]) + ("\n" if own else "")


def _common_item(parameter: Parameter, names: list[str], meanings: Mapping[str, int]) -> str:
    """Returns the item of a shared option, with its commands if others give it a different meaning."""
    groups = {name.split()[0] for name in names}
    if meanings[parameter.names[0]] == 1:
        owner = ""
    elif len(groups) == 1:
        owner = f" of `{groups.pop()}`"
    else:
        owner = f" of `{'`, `'.join(names)}`" if len(names) < _MANY else ""
    return _item(parameter, owner)


def _item(parameter: Parameter, owner: str = "") -> str:
    """Returns an option or argument as an item of a list."""
    value = f" {parameter.value}" if parameter.value else ""
    names = ", ".join(f"`{name}{value}`" for name in parameter.names)
    names = names if parameter.is_option or parameter.required else f"`[{parameter.names[0]}]`"
    default = f" ({parameter.default})" if parameter.default.strip("`") else ""
    return f"- {names}{owner}{default}: {parameter.help}"


def _command(prefix: str, registered: Any) -> Command:
    function: Callable[..., Any] = registered.callback
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = tuple(
        _parameter(name, hints[name], each.default)
        for name, each in inspect.signature(function).parameters.items()
    )
    # Arguments come first, as typed.
    ordered = sorted(parameters, key=lambda each: each.is_option)
    text = inspect.cleandoc(function.__doc__ or "")
    return Command(prefix + (registered.name or function.__name__), text, tuple(ordered))


def _parameter(name: str, hint: Any, default: Any) -> Parameter:
    kind, info = typing.get_args(hint)[:2]
    kind, many = _plain(kind)
    required = default is inspect.Parameter.empty
    shown = "" if required or default is None or default is False else f"`{_text(default)}`"
    if isinstance(info, ArgumentInfo):
        label = (info.metavar or name.upper()).removesuffix("...")
        return Parameter((label,), "", info.help or "", shown, False, required, many)
    assert isinstance(info, OptionInfo)
    # In an Annotated hint the first name is stored in place of the default.
    declared = (*((info.default,) if isinstance(info.default, str) else ()), *(info.param_decls or ()))
    names = tuple(part for each in declared for part in each.split("/"))
    if not names:
        names = (f"--{name.replace('_', '-')}",)
        names += (f"--no-{name.replace('_', '-')}",) if kind is bool else ()
    value = "" if kind is bool else info.metavar or _value(kind)
    shown = "" if kind is bool else shown
    if kind is bool and default is True:
        shown = f"`{names[0]}`"
    return Parameter(names, value, info.help or "", shown, True, required, many)


def _plain(kind: Any) -> tuple[Any, bool]:
    """Returns the type without None and without an enclosing list, and True if there was a list."""
    if isinstance(kind, UnionType) or typing.get_origin(kind) is typing.Union:
        (kind,) = (each for each in typing.get_args(kind) if each is not NoneType)
    if typing.get_origin(kind) is list:
        return typing.get_args(kind)[0], True
    return kind, False


def _value(kind: Any) -> str:
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "|".join(str(each.value) for each in kind)
    return _VALUES[kind]


def _text(default: Any) -> str:
    if isinstance(default, Enum):
        return str(default.value)
    return f"{default:g}" if isinstance(default, float) else str(default)


def refused(line: str) -> str | None:
    """Returns the reason why a command line in the docs is invalid; None if it is valid.

    Values may be placeholders; of an option, only its existence and the presence of a value are checked.
    """
    words = shlex.split(re.sub(r"\s+(#|>|&|\|).*$", "", line.strip()))[1:]
    known = {each.name: each for each in commands()}
    name = next((text for text in (" ".join(words[:2]), words[0] if words else "") if text in known), None)
    if name is None:
        return None if words and words[0] in {"--version", "--help"} else f"no command: {line}"
    command = known[name]
    options = {name: each for each in command.parameters if each.is_option for name in each.names}
    rest, given = words[len(name.split()) :], 0
    while rest:
        word = rest.pop(0)
        if word in {"--help", "-h"}:
            return None
        if not word.startswith("-") or re.fullmatch(r"-\d+(\.\d+)?", word):
            given += 1
        elif word not in options:
            return f"no option {word}: {line}"
        elif options[word].value:
            if not rest:
                return f"no value for {word}: {line}"
            rest.pop(0)
    arguments = [each for each in command.parameters if not each.is_option]
    if given < sum(each.required for each in arguments):
        return f"an argument is missing: {line}"
    if given > len(arguments) and not any(each.many for each in arguments):
        return f"too many arguments: {line}"
    return None


if __name__ == "__main__":
    sys.exit(generated.main({PAGE: page()}))
