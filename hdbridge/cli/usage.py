"""Rejected command lines, reported in the one-line form of all hdbridge errors."""

import errno
import math
import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from hdbridge.errors import InputError

UsageError: Any = typer.BadParameter.__mro__[1]
"""Error class of an invalid command line. typer takes it from click or defines its own, and exports only a
subclass."""
_PLACES = ("PROFILE", "MACHINE")
"""Metavars of the parameters that take a path or the name of a bundled profile."""
_UNDECODED = re.compile("[\ud800-\udfff]")
"""Bytes of the command line outside the encoding of the locale."""
_KINDS = {"int": "an integer", "float": "a number", "bool": "true or false"}


def refusal(error: Any) -> str:
    """Returns one line with the option, its value, the expected value, and where to find all options."""
    from hdbridge.files.expectation import one_line

    context = getattr(error, "ctx", None)
    line = _about_value(error) or _about_line(error)
    path = getattr(context, "command_path", "hdbridge")
    return one_line(f"{line}; see {path} --help")


def strict(command: Any) -> Any:
    """Makes a command refuse values that typer accepts: empty or undecodable texts, infinity, wrong paths.

    The values are checked before the command runs and before its outputs are checked. An invalid one raises
    a one-line `InputError`.
    """
    for each in getattr(command, "commands", {}).values():
        strict(each)
    for each in command.params:
        each.process_value = partial(_checked, each, each.process_value)
    return command


def _checked(param: Any, convert: Callable[[Any, Any], Any], context: Any, value: Any) -> Any:
    """Converts and checks the value of an option or argument."""
    given = list(value) if isinstance(value, list | tuple) else [value]
    if "" in given and param.default != "":
        raise _wrong(param, context, "", "a text that is not empty")
    for each in given:
        if isinstance(each, str) and _UNDECODED.search(each):
            raise _wrong(param, context, each, "a text in the encoding of this locale (see LC_ALL)")
    converted = convert(context, value)
    for each in converted if isinstance(converted, list | tuple) else [converted]:
        if isinstance(each, float) and not math.isfinite(each):
            limits = getattr(param, "type", param)
            limits = _range(getattr(limits, "min", None), getattr(limits, "max", None))
            raise _wrong(param, context, each, f"a finite number{limits}")
        if isinstance(each, Path) or (isinstance(each, str) and param.metavar in _PLACES):
            try:
                os.stat(each)  # noqa: PTH116 - called for its errors
            except OSError as problem:
                if problem.errno not in {errno.ENOENT, errno.ENOTDIR, errno.EACCES}:
                    raise _wrong(param, context, each, f"a path ({problem.strerror})") from None
    return converted


def _wrong(param: Any, context: Any, found: object, expected: str) -> InputError:
    from hdbridge.files.expectation import one_line

    line = f"{_name(param)}: found {str(found)!r}; expected {expected}"
    return InputError(one_line(f"{line}; see {getattr(context, 'command_path', 'hdbridge')} --help"))


def asks_for_help(error: Any) -> bool:
    """Returns True if only a command is missing, in which case the error's text is the help."""
    return type(error).__name__ == "NoArgsIsHelpError"


def _about_value(error: Any) -> str | None:
    """Describes an invalid option value with the expected one, as for a file; None for other errors."""
    param, cause = getattr(error, "param", None), error.__cause__
    if param is None or not hasattr(cause, "errors"):
        return None
    from hdbridge.files.expectation import nearest

    first = cause.errors()[0]
    found, kind = first["input"], str(first["type"]).split("_")[0]
    choices = re.findall(r"'([^']*)'", str(first["msg"]).partition("not one of")[2])
    if choices:
        close = nearest(str(found), choices)
        expected = " or ".join(choices) + (f" (did you mean {close}?)" if close else "")
    else:
        expected = _KINDS.get(kind) or ("an integer" if isinstance(found, int) else "a number")
        expected += _range(getattr(param, "min", None), getattr(param, "max", None))
    return f"{_name(param)}: found {str(found)!r}; expected {expected}"


def _about_line(error: Any) -> str:
    """Describes an invalid command line, for example with an unknown option or a missing argument."""
    from hdbridge.files.expectation import nearest

    message = str(error.format_message()).strip().rstrip(".")
    option = getattr(error, "option_name", None)
    possible = getattr(error, "possibilities", None)
    if option is not None and "requires" in message:
        return f"{option}: a value is missing"
    if option is not None:
        close = nearest(option, possible) if possible else None
        return f"{option}: no such option" + (f" (did you mean {close}?)" if close else "")
    if message.startswith("Missing"):
        param = getattr(error, "param", None)
        return f"{_name(param)}: is missing" if param is not None else message
    extra = re.search(r"extra arguments?(?:\(s\))? \((.*)\)", message)
    if extra:
        return f"{extra[1]!r}: expected no further argument"
    unknown = re.match(r"No such command ('.*?')\.?(?: Did you mean (.*)\?)?$", message)
    if unknown:
        return f"{unknown[1]}: no such command" + (f" (did you mean {unknown[2]}?)" if unknown[2] else "")
    return message


def _name(param: Any) -> str:
    """Returns the name of a parameter as the user types it: --count, PROFILE."""
    if param.param_type_name == "option":
        return str(max(param.opts, key=len))
    return str(param.metavar or param.name.upper()).removesuffix("...").strip("[]{}")


def _range(low: float | None, high: float | None) -> str:
    if low is not None and high is not None:
        return f" from {low:.10g} to {high:.10g}"
    if low is not None:
        return f" of at least {low:.10g}"
    return "" if high is None else f" of at most {high:.10g}"
