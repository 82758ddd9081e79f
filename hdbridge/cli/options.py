"""Options shared by commands, and the checks of a command's outputs before it runs.

An option for an output has its `Kind` in its annotation, `Annotated[Path | None, Option(...), Kind.JSON]`.
Every other file or folder given to a command counts as an input.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from typer import Argument, Option
from typer.models import ArgumentInfo, OptionInfo

from hdbridge.cli.printing import console, note
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind, Output, check_outputs, failures_deferred

if TYPE_CHECKING:
    from hdbridge.records.recording import Recording

Profile = Annotated[
    str,
    Argument(
        metavar="PROFILE",
        help="Folder with axis.yaml (and model.yaml), axis file, or bundled profile: article, demo.",
    ),
]
Machine = Annotated[
    str,
    Argument(
        metavar="MACHINE",
        help="Machine file, its folder, the profile of a single axis, or a bundled one: cell, article, demo.",
    ),
]
GatewayAxis = Annotated[
    str | None,
    Option("--axis", help="Name of the axis; needed if the gateway has several.", show_default=False),
]
Model = Annotated[
    Path | None, Option("--model", metavar="MODEL.yaml", help="Model file; else the profile's own.")
]
Simulate = Annotated[
    bool, Option("--simulate", help="Use a simulated drive in this process, faster than real time.")
]
Truth = Annotated[
    Path | None,
    Option(
        "--truth",
        metavar="TRUTH.yaml",
        help="Truth file of the simulated axis; else the profile's twin, or its truth file.",
    ),
]
Seed = Annotated[int, Option("--seed", help="Seed of the simulated axis.")]
Interface = Annotated[
    str | None, Option("--interface", help="python-can interface, instead of the axis file's.")
]
Channel = Annotated[str | None, Option("--channel", help="Channel, instead of the axis file's.")]
Force = Annotated[
    bool, Option("--force", help="Send even if another master is heard on the bus or holds its lock.")
]
Borrow = Annotated[
    bool,
    Option(
        "--borrow",
        help="Borrow the bus from the daemon that holds it: its axes are stopped and switched off until this "
        "command ends.",
    ),
]
Bitrate = Annotated[
    int | None, Option("--bitrate", min=10_000, max=1_000_000, help="Bit rate, if the interface sets it.")
]
Node = Annotated[int | None, Option("--node", min=1, max=127, help="Node id, if several drives answer.")]
Eds = Annotated[Path | None, Option("--eds", metavar="FILE", help="The drive's EDS file.")]
Velocity = Annotated[
    float | None, Option("--velocity", min=1e-6, help="Speed of the load, deg/s; else the axis's limit.")
]
Acceleration = Annotated[
    float | None,
    Option("--acceleration", min=1e-6, help="Acceleration of the load, deg/s2; else the axis's limit."),
]
Angles = Annotated[
    list[float], Argument(metavar="ANGLE...", help="Load angles in degrees, one after the other.")
]
IndependentZeros = Annotated[
    bool, Option("--independent-zeros", help="The encoders' zeros were lost between the records.")
]
Json = Annotated[
    Path | None,
    Option("--json", metavar="FILE", help="Write the result as JSON; - is standard output."),
    Kind.JSON,
]
Html = Annotated[
    Path | None, Option("--html", metavar="FILE", help="Write a self-contained HTML page."), Kind.PAGE
]
Object = Annotated[
    str,
    Argument(
        metavar="OBJECT", help="Its number (6064h, 0x1018:4, 60C2h:01; hexadecimal) or its name in the EDS."
    ),
]
Value = Annotated[str, Argument(metavar="VALUE", help="Decimal or 0x...; text, or bytes in hexadecimal.")]


@dataclass(frozen=True)
class Homing:
    """Options of a homing run, as parameters of `hdbridge.drive.drive.Drive.home`."""

    method: Annotated[
        int, Option("--method", min=-128, max=127, help="Homing method, 6098h: see the manual.")
    ]
    switch_velocity_deg_s: Annotated[
        float | None,
        Option(
            "--switch-velocity",
            min=1e-6,
            help="Speed towards the switch, deg/s of the load; else a tenth of the axis's limit.",
        ),
    ] = None
    zero_velocity_deg_s: Annotated[
        float | None,
        Option(
            "--zero-velocity",
            min=1e-6,
            help="Speed towards the zero, deg/s of the load; else a fiftieth of the axis's limit.",
        ),
    ] = None
    acceleration_deg_s2: Acceleration = None
    offset_deg: Annotated[float, Option("--offset", help="Load angle of the home position (607Ch).")] = 0.0
    timeout_s: Annotated[float, Option("--timeout", min=0.1, max=3600.0, help="Time-out, s.")] = 60.0


@dataclass(frozen=True)
class CsvFormat:
    """Options that describe CSV files of other programs."""

    columns: Annotated[
        list[str] | None,
        Option(
            "--columns",
            metavar="CHANNEL=COLUMN,...",
            help="Columns of a CSV file by name or number: time, motor, load, target, load_torque, "
            "motor_torque, temperature.",
        ),
    ] = None
    units: Annotated[
        list[str] | None,
        Option(
            "--units",
            metavar="CHANNEL=UNIT,...",
            help="Units of the columns: motor=counts:65536,load=rad,time=ms; a minus sign reverses the "
            "direction.",
        ),
    ] = None
    unwrap: Annotated[
        list[str] | None,
        Option(
            "--unwrap",
            metavar="CHANNEL=PERIOD,...",
            help="Periods of counters that wrap, in the column's unit: motor=65536.",
        ),
    ] = None

    def load(self, paths: Sequence[Path]) -> dict[Path, Recording]:
        """Loads recordings and CSV files by path; prints the assumptions about other programs' files."""
        from hdbridge.analysis.checks import check_once
        from hdbridge.records.recording import Recording

        loaded = {path: Recording.load(path, **vars(self)) for path in paths}
        for each in loaded.values():
            if each.record.origin is not None and each.record.origin.remark:
                note(each.record.origin.remark)
        check_once(paths, [loaded[path].record for path in paths])
        return loaded


def taking(*groups: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Adds the fields of dataclasses to a command as options; the command receives these as its first
    arguments.

    The arguments of the groups come first; their options follow those of the command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        fields = [_parameters(group) for group in groups]
        every = [each for group in fields for each in group]
        first = [each for each in every if any(isinstance(one, ArgumentInfo) for one in _metadata(each))]

        @wraps(command)
        def with_options(**values: Any) -> None:
            given = [
                group(**{each.name: values.pop(each.name) for each in own})
                for group, own in zip(groups, fields, strict=True)
            ]
            command(*given, **values)

        behind = [each for each in every if each not in first]
        parameters = [
            each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for each in (*first, *_parameters(command)[len(groups) :], *behind)
        ]
        with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_options.__annotations__ = {each.name: each.annotation for each in parameters}
        return with_options

    return decorate


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Returns the parameters of a function, with evaluated annotations."""
    hints = get_type_hints(function, include_extras=True)
    given = inspect.signature(function).parameters.values()
    return [each.replace(annotation=hints[each.name]) for each in given]


def _metadata(parameter: inspect.Parameter) -> tuple[Any, ...]:
    return getattr(parameter.annotation, "__metadata__", ())


def need_extra(subject: str, packages: Sequence[str], extra: str) -> None:
    """Raises `InputError` with the command that installs ``extra`` if one of its ``packages`` is missing."""
    if lacking := [name for name in packages if not _installed(name)]:
        raise InputError(
            f"{subject} {', '.join(lacking)}; install with: python -m pip install 'hdbridge[{extra}]'"
        )


def _installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # a parent package is missing
        return False


# ---------------------------------------------------------------- outputs

STANDARD_OUTPUT = Path("/dev/stdout")


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a command so that it is refused if an output would destroy something; ``-`` is standard output.

    If a result goes to standard output, text for people goes to standard error. If writing a result fails
    nevertheless (full disk), the command fails after everything has been printed.
    """
    options = dict(_options_of(command))
    declared = {name: (option, kind) for name, (option, kind) in options.items() if kind is not None}

    @wraps(command)
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
    """Loads the truth files, so that a wrong file is refused before folders for results are created."""
    if given:
        from hdbridge.sim.truth import Truth

        for each in given if isinstance(given, list) else [given]:
            Truth.load(each)


@contextmanager
def _naming(options: Mapping[str, tuple[str, Kind | None]]) -> Iterator[None]:
    """Replaces the parameter name in an error of the library with the option of the command line."""
    try:
        yield
    except InputError as problem:
        name, colon, rest = str(problem).partition(": ")
        if not colon or name not in options:
            raise
        raise InputError(f"{options[name][0]}: {rest}") from problem


def _options_of(command: Callable[..., Any]) -> Iterator[tuple[str, tuple[str, Kind | None]]]:
    """Yields each parameter with its option and the kind of its output, or None if it is no output."""
    for parameter in _parameters(command):
        metadata = _metadata(parameter)
        kinds = (each for each in metadata if isinstance(each, Kind))
        yield parameter.name, (_option(parameter.name, metadata), next(kinds, None))


def _option(name: str, metadata: tuple[Any, ...]) -> str:
    """Returns the name of a parameter on the command line: its option, or the placeholder of an argument."""
    for info in metadata:
        if isinstance(info, ArgumentInfo):
            return str(info.metavar or name.upper())
        if isinstance(info, OptionInfo):
            # In an Annotated hint the first name is stored in place of the default.
            for each in (info.default, *(info.param_decls or ())):
                if isinstance(each, str) and each.startswith("--"):
                    return each
    return f"--{name.replace('_', '-')}"


def _inputs(values: Iterable[Any]) -> Iterator[Path]:
    for value in values:
        if isinstance(value, list | tuple):
            yield from _inputs(value)
        elif isinstance(value, str | Path) and str(value):
            yield Path(value)
