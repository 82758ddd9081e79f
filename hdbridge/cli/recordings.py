"""``hdbridge record``: records from the daemon's flight recordings and from bus logs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import need_extra, taking
from hdbridge.cli.printing import note, print_table, say, write_json, write_result
from hdbridge.errors import InputError
from hdbridge.files.atomic import check_writable
from hdbridge.files.outputs import Kind
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.daemon.recorder.flightfile import ModelUse
    from hdbridge.daemon.recorder.reading import Flight
    from hdbridge.records.recording import Recording


_EXTRA = ("mcap", "google.protobuf")
_NS = 10**9

FlightsArgument = Annotated[
    list[Path], Argument(metavar="FILE.mcap|FOLDER...", help="Flight recordings, or folders of them.")
]


@dataclass(frozen=True)
class Part:
    """Options that select one axis and a period of flight recordings."""

    axis: Annotated[
        str | None,
        Option("--axis", metavar="NAME", help="Axis of the flight recordings; needed if they have several."),
    ] = None
    begin: Annotated[
        str | None,
        Option("--from", metavar="TIME", help="Start of the flight, ISO 8601; UTC without an offset."),
    ] = None
    end: Annotated[
        str | None, Option("--to", metavar="TIME", help="End of the flight, ISO 8601; UTC without an offset.")
    ] = None

    def read(self, paths: Sequence[Path], *, all_states: bool = False) -> tuple[Recording, ModelUse | None]:
        """Reads MCAP files and folders of them; returns the recording and the model last used, or None.

        Raises `InputError` if the axis or the period is not in the recordings.
        """
        need_reader()
        from hdbridge.daemon.recorder.export import axis_of, exported, last_model
        from hdbridge.daemon.recorder.reading import each_flight, overview, read

        begin_ns, end_ns = _time_ns(self.begin, "--from"), _time_ns(self.end, "--to")

        def wanted(path: Path) -> Flight | None:
            about = overview(path)
            if (begin_ns is not None and about.last_ns < begin_ns) or (
                end_ns is not None and about.first_ns > end_ns
            ):
                return None
            return read(about.path, (axis_of(about.about, self.axis, path).name,))

        found = [each for each in each_flight(paths, wanted) if each is not None]
        if not found:
            raise InputError(f"{paths[0]}: nothing was recorded between --from and --to")
        found.sort(key=lambda each: each.first_ns)
        recording = exported(found, self.axis, all_states=all_states, start_ns=begin_ns, end_ns=end_ns)
        assert recording.axis is not None
        return recording, last_model(found, recording.axis)


@dataclass(frozen=True)
class Export:
    """Options of a command that creates a record."""

    out: Annotated[
        Path | None,
        Option(
            "--out",
            metavar="FOLDER|FILE.csv",
            help="New or empty folder of a recording, or a file .csv or .csv.gz.",
        ),
    ] = None
    all_states: Annotated[
        bool, Option("--all-states", help="Include samples in which the axis was not enabled.")
    ] = False

    def checked(self) -> Path:
        """Returns ``--out``; raises `InputError` unless a new record can be written there."""
        out = self.out
        if out is None:
            raise InputError("--out is missing; name a new folder, or a file that ends in .csv or .csv.gz")
        if _is_csv(out):
            check_writable(out)
            if out.exists():
                raise InputError(
                    f"{out}: already exists; expected a new file: raw data are never overwritten"
                )
        elif out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: is not an empty folder; expected a new or an empty one")
        return out


def is_flight(path: Path) -> bool:
    """Returns True for an MCAP file, and for a folder with MCAP files that is not a recording."""
    if path.is_dir():
        return not (path / "recording.yaml").exists() and next(path.rglob("*.mcap*"), None) is not None
    return path.name.endswith((".mcap", ".mcap.part"))


def remarks(recording: Recording) -> Iterator[str]:
    """Yields remarks on a recording made of flight recordings or a bus log."""
    about = recording.notes
    if count := about.get("cycles_missing_within_parts"):
        yield f"{count} cycles are missing within parts; the time stamps account for them"
    if count := about.get("parts_too_short"):
        yield f"{count} parts were too short and are left out"
    if about.get("zeros_may_differ"):
        yield (
            "the drive was booted or homed in between: if its encoders lost their zeros, pass "
            "--independent-zeros to fit and diagnose"
        )


def need_reader() -> None:
    """Raises `InputError` if a package for reading flight recordings is not installed."""
    need_extra("flight recordings need", _EXTRA, "daemon")


def _time_ns(text: str | None, option: str) -> int | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{option}: found '{text}'; expected a time such as 2026-03-01T12:30:00") from None
    return round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * _NS)


def overviews(flights: FlightsArgument, json_file: opt.Json = None) -> None:
    """List recordings: period, size, and stops in them."""
    need_reader()
    from hdbridge.daemon.recorder.reading import each_flight, overview

    found = list(each_flight(flights, overview))
    write_json(json_file, {"schema": "hdbridge.flights/1", "flights": [_overview(each) for each in found]})
    rows = []
    for each in found:
        stops = [event for event in each.events if event.kind in {"STOPPED", "BUS_DOWN", "MARK"}]
        rows.append(
            (
                each.path.name + ("" if each.finished else " (not finished)"),
                f"{_date(each.first_ns):%Y-%m-%d %H:%M:%S}",
                f"{(each.last_ns - each.first_ns) / _NS:,.0f} s",
                f"{each.size / 1e6:.1f}",
                "; ".join(f"{event.name}: {event.text or event.kind.lower()}" for event in stops[:3]),
            )
        )
    print_table(("recording", "begins", "duration", "MB", "faults and marks"), rows)


def info(
    flight: Annotated[Path, Argument(metavar="FILE.mcap", help="Flight recording.")],
    json_file: opt.Json = None,
) -> None:
    """Report the content of a recording: machine, axes, models, missing cycles, events."""
    need_reader()
    import numpy as np

    from hdbridge.daemon.recorder.reading import read

    found = read(flight)
    about = found.about
    steps = np.diff(found.machine["cycle"])
    missing = int(np.sum(steps[steps > 1] - 1))

    def outer_of(axis: str) -> dict[str, Any] | None:
        """Returns the connection of another master to a gateway axis, or None."""
        rows = found.axes[axis]
        asked = ~np.isnan(rows["outer_target_deg"])
        if not asked.any():
            return None
        codes = rows["outer_error_code"]
        begun = codes[1:][np.diff(codes) != 0]
        return {
            "connected_s": float(np.count_nonzero(asked)) * about.period_s,
            "enabled_s": float(np.count_nonzero(rows["outer_statusword"] & 0x6F == 0x27)) * about.period_s,
            "errors": [f"{each:04X}h" for each in begun[begun != 0].tolist()],
        }

    document: dict[str, Any] = {
        "schema": "hdbridge.flight-info/1",
        "machine": about.machine,
        "finished": found.finished,
        "from": _date(found.first_ns).isoformat(),
        "to": _date(found.last_ns).isoformat(),
        "period_s": about.period_s,
        "cycles": len(found.machine["cycle"]),
        "cycles_missing": missing,
        "restarts": int(np.count_nonzero(steps <= 0)),
        "versions": dict(about.versions),
        "axes": [
            {
                "name": each.name,
                "ratio": each.ratio,
                "drive": each.identity.model_dump(exclude_none=True) if each.identity else None,
                "enabled_s": float(np.count_nonzero(np.isin(found.axes[each.name]["state"], (3, 4))))
                * about.period_s,
                "models": [used.version for used in found.models if used.axis == each.name],
                "outer": outer_of(each.name),
            }
            for each in about.axes
        ],
        "events": [_event(each) for each in found.events],
    }
    write_json(json_file, document)
    say(f"machine '{about.machine}', {document['from']} to {document['to']}")
    say(
        f"{document['cycles']} cycles of {1e3 * about.period_s:g} ms, {missing} missing, "
        f"{document['restarts']} restarts of the loop"
        + ("" if found.finished else "; not finished: hdbridge record mend")
    )
    for each in document["axes"]:
        models = f"; models {', '.join(each['models'])}" if any(each["models"]) else ""
        say(f"axis '{each['name']}', ratio {each['ratio']:g}, enabled for {each['enabled_s']:.1f} s{models}")
        if (outer := each["outer"]) is not None:
            errors = f"; errors {', '.join(outer['errors'])}" if outer["errors"] else ""
            say(
                f"  another master: connected for {outer['connected_s']:.1f} s, 'operation enabled' for "
                f"{outer['enabled_s']:.1f} s{errors}"
            )
    for event in found.events:
        say(f"{_date(event.time_ns):%H:%M:%S.%f}  {event.name}  {event.kind.lower()}  {event.text}")


def mend(flights: FlightsArgument) -> None:
    """Repair recordings that were cut off (kill, power): complete up to their last second.

    The daemon does this when it starts. A recording that is being written is refused.
    """
    need_reader()
    from hdbridge.daemon.recorder import mend as mending
    from hdbridge.daemon.recorder.reading import each_flight, overview

    def mended(path: Path) -> None:
        if path.name.endswith(".mcap") and overview(path).finished:
            return
        done = mending.mend(path)
        say(f"{done}: finished" if done is not None else f"{path}: it held no complete data; removed")

    for _ in each_flight(flights, mended):
        pass


@taking(Part, Export)
def export(
    part: Part,
    to: Export,
    flights: FlightsArgument,
    model: Annotated[
        Path | None,
        Option("--model-out", metavar="MODEL.yaml", help="Write the model that the axis used at the end."),
        Kind.MODEL,
    ] = None,
) -> None:
    """Make a record of one axis for `fit` and `diagnose`.

    Missing cycles or a disabled axis begin a new part, which requires a recording folder.
    """
    out = to.checked()
    recording, used = part.read(flights, all_states=to.all_states)
    if model is not None and (used is None or not used.text):
        raise InputError(f"{flights[0]}: no model was in use; leave out --model-out")
    _write(recording, out)
    if model is not None and used is not None:
        write_result(model, used.text)
    _print_export(recording, out)


@taking(Export)
def import_(
    to: Export,
    log: Annotated[
        Path, Argument(metavar="LOG", help="Bus log: candump (.log), .asc, .blf, .trc, .mf4; also .gz.")
    ],
    profile: Annotated[str, Argument(metavar="PROFILE", help="Axis that was on the bus.")],
    channel: Annotated[
        str | None,
        Option(
            "--channel",
            metavar="NAME",
            help="Channel of the node's bus, if the log has several with this node.",
        ),
    ] = None,
) -> None:
    """Make a record of a bus log for `fit` and `diagnose`. Any master may have driven the axis.

    Log from the drive's boot-up on: the PDO mapping comes from its SDO traffic, else from the axis file.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.control.buslog import import_log

    out = to.checked()
    axis = AxisConfig.load(Profile.find(profile).axis)
    recording = import_log(log, axis, channel=channel, all_states=to.all_states)
    _write(recording, out)
    note(f"PDO mapping {recording.notes['mapping']}")
    if cut_off := recording.notes.get("cut_off"):
        note(f"{log}: {cut_off}; the part before that is imported")
    if recording.record.motor_target_deg is None:
        note("no command in each cycle: the record has no motor_target_deg")
    _print_export(recording, out)


def _write(recording: Recording, out: Path) -> None:
    if not _is_csv(out):
        recording.save(out)
        return
    parts = recording.record.parts()
    if len(parts) > 1:
        raise InputError(
            f"{out}: the record has {len(parts)} parts, between which nothing is known of the axis; expected "
            "a folder for --out"
        )
    recording.record.write_csv(out)


def _print_export(recording: Recording, out: Path) -> None:
    record, parts = recording.record, recording.notes["parts"]
    lengths = [float(each.time_s[-1] - each.time_s[0]) for each in record.parts()]
    say(
        f"{out}: axis '{recording.axis}', {len(record)} samples in {parts} "
        f"part{'s' * (parts != 1)}, {sum(lengths):.1f} s"
    )
    for each in remarks(recording):
        note(each)


def _is_csv(path: Path) -> bool:
    return path.name.endswith((".csv", ".csv.gz"))


def _date(time_ns: int) -> datetime:
    return datetime.fromtimestamp(time_ns / _NS, UTC)


def _overview(each: Flight) -> dict[str, Any]:
    return {
        "file": str(each.path),
        "machine": each.about.machine,
        "axes": [axis.name for axis in each.about.axes],
        "finished": each.finished,
        "from": _date(each.first_ns).isoformat(),
        "to": _date(each.last_ns).isoformat(),
        "bytes": each.size,
        "cycles": each.cycles,
        "events": [_event(event) for event in each.events],
    }


def _event(event: Any) -> dict[str, Any]:
    return {
        "date": _date(event.time_ns).isoformat(),
        "name": event.name,
        "kind": event.kind,
        "text": event.text,
    }


COMMANDS: Final = {
    "record": {"list": overviews, "info": info, "mend": mend, "export": export, "import": import_}
}
