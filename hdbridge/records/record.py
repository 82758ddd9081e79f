"""Record: the measured motion of one axis, sample by sample, as named columns with units.

Records of hdbridge's own bench and those read from CSV files of other programs have the same form. Sampling
may be uneven. Angles are multi-turn degrees.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np

from hdbridge.axis.effects import Channel, FloatArray, Motion
from hdbridge.axis.effects.motion import MEASURED
from hdbridge.errors import InputError
from hdbridge.files.csvfile import Column, CsvFile, write_columns
from hdbridge.records.columns import (
    CHANNELS,
    OPTIONAL,
    REQUIRED,
    UNITS,
    CsvColumns,
    Origin,
    Said,
    option,
    read,
)
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN, rounded

UNIT_SHARE: Final = 0.006
"""Maximum relative deviation of a slope for attributing it to a wrong unit: the spacing of common ratios."""
LEAST_COUNTS: Final = 1000.0
"""Minimum plausible number of counts per turn of an encoder."""
STANDSTILL: Final = 0.01
"""Minimum load travel, relative to the expected travel; with less, the load encoder was not read."""
_PLURALS: Final = {
    "deg": "degrees",
    "rad": "radians",
    "mrad": "milliradians",
    "arcmin": "arcminutes",
    "arcsec": "arcseconds",
    "turns": "turns",
}


def remedy(times: float, ratio: float, exact: float, origin: Origin | None) -> str:
    """Returns advice for a load that travels ``times`` times as far as ratio and motor imply.

    If the record is from a CSV file, the advice includes the option to pass. ``exact`` is the relative
    accuracy within which a ratio counts as right.
    """
    if abs(times) < STANDSTILL:
        column = (
            f", '{origin.columns['load']}': {option('--columns', {'load': 'COLUMN'})} names another"
            if origin
            else ""
        )
        return f"look at the load encoder's column{column}"
    if times < 0.0:
        how = f": pass {origin.scaled('load', -1.0)}, or {origin.scaled('motor', -1.0)}" if origin else ""
        return f"reverse the direction of one encoder{how}"
    found = [
        (abs(times * change - 1.0), words, how)
        for change, words, how in (*_other_units(origin), *_other_places(ratio, origin))
    ]
    off, words, how = min(found)
    if off < UNIT_SHARE:
        return f"{words}: {how}" + (
            "" if off < exact else f" (then it is {100.0 * off:.2g} % off: see the ratio, too)"
        )
    for channel, counts in (("load", DEG_PER_TURN * times), ("motor", DEG_PER_TURN / times)):
        if counts > LEAST_COUNTS and (origin is None or origin.units[channel].name == "deg"):
            how = "convert it to degrees (times 360, divided by the counts per turn)"
            if origin is not None:
                pass_ = option("--units", {channel: f"counts:{_round(counts, exact)}"})
                how = f"pass {pass_} with the counts per turn of its data sheet"
            return f"the {channel}'s angle looks like counts, about {counts:.4g} per turn: {how}"
    return "correct the ratio, or the counts per turn of an encoder" + _of_counts(times, exact, origin)


def _other_units(origin: Origin | None) -> list[tuple[float, str, str]]:
    """Returns, for each other angle unit: the factor by which it would change the travel, symptom, advice."""
    found = []
    for channel, sense in (("load", 1.0), ("motor", -1.0)):
        unit = origin.units[channel] if origin else None
        if unit is not None and unit.per is not None:
            continue
        for name, plural in _PLURALS.items():
            change = UNITS["deg"][name].factor / (unit.scale.factor if unit else 1.0)
            if change == 1.0:
                continue
            how = "convert it to degrees"
            if origin is not None:
                how = f"pass {option('--units', {channel: str(origin.units[channel].named(name, channel))})}"
            found.append((change**sense, f"the {channel}'s angle looks like {plural}", how))
    return found


def _other_places(ratio: float, origin: Origin | None) -> list[tuple[float, str, str]]:
    exchange, multiply = "exchange them", "multiply it by the ratio"
    if origin is not None:
        exchange = f"pass {origin.exchanged()}"
        multiply = f"pass {origin.scaled('motor', ratio)}, which multiplies it by the ratio"
    return [
        (ratio**-2, "the columns of motor and load are exchanged", exchange),
        (1.0 / ratio, "the motor's angle is that of the gear's output", multiply),
    ]


def _of_counts(times: float, exact: float, origin: Origin | None) -> str:
    """Returns the options with the counts per turn that would agree with the ratio; empty for other units."""
    if origin is None:
        return ""
    agreeing = []
    for channel, change in (("load", times), ("motor", 1.0 / times)):
        per = origin.units[channel].per
        if per is not None:
            agreeing.append(option("--units", {channel: f"counts:{_round(per * change, exact)}"}))
    return f" ({' or '.join(agreeing)} would agree)" if agreeing else ""


def _round(counts: float, exact: float) -> int:
    """Returns the roundest number of counts, preferably a power of two, within the accuracy ``exact``."""
    power: int = 2 ** round(math.log2(counts))
    if abs(counts / power - 1.0) < exact:
        return power
    for digits in range(1, 8):
        round_counts = rounded(counts, digits)
        if abs(counts / round_counts - 1.0) < exact:
            return int(round_counts)
    return round(counts)


__all__ = ["MINIMUM_SAMPLES", "OPTIONAL", "REQUIRED", "Record", "concatenate", "time_shifts_s"]

MINIMUM_SAMPLES: Final = 2

LARGEST: Final = 1e10
"""Largest plausible value of a channel in the record's unit; beyond it the precision of a float is lost."""
WRONG_RATIO: Final = 0.003
"""Relative deviation of a ratio that indicates a different gear; common ratios are at least 0.6 % apart."""
WRONG_RATIO_ARCSEC: Final = 900.0
"""Minimum effect of such a deviation over the travel, arcsec: several times the error of any gear."""


@dataclass(frozen=True, eq=False)
class Record:
    """Columns of equal length, by name (see `REQUIRED` and `OPTIONAL`); others are kept but not used."""

    columns: Mapping[str, Column]
    source: str = ""
    """Source of the record, for messages."""
    starts: tuple[int, ...] = field(default=(0,))
    """First row of each concatenated record. The motion of the axis between two records is unknown."""
    origin: Origin | None = None
    """CSV file from which the record was read, and its interpretation; None for any other record."""
    first_row: int = 0
    """Row of the source at which the record begins, for messages; not 0 for a part of another record."""

    def __post_init__(self) -> None:
        missing = [name for name in REQUIRED if name not in self.columns]
        if missing:
            raise ValueError(f"a record needs the columns {', '.join(missing)}")
        columns = {name: _frozen(column) for name, column in self.columns.items()}
        shapes = {column.shape for column in columns.values()}
        if len(shapes) != 1 or len(shapes.pop()) != 1:
            raise ValueError("the columns of a record are one-dimensional and of one length")
        object.__setattr__(self, "columns", MappingProxyType(columns))

    def __reduce__(self) -> tuple[Any, ...]:
        """Supports pickling, which the read-only mapping does not."""
        return type(self), (dict(self.columns), self.source, self.starts, None, self.first_row)

    @classmethod
    def read_csv(
        cls,
        path: Path | str,
        minimum_samples: int = MINIMUM_SAMPLES,
        *,
        columns: Said = None,
        units: Said = None,
        unwrap: Said = None,
    ) -> Self:
        """Reads a CSV file of any program, plain or gzip.

        ``columns`` states the column of each channel, ``units`` its unit and ``unwrap`` the period of a
        wrapping counter, as on the command line (``columns="motor=theta_m,time=t"``) or as a mapping.
        ``.origin.remarks`` contains the assumptions.

        Raises `InputError`, with file and line, if a required column is missing, a value of a known column is
        not a finite number, a row is ragged, time runs backwards, there are too few samples, or the encoding
        is unknown.
        """
        return cls.of_csv(Path(path), CsvColumns.of(columns, units, unwrap), minimum_samples)

    @classmethod
    def of_csv(cls, path: Path, said: CsvColumns, minimum_samples: int = MINIMUM_SAMPLES) -> Self:
        """Reads a CSV file like `read_csv`, but with options that have been parsed."""
        file = CsvFile(path, [said.column(channel) for channel in CHANNELS])
        found, origin = read(file, said)
        record = cls(found, str(path), origin=origin)
        if len(record) < minimum_samples:
            count = f"{len(record)} sample{'s' * (len(record) != 1)}"
            raise InputError(f"{path}: {count}; expected at least {minimum_samples}")
        record.check_values(np.finfo(np.float64).max)
        return record

    def write_csv(self, path: Path | str) -> None:
        """Writes the record atomically as CSV, compressed if the name ends in ``.gz``.

        Every number reads back exactly, and equal records produce equal bytes.
        """
        write_columns(Path(path), self.columns)

    def __len__(self) -> int:
        """Returns the number of samples."""
        return len(self.time_s)

    def __eq__(self, other: object) -> bool:
        """Returns True if the records have the same columns with exactly the same values."""
        if not isinstance(other, Record):
            return NotImplemented
        return self.columns.keys() == other.columns.keys() and all(
            _same(column, other.columns[name]) for name, column in self.columns.items()
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def time_s(self) -> FloatArray:
        """Time in seconds, shape (n,)."""
        return self.columns["time_s"]

    @property
    def motor_position_deg(self) -> FloatArray:
        """Measured motor angle in degrees, multi-turn, shape (n,)."""
        return self.columns["motor_position_deg"]

    @property
    def load_position_deg(self) -> FloatArray:
        """Measured load angle in degrees, multi-turn, shape (n,)."""
        return self.columns["load_position_deg"]

    @property
    def motor_target_deg(self) -> FloatArray | None:
        """Commanded motor angle in degrees, multi-turn, shape (n,); None if not recorded."""
        return self.columns.get("motor_target_deg")

    @property
    def measured(self) -> dict[Channel, FloatArray]:
        """Measured channels of the record, each of shape (n,)."""
        return {each: self.columns[each.value] for each in MEASURED if each.value in self.columns}

    def transmission_error_arcsec(self, ratio: float) -> FloatArray:
        """Returns the measured transmission error theta_L - theta_M / N, arcsec at the load, shape (n,).

        Its mean includes the offset between the zeros of the two encoders.
        """
        error: FloatArray = (self.load_position_deg - self.motor_position_deg / ratio) * ARCSEC_PER_DEG
        return error

    def motion(self) -> Motion:
        """Returns the motion as a model's input, with the commanded motor angle if it was recorded."""
        target = self.motor_target_deg
        return Motion(
            motor_deg=self.motor_position_deg if target is None else target,
            time_s=self.time_s,
            measured=self.measured,
        )

    def load_turns_per_motor_turn(self) -> float | None:
        """Returns the slope of the load angle over the motor angle; None if the motor did not move."""
        motor = self.motor_position_deg - np.mean(self.motor_position_deg)
        square = float(motor @ motor)
        return float(motor @ self.load_position_deg) / square if square else None

    def check_values(self, largest: float = LARGEST) -> None:
        """Raises `InputError` if time decreases, or if a value is not finite or beyond ``largest``."""
        for channel, name in CHANNELS.items():
            values = self.columns.get(name, np.empty(0))
            for row in np.flatnonzero(~(np.abs(values) <= largest))[:1].tolist():
                column = self.origin.columns[channel] if self.origin else name
                cure = (
                    f" of at most {largest:g}: remove the sample, or state the unit of its column"
                    if math.isfinite(values[row])
                    else ""
                )
                raise InputError(
                    f"{self._place(row)}: {column}: {values[row]:g}; expected a finite number{cure}"
                )
        time_s, origin = self.time_s, self.origin
        for row in np.setdiff1d(np.flatnonzero(np.diff(time_s) < 0.0) + 1, self.starts)[:1].tolist():
            cure = (origin.clock_cure(time_s) if origin else "") or "sort the samples, or split the record"
            raise InputError(
                f"{self._place(row)}: time_s: {time_s[row]:g} after {time_s[row - 1]:g}; "
                f"expected times that do not decrease: {cure}"
            )

    def _place(self, row: int) -> str:
        """Returns file and line of a row; without a file, the number of the sample in the source (from 0)."""
        row += self.first_row
        if self.origin is not None:
            return self.origin.place(row)
        return f"{self.source}: sample {row}" if self.source else f"sample {row}"

    def check_ratio(self, ratio: float, stated_by: str = "") -> None:
        """Raises `InputError` if the record's own angles contradict a ratio, which a file may state.

        Small deviations are left to the diagnosis. So is any deviation that, because of short travel, cannot
        be distinguished from the gear's own error.
        """
        slope = self.load_turns_per_motor_turn() if len(self) else None
        if slope is None:
            return
        travel_deg = float(np.ptp(self.motor_position_deg)) / ratio
        off = abs(slope * ratio - 1.0)
        if off <= WRONG_RATIO or off * travel_deg * ARCSEC_PER_DEG <= WRONG_RATIO_ARCSEC:
            return
        if abs(slope) * ratio < 0.01:
            found = "the load stands still while the motor turns"
        else:
            found = f"the motor makes {1 / abs(slope):.5g} turns per turn of the load"
            found += ", in the opposite direction" if slope < 0.0 else ""
        cure = remedy(slope * ratio, ratio, WRONG_RATIO, self.origin)
        name = f"{self.source}: " if self.source else ""
        over = f"measured over {travel_deg:.3g} deg of the load"
        by = f", stated by {stated_by}" if stated_by else ""
        raise InputError(f"{name}{found} ({over}); expected a ratio of {ratio:g}{by}: {cure}")

    def rows(self, first: int, end: int) -> Self:
        """Returns the samples from row ``first`` up to but not including row ``end``."""
        columns = {name: column[first:end] for name, column in self.columns.items()}
        inside = (start - first for start in self.starts if first < start < end)
        return type(self)(columns, self.source, (0, *inside), self.origin, self.first_row + first)

    def between(self, start_s: float, end_s: float) -> Self:
        """Returns the samples of a time span, including both ends."""
        first = int(np.searchsorted(self.time_s, start_s, side="left"))
        end = int(np.searchsorted(self.time_s, end_s, side="right"))
        return self.rows(first, end)

    def parts(self) -> tuple[Self, ...]:
        """Returns the records from which this record was concatenated."""
        ends = (*self.starts[1:], len(self))
        return tuple(self.rows(start, end) for start, end in zip(self.starts, ends, strict=True))


def concatenate(records: Sequence[Record]) -> Record:
    """Concatenates records in the given order.

    If the time of a record starts again, it is shifted to follow the previous record. Columns that some
    records lack are omitted.
    """
    if not records:
        raise ValueError("nothing to concatenate")
    names = [name for name in records[0].columns if all(name in each.columns for each in records)]
    shifts = time_shifts_s(records)
    columns: dict[str, Any] = {
        name: np.concatenate([each.columns[name] for each in records]) for name in names
    }
    columns["time_s"] = np.concatenate(
        [each.time_s + shift if shift else each.time_s for each, shift in zip(records, shifts, strict=True)]
    )
    before = np.cumsum([0, *(len(each) for each in records[:-1])]).tolist()
    starts = tuple(
        rows + start for rows, each in zip(before, records, strict=True) for start in each.starts if len(each)
    )
    return Record(
        columns, ", ".join(dict.fromkeys(each.source for each in records if each.source)), starts or (0,)
    )


def time_shifts_s(records: Sequence[Record]) -> tuple[float, ...]:
    """Returns the offsets that make the records' times consecutive, s; 0 if they already are."""
    shifts: list[float] = []
    end_s = -np.inf
    for record in records:
        shift_s = 0.0
        if len(record):
            if record.time_s[0] < end_s:
                steps = np.diff(record.time_s)
                shift_s = end_s - float(record.time_s[0]) + (float(np.median(steps)) if len(steps) else 0.0)
            end_s = float(record.time_s[-1]) + shift_s
        shifts.append(shift_s)
    return tuple(shifts)


def _frozen(column: Any) -> Column:
    """Returns a column as a read-only view of float64 or of text."""
    array = np.asarray(column)
    if array.dtype.kind != "U":
        array = array.astype(np.float64, copy=False)
    view = array.view()
    view.flags.writeable = False
    return view


def _same(one: Column, other: Column) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if one.dtype.kind == "f":  # the payload bits of a NaN are meaningless, and a file does not keep them
        one, other = (np.where(np.isnan(each), np.nan, each) for each in (one, other))
    return one.tobytes() == other.tobytes()
