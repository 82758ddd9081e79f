"""Shared parts of several commands: options, checks of their outputs, profiles, progress, printing, results.

An option that writes carries its `Kind` in its annotation, `Annotated[Path | None, typer.Option(...),
Kind.JSON]`. Every other file or folder that a command is given counts as an input.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column, Table
from rich.text import Text
from typer.models import OptionInfo

from hdbridge.errors import InputError
from hdbridge.files.atomic import is_stream, write_atomically
from hdbridge.files.outputs import Kind, Output, check_outputs, failures_deferred, writing
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.records.recording import Recording


class _Console(Console):
    """Console that discards its output once the reader has closed the pipe (`| head`)."""

    def on_broken_pipe(self) -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


console = _Console(highlight=False)
"""Tables, on standard output."""
notes = _Console(stderr=True, highlight=False)
"""Progress and remarks, on standard error, so that they stay out of a pipe."""


ProfileArgument = Annotated[
    str,
    typer.Argument(
        metavar="PROFILE",
        help="Folder with axis.yaml (and model.yaml), axis file, or bundled profile: article, demo.",
    ),
]
GatewayAxisOption = Annotated[
    str | None,
    typer.Option("--axis", help="Name of the axis; needed if the gateway has several.", show_default=False),
]
MachineArgument = Annotated[
    str,
    typer.Argument(
        metavar="MACHINE",
        help="Machine file, its folder, the profile of a single axis, or a bundled one: cell, article, demo.",
    ),
]
ModelOption = Annotated[
    Path | None, typer.Option("--model", metavar="MODEL.yaml", help="Model file; else the profile's own.")
]
SimulateOption = Annotated[
    bool, typer.Option("--simulate", help="Use a simulated drive in this process, faster than real time.")
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="TRUTH.yaml",
        help="Truth file of the simulated axis; else the profile's twin, or its truth file.",
    ),
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the simulated axis.")]
InterfaceOption = Annotated[
    str | None, typer.Option("--interface", help="python-can interface, instead of the axis file's.")
]
ChannelOption = Annotated[str | None, typer.Option("--channel", help="Channel, instead of the axis file's.")]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Send even if another master is heard on the bus or holds its lock.")
]
BorrowOption = Annotated[
    bool,
    typer.Option(
        "--borrow",
        help="Borrow the bus from the daemon that holds it: its axes are stopped and switched off until this "
        "command ends.",
    ),
]
BitrateOption = Annotated[
    int | None,
    typer.Option("--bitrate", min=10_000, max=1_000_000, help="Bit rate, if the interface sets it."),
]
NodeOption = Annotated[
    int | None, typer.Option("--node", min=1, max=127, help="Node id, if several drives answer.")
]
EdsOption = Annotated[Path | None, typer.Option("--eds", metavar="FILE", help="The drive's EDS file.")]
VelocityOption = Annotated[
    float | None,
    typer.Option("--velocity", min=1e-6, help="Speed of the load, deg/s; else the axis's limit."),
]
AccelerationOption = Annotated[
    float | None,
    typer.Option("--acceleration", min=1e-6, help="Acceleration of the load, deg/s2; else the axis's limit."),
]
AnglesArgument = Annotated[
    list[float], typer.Argument(metavar="ANGLE...", help="Load angles in degrees, one after the other.")
]
HomingMethodOption = Annotated[
    int, typer.Option("--method", min=-128, max=127, help="Homing method, 6098h: see the drive's manual.")
]
SwitchVelocityOption = Annotated[
    float | None,
    typer.Option(
        "--switch-velocity",
        min=1e-6,
        help="Speed towards the switch, deg/s of the load; else a tenth of the axis's limit.",
    ),
]
ZeroVelocityOption = Annotated[
    float | None,
    typer.Option(
        "--zero-velocity",
        min=1e-6,
        help="Speed towards the zero, deg/s of the load; else a fiftieth of the axis's limit.",
    ),
]
OffsetOption = Annotated[float, typer.Option("--offset", help="Load angle of the home position (607Ch).")]
HomingTimeoutOption = Annotated[
    float, typer.Option("--timeout", min=0.1, max=3600.0, help="Longest time, s.")
]
IndependentZerosOption = Annotated[
    bool, typer.Option("--independent-zeros", help="The encoders' zeros were lost between the records.")
]
ColumnsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--columns",
        metavar="CHANNEL=COLUMN,...",
        help="Columns of a CSV file by name or number: time, motor, load, target, load_torque, motor_torque, "
        "temperature.",
    ),
]
UnitsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--units",
        metavar="CHANNEL=UNIT,...",
        help="Units of the columns: motor=counts:65536,load=rad,time=ms; a minus sign reverses the "
        "direction.",
    ),
]
UnwrapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--unwrap",
        metavar="CHANNEL=PERIOD,...",
        help="Periods of counters that wrap, in the column's unit: motor=65536.",
    ),
]
JsonOption = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - is standard output."),
    Kind.JSON,
]
HtmlOption = Annotated[
    Path | None, typer.Option("--html", metavar="FILE", help="Write a self-contained HTML page."), Kind.PAGE
]

ObjectArgument = Annotated[
    str,
    typer.Argument(
        metavar="OBJECT", help="Its number (6064h, 0x1018:4, 60C2h:01; hexadecimal) or its name in the EDS."
    ),
]
ValueArgument = Annotated[
    str, typer.Argument(metavar="VALUE", help="Decimal or 0x...; text, or bytes in hexadecimal.")
]


STANDARD_OUTPUT = Path("/dev/stdout")


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a command so that it is refused if an output would destroy something; ``-`` is standard output.

    If a result goes to standard output, text for people goes to standard error. If a result cannot be written
    after all (a full disk), the command fails after everything has been printed.
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


def _options_of(command: Callable[..., Any]) -> Iterator[tuple[str, tuple[str, Kind | None]]]:
    """Yields for each parameter its option and the kind of its output, None if it writes nothing."""
    hints = get_type_hints(command, include_extras=True)
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


def _inputs(values: Iterable[Any]) -> Iterator[Path]:
    for value in values:
        if isinstance(value, list | tuple):
            yield from _inputs(value)
        elif isinstance(value, str | Path) and str(value):
            yield Path(value)


def taking(group: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command the fields of a dataclass as options; it receives them as its first argument.

    The dataclass's first field stands first, its other fields behind the command's own options.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        first, *behind = _parameters(group)

        @wraps(command)
        def with_options(**values: Any) -> None:
            given = group(**{each.name: values.pop(each.name) for each in (first, *behind)})
            command(given, **values)

        every = (first, *_parameters(command)[1:], *behind)
        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in every]
        with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_options.__annotations__ = {each.name: each.annotation for each in parameters}
        return with_options

    return decorate


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Returns the parameters with their annotations evaluated."""
    hints = get_type_hints(function, include_extras=True)
    given = inspect.signature(function).parameters.values()
    return [each.replace(annotation=hints[each.name]) for each in given]


def need_extra(subject: str, packages: Sequence[str], extra: str) -> None:
    """Raises `InputError` with the command that installs ``extra`` if one of its ``packages`` is missing."""
    if lacking := [name for name in packages if not _installed(name)]:
        raise InputError(f"{subject} {', '.join(lacking)}: python -m pip install 'hdbridge[{extra}]'")


def _installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # a parent package is missing
        return False


def load_recordings(
    paths: Sequence[Path],
    columns: list[str] | None = None,
    units: list[str] | None = None,
    unwrap: list[str] | None = None,
) -> dict[Path, Recording]:
    """Loads recordings and CSV files, by path; prints what was assumed about other programs' files."""
    from hdbridge.analysis.checks import check_once
    from hdbridge.records.recording import Recording

    loaded = [Recording.load(each, columns=columns, units=units, unwrap=unwrap) for each in paths]
    for each in loaded:
        if each.record.origin is not None and each.record.origin.remark:
            note(each.record.origin.remark)
    check_once(paths, [each.record for each in loaded])
    return dict(zip(paths, loaded, strict=True))


def model_file(text: str) -> Path:
    """Returns the model file that an option names, directly or through a profile with an active model.

    Raises `InputError` if there is neither, or if the profile has no model yet.
    """
    path = Path(text)
    if path.is_file() and path.name != "axis.yaml":
        return path
    try:
        files = Profile.find(text)
    except InputError as problem:
        raise InputError(f"{text}: no such model file, and no such profile: {problem}") from None
    if not files.axis.is_file():
        raise InputError(
            f"{text}: no such model file, and no profile; expected a model file, or a folder "
            "with an axis.yaml"
        )
    if not files.model.is_file():
        raise InputError(
            f"{files.folder}: there is no model.yaml; make one: hdbridge calibrate {files.folder}, and "
            f"commit it: hdbridge model commit {files.folder}; or fit one to a record: hdbridge fit RECORD "
            f"--axis {files.folder} --out model.yaml, and pass --model model.yaml"
        )
    return files.model


def compensating_model(files: Profile, profile: str, model: Path | None, otherwise: str = "") -> Path:
    """Returns the model file to compensate with: the given one, else the profile's.

    Raises `InputError` if there is none; ``otherwise`` is added as an alternative without a model.
    """
    if model is None and not files.model.exists():
        raise InputError(
            f"{files.model}: there is no model to compensate with; calibrate first: hdbridge calibrate "
            f"{profile}{otherwise}"
        )
    return model or files.model


def note_clamped(limits: Any, **wanted: float | None) -> None:
    """Reports each velocity or acceleration above the axis's limit, which is used instead.

    ``limits`` must have the attributes that are named: ``velocity_deg_s``, ``acceleration_deg_s2``.
    """
    for name, value in wanted.items():
        limit = getattr(limits, name)
        if value is not None and abs(value) > limit:
            kind, unit = ("velocity", "deg/s") if name == "velocity_deg_s" else ("acceleration", "deg/s2")
            note(
                f"{kind}: {abs(value):g} {unit} is above the axis's limit; {limit:g} {unit} is used "
                f"(limits.{name})"
            )


class _TimeColumn(ProgressColumn):
    """Remaining time of a running task, total time of a finished one."""

    def render(self, task: Task) -> Text:
        if task.finished or task.time_remaining is None:
            took = task.finished_time if task.finished else None
            return Text("" if took is None else f"{_clock(took)} taken")
        return Text(f"{_clock(task.time_remaining)} left")


def _clock(duration_s: float) -> str:
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes:d}:{seconds:02d}"


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yields a progress bar with the time left, on standard error; plain lines if that is not a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        _TimeColumn(),
    )
    with Progress(*columns, console=notes, refresh_per_second=4) as progress:
        yield progress


def print_table(table: Table) -> None:
    """Prints a table uncropped; always as one table into a pipe or a file."""
    for each in fitted(table):
        console.print(each, crop=False)


def fitted(table: Table) -> list[Table]:
    """Returns the table at its natural width; on a narrow terminal several, each with the first column.

    No figure is cut off.
    """
    first, *rest = table.columns
    parts: list[Table] = []
    widest = console.width if console.is_terminal else 10_000
    while rest or not parts:
        count = len(rest)
        while (width := _natural_width(part := _part(table, [first, *rest[:count]]))) > widest and count > 1:
            count -= 1
        part.width = min(width, widest)
        parts.append(part)
        rest = rest[count:]
    return parts


def _natural_width(table: Table) -> int:
    return Measurement.get(console, console.options.update(width=10_000), table).maximum


def _part(table: Table, columns: list[Column]) -> Table:
    """Returns the same rows with these columns only."""
    part = Table(title=table.title, title_justify=table.title_justify)
    for each in columns:
        part.add_column(each.header, justify=each.justify, overflow="fold")
    cells = zip(*(each.cells for each in columns), strict=True)
    for row, values in zip(table.rows, cells, strict=True):
        part.add_row(*values, end_section=row.end_section)
    return part


def figures_table(title: str, first: str, *figures: str) -> Table:
    """Returns an empty table with a title, a column of names, and right-aligned columns of figures."""
    table = Table(title=title, title_justify="left")
    table.add_column(first)
    for name in figures:
        table.add_column(name, justify="right")
    return table


def print_object(name: str, value: object, type_name: str) -> None:
    """Prints an object of a drive: a natural number also in hexadecimal."""
    whole = isinstance(value, int) and not isinstance(value, bool) and value >= 0
    also = f" ({value:#x})" if whole else ""
    say(f"{name}: {value}{also}  {type_name}")


def say(line: str, style: str | None = None) -> None:
    """Prints a line of the result, unwrapped and without markup."""
    console.print(line, markup=False, soft_wrap=True, style=style)


def note(line: str) -> None:
    """Prints a remark, unwrapped and without markup."""
    notes.print(line, markup=False, soft_wrap=True)


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Writes the JSON result if requested."""
    if path is not None:
        write_result(path, json.dumps(result, indent=2, allow_nan=False) + "\n")


def write_result(path: Path, text: str) -> None:
    """Writes a result file; a failure is reported after everything has been printed."""
    with writing():
        write_atomically(path, text)
        if not is_stream(path):
            note(f"wrote {path}")
