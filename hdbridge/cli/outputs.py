"""Outputs of every command: declared by their options, checked in one place before the command runs.

An option that writes carries its `Kind` in its annotation, `Annotated[Path | None, typer.Option(...),
Kind.JSON]`. Every other file or folder that a command is given counts as an input.
"""

import functools
import inspect
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from typer.models import OptionInfo

from hdbridge.cli.options import console, note
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind, Output, check_outputs, failures_deferred

STANDARD_OUTPUT = Path("/dev/stdout")


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a command so that it is refused if an output would destroy something; ``-`` is standard output.

    If a result goes to standard output, text for people goes to standard error. If a result cannot be written
    after all (a full disk), the command fails after everything has been printed.
    """
    options = dict(_options(command))
    declared = {name: (option, kind) for name, (option, kind) in options.items() if kind is not None}

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
        _check_truths(values.get("truth"))
        check_outputs(outputs, _inputs(value for name, value in values.items() if name not in declared))
        before = console.stderr
        console.stderr = before or any(each.path == STANDARD_OUTPUT for each in outputs)
        try:
            with failures_deferred() as failed:
                try:
                    with _naming(options):
                        done = command(**values)
                except BaseException:
                    for each in failed:
                        note(str(each))
                    raise
        finally:
            console.stderr = before
        for each in failed[1:]:
            note(str(each))
        if failed:
            raise failed[0]
        return done

    return checked


def _check_truths(given: Path | list[Path] | None) -> None:
    """Loads the truth files, so that a wrong one is refused before folders are made for results."""
    if given:
        from hdbridge.sim.truth import Truth

        for each in given if isinstance(given, list) else [given]:
            Truth.load(each)


@contextmanager
def _naming(options: Mapping[str, tuple[str, Kind | None]]) -> Iterator[None]:
    """Replaces the parameter name in an error of the library by the option that the user typed."""
    try:
        yield
    except InputError as problem:
        name, colon, rest = str(problem).partition(": ")
        if not colon or name not in options:
            raise
        raise InputError(f"{options[name][0]}: {rest}") from problem


def _options(command: Callable[..., Any]) -> Iterator[tuple[str, tuple[str, Kind | None]]]:
    """Yields for each parameter its option and the kind of its output, None if it writes nothing."""
    hints = typing.get_type_hints(command, include_extras=True)
    for name in inspect.signature(command).parameters:
        metadata = getattr(hints[name], "__metadata__", ())
        kinds = (each for each in metadata if isinstance(each, Kind))
        yield name, (_option(name, metadata), next(kinds, None))


def _option(name: str, metadata: tuple[Any, ...]) -> str:
    for info in metadata:
        if isinstance(info, OptionInfo):
            # In an Annotated hint the first name is stored in place of the default.
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
