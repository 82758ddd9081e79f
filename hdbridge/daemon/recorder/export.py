"""Export of a flight recording to a record, the input of `fit` and `diagnose`.

The columns are those of the bench: time is the cycle number times the period, the motor's target is the
drive's demand. Cycles without fresh feedback are omitted, because their values were not measured.

Cycles in which the axis was not enabled are omitted unless requested. A gap of more than `GAP_CYCLES` cycles
(lost, skipped, not fresh or not enabled) begins a new part, because the path in the gap is unknown. Shorter
gaps stay within a part, and time continues across them.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleFlag
from hdbridge.daemon.recorder.flightfile import About, AxisAbout, ModelUse
from hdbridge.daemon.recorder.reading import Flight
from hdbridge.errors import InputError
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import GAP_CYCLES, PART_SAMPLES, Recording

ENABLED: Final = (AxisState.ENABLED, AxisState.STOPPING)
ZEROS_MAY_DIFFER: Final = (AxisState.UNVERIFIED, AxisState.LENT)
"""States after which the encoders' zeros may have changed: the drive was booted or homed."""
OUTER: Final = ("outer_target_deg", "outer_controlword", "outer_statusword", "outer_error_code")
"""Columns of an axis with a gateway: requests and view of its other master."""
MEASURED: Final = ("motor_target_deg", "motor_position_deg", "load_position_deg", "motor_torque_nm")
SAME_RUN_S: Final = 0.5
Columns = Mapping[str, NDArray[Any]]
_NS: Final = 1e9


def axis_of(about: About, name: str | None, where: Path) -> AxisAbout:
    """Returns the description of the named or only axis; else raises InputError with the names."""
    found = [each for each in about.axes if name in {None, each.name}]
    if len(found) != 1:
        which = "which axis?" if name is None else f"no axis '{name}';"
        names = ", ".join(each.name for each in about.axes)
        raise InputError(f"{where}: {which} expected --axis with one of: {names}")
    return found[0]


def exported(
    flights: Sequence[Flight],
    axis: str | None = None,
    *,
    all_states: bool = False,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Recording:
    """Exports one axis of recordings in chronological order; ``start_ns`` and ``end_ns`` are times of day.

    Raises InputError if the recordings lack the axis, or have different gear ratios or no sample.
    """
    if not flights:
        raise InputError("no flight recording; expected at least one")
    known = [axis_of(each.about, axis, each.path) for each in flights]
    for flight, each in zip(flights, known, strict=True):
        if each.ratio != known[0].ratio:
            raise InputError(
                f"{flight.path}: the gear of '{each.name}' has a ratio of {each.ratio:g}, in "
                f"{flights[0].path} it is {known[0].ratio:g}; export them one by one"
            )
    rows = _joined(
        [
            _rows(flight, about.name, all_states=all_states, start_ns=start_ns, end_ns=end_ns)
            for flight, about in zip(flights, known, strict=True)
        ]
    )
    period_s = flights[0].about.period_s
    cuts, missing = _cuts(rows, period_s)
    pieces = _split(rows, cuts)
    parts = [_record(each, known[0], period_s) for each in pieces if len(each["cycle"]) >= PART_SAMPLES]
    if not parts:
        state = "" if all_states else " while it was enabled (--all-states includes the rest)"
        raise InputError(
            f"{flights[0].path}: nothing of axis '{known[0].name}' to export{state}: "
            f"{len(rows['cycle'])} such cycles, fewer than {PART_SAMPLES} in a row"
        )
    return Recording(
        concatenate(parts),
        axis=known[0].name,
        ratio=known[0].ratio,
        drive=known[0].identity,
        date=datetime.fromtimestamp(int(rows["clock_ns"][0]) / _NS, UTC).isoformat(timespec="seconds"),
        versions=dict(flights[0].about.versions),
        notes=_notes(flights, known[0].name, len(parts), missing, len(pieces) - len(parts)),
    )


def last_model(flights: Sequence[Flight], axis: str) -> ModelUse | None:
    """Returns the last model that the axis used; None if none was recorded."""
    used = [each for flight in flights for each in flight.models if each.axis == axis]
    return used[-1] if used else None


def _rows(
    flight: Flight, axis: str, *, all_states: bool, start_ns: int | None, end_ns: int | None
) -> Columns:
    columns = dict(flight.axes[axis])
    columns["clock_ns"] = flight.machine["time_ns"] + flight.about.offset_ns
    chosen = (columns["flags"] & SampleFlag.FRESH) != 0
    if not all_states:
        chosen &= np.isin(columns["state"], ENABLED)
    if start_ns is not None:
        chosen &= columns["clock_ns"] >= start_ns
    if end_ns is not None:
        chosen &= columns["clock_ns"] <= end_ns
    return {name: column[chosen] for name, column in columns.items()}


def _joined(parts: Sequence[Columns]) -> Columns:
    return {name: np.concatenate([each[name] for each in parts]) for name in parts[0]}


def _cuts(rows: Columns, period_s: float) -> tuple[NDArray[np.intp], int]:
    """Returns the first rows of new parts, and the number of cycles missing within parts.

    Cycle numbers continue from file to file and restart with the control process; the clock reveals such a
    restart.
    """
    steps = np.diff(rows["cycle"])
    apart_s = np.abs(np.diff(rows["clock_ns"]) / _NS - steps * period_s)
    cut = (steps <= 0) | (steps > GAP_CYCLES + 1) | (apart_s > SAME_RUN_S)
    return np.flatnonzero(cut) + 1, int(np.sum(steps[~cut] - 1))


def _split(rows: Columns, cuts: NDArray[np.intp]) -> list[Columns]:
    edges = [0, *cuts.tolist(), len(rows["cycle"])]
    return [{name: column[first:end] for name, column in rows.items()} for first, end in pairwise(edges)]


def _record(rows: Columns, axis: AxisAbout, period_s: float) -> Record:
    columns = {"time_s": rows["cycle"] * period_s, **{name: rows[name] for name in MEASURED}}
    if np.isnan(columns["load_position_deg"]).all():
        raise InputError(
            f"axis '{axis.name}' has no encoder at its load (load_encoder.source is the motor encoder); "
            "expected a recording of an axis with one, because a record shows the load's error"
        )
    if np.isnan(columns["motor_torque_nm"]).any():
        del columns["motor_torque_nm"]  # the drive does not report it
    if not np.isnan(rows[OUTER[0]]).all():
        columns |= {name: rows[name] for name in OUTER}
    for place, channel in enumerate(axis.channels):
        if np.all(rows["flags"] & (SampleFlag.CHANNEL0_KNOWN << place)):
            columns[channel] = rows[f"reading{place}"]
    return Record(columns)


def _notes(flights: Sequence[Flight], axis: str, parts: int, missing: int, shorts: int) -> dict[str, Any]:
    """Returns the notes on the record's origin."""
    model = last_model(flights, axis)
    notes: dict[str, Any] = {
        "source": [each.path.name for each in flights],
        "machine": flights[0].about.machine,
        "parts": parts,
        "cycles_missing_within_parts": missing,
        "parts_too_short": shorts,
        "model": model.version if model else None,
        "stops": [each.text for flight in flights for each in flight.events if each.kind == "STOPPED"],
        "zeros_may_differ": any(
            bool(np.any(np.isin(each.axes[axis]["state"], ZEROS_MAY_DIFFER))) for each in flights
        ),
    }
    return {name: value for name, value in notes.items() if value not in (None, 0, [], False)}
