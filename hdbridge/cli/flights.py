"""Flight recordings of the daemon, as the commands read them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import need_extra
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.recorder.reading import Flight, ModelUsed
    from hdbridge.records.recording import Recording

_EXTRA = ("mcap", "google.protobuf")
_NS = 10**9

AxisOption = Annotated[
    str | None,
    typer.Option(
        "--axis", metavar="NAME", help="Axis of the flight recordings; needed if they have several."
    ),
]
FromOption = Annotated[
    str | None,
    typer.Option("--from", metavar="TIME", help="Start of the flight, ISO 8601; UTC without an offset."),
]
ToOption = Annotated[
    str | None,
    typer.Option("--to", metavar="TIME", help="End of the flight, ISO 8601; UTC without an offset."),
]


def is_flight(path: Path) -> bool:
    """Returns True for an MCAP file, and for a folder that has some and is not a recording."""
    if path.is_dir():
        return not (path / "recording.yaml").exists() and next(path.rglob("*.mcap*"), None) is not None
    return path.name.endswith((".mcap", ".mcap.part"))


def read_flights(
    paths: Sequence[Path],
    axis: str | None = None,
    begin: str | None = None,
    end: str | None = None,
    *,
    all_states: bool = False,
) -> tuple[Recording, ModelUsed | None]:
    """Reads one axis of flight recordings, and the model that it used at the end; None if it used none.

    ``paths`` are MCAP files and folders of them, ``begin`` and ``end`` times as the options take them. Raises
    `InputError` if the axis or the time is not in the recordings.
    """
    need_reader()
    from hdbridge.daemon.recorder.export import axis_of, exported, last_model
    from hdbridge.daemon.recorder.reading import each_flight, overview, read

    limits = (_time_ns(begin, "--from"), _time_ns(end, "--to"))

    def wanted(path: Path) -> Flight | None:
        about = overview(path)
        if _outside(about, *limits):
            return None
        return read(about.path, (axis_of(about.about, axis, path)[1].name,))

    found = [each for each in each_flight(paths, wanted) if each is not None]
    if not found:
        raise InputError(f"{paths[0]}: nothing was recorded between --from and --to")
    found.sort(key=lambda each: each.first_ns)
    recording = exported(found, axis, all_states=all_states, start_ns=limits[0], end_ns=limits[1])
    assert recording.axis is not None
    return recording, last_model(found, recording.axis)


def remarks(recording: Recording) -> Iterator[str]:
    """Yields remarks on a recording from flights or a bus log."""
    about = recording.notes
    if count := about.get("cycles_missing_within_parts"):
        yield f"{count} cycles are missing within parts: the time goes on over them"
    if count := about.get("parts_too_short"):
        yield f"{count} parts were too short and are left out"
    if about.get("zeros_may_differ"):
        yield (
            "the drive was booted or homed meanwhile: if its encoders lose their zeros then, pass "
            "--independent-zeros to fit and diagnose"
        )


def need_reader() -> None:
    """Raises `InputError` if a package that reads flight recordings is not installed."""
    need_extra("flight recordings need", _EXTRA, "daemon")


def _outside(about: Flight, begin_ns: int | None, end_ns: int | None) -> bool:
    return (begin_ns is not None and about.last_ns < begin_ns) or (
        end_ns is not None and about.first_ns > end_ns
    )


def _time_ns(text: str | None, option: str) -> int | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{option}: found '{text}'; expected a time such as 2026-03-01T12:30:00") from None
    return round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * _NS)
