"""Measurements accepted by `fit` and `diagnose`: one or several records or recordings."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording

Given = Record | Recording | Sequence[Record | Recording] | Mapping[Path, Recording]
"""Recordings in chronological order; the keys of a mapping name them in messages."""


def by_name(given: Given) -> dict[Path, Recording]:
    """Returns the recordings by their name in messages, file or number; raises `InputError` for none."""
    if isinstance(given, Mapping):
        named = dict(given)
    else:
        several = [given] if isinstance(given, Record | Recording | str | Path) else list(given)
        for each in several:
            if not isinstance(each, Record | Recording):
                raise InputError(
                    f"{each!r} is not a recording; expected a Record or Recording: Recording.load(path) "
                    "reads a folder or a CSV file"
                )
        recordings = [Recording(each) if isinstance(each, Record) else each for each in several]
        sources = [each.record.source for each in recordings]
        named = {
            Path(source if source and sources.count(source) == 1 else f"recording {number}"): each
            for number, (source, each) in enumerate(zip(sources, recordings, strict=True), 1)
        }
    if not named:
        raise InputError("no recording; give at least one Record or Recording")
    return named


def agreed_ratio(recordings: Mapping[Path, Recording], said: Iterable[tuple[str, float | None]]) -> float:
    """Returns the gear ratio on which ``said`` (source and value) and the recordings agree.

    Raises `InputError` if they disagree, or if none states it.
    """
    said = [*said, *((f"{name}", each.ratio) for name, each in recordings.items())]
    known = [(where, value) for where, value in said if value is not None]
    if not known:
        raise InputError(
            f"{next(iter(recordings))}: the ratio of the gear is not known; say it, or name the axis (on the "
            "command line: --ratio N or --axis PROFILE)"
        )
    for where, value in known[1:]:
        if abs(value / known[0][1] - 1.0) > 1e-9:
            raise InputError(
                f"{where} has a ratio of {value:g}, but {known[0][0]} says {known[0][1]:g}; expected one "
                "gear: correct the wrong one, or leave out the other gear's record"
            )
    return known[0][1]
