"""The outputs of every command: declared by their options, checked in one place before the command runs.

An option that writes carries its `Kind` in its annotation, `Annotated[Path | None, typer.Option(...),
Kind.JSON]`. Whatever else a command is given that names a file or folder counts as an input.
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from typer.models import OptionInfo

from hdbridge.cli.options import console, notes
from hdbridge.files.outputs import Kind, Output, check_outputs, failures_deferred

STANDARD_OUTPUT = Path("/dev/stdout")


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command, refused where an output would destroy something; ``-`` is the standard output.

    Where a result goes to the standard output, what is printed for a person goes to the standard error. A
    result that cannot be written after all (a full disk) ends the command when everything is printed.
    """
    declared = dict(_declared(command))

    @functools.wraps(command)
    def checked(**values: Any) -> Any:
        for name, (_, kind) in declared.items():
            if values[name] == Path("-") and kind is not Kind.FOLDER:
                values[name] = STANDARD_OUTPUT
        outputs = [
            Output(option, values[name], kind)
            for name, (option, kind) in declared.items()
            if values[name] is not None
        ]
        check_outputs(outputs, _inputs(value for name, value in values.items() if name not in declared))
        before = console.stderr
        console.stderr = before or any(each.path == STANDARD_OUTPUT for each in outputs)
        try:
            with failures_deferred() as failed:
                try:
                    done = command(**values)
                except BaseException:
                    for each in failed:
                        notes.print(str(each), markup=False, soft_wrap=True)
                    raise
        finally:
            console.stderr = before
        for each in failed[1:]:
            notes.print(str(each), markup=False, soft_wrap=True)
        if failed:
            raise failed[0]
        return done

    return checked


def _declared(command: Callable[..., Any]) -> Iterator[tuple[str, tuple[str, Kind]]]:
    """By parameter: the option that a person types, and what it writes."""
    hints = typing.get_type_hints(command, include_extras=True)
    for name in inspect.signature(command).parameters:
        metadata = getattr(hints[name], "__metadata__", ())
        for kind in metadata:
            if isinstance(kind, Kind):
                yield name, (_option(name, metadata), kind)


def _option(name: str, metadata: tuple[Any, ...]) -> str:
    for info in metadata:
        if isinstance(info, OptionInfo):
            # In an Annotated hint the first name stands where else a default would.
            for each in (info.default, *(info.param_decls or ())):
                if isinstance(each, str) and each.startswith("--"):
                    return each
    return f"--{name.replace('_', '-')}"


def _inputs(values: typing.Iterable[Any]) -> Iterator[Path]:
    for value in values:
        if isinstance(value, list | tuple):
            yield from _inputs(value)
        elif isinstance(value, str | Path) and str(value):
            yield Path(value)
