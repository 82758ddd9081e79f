"""Assigns CSV columns to the channels of a record, with units and wrapping counters.

A record's own columns are in the units stated in their names. A file of another program is read with
`CsvColumns`, which represents the options ``--columns``, ``--units`` and ``--unwrap`` of the command line.
"""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, NamedTuple, Self

import numpy as np

from hdbridge.axis.effects import FloatArray
from hdbridge.axis.effects.motion import MEASURED
from hdbridge.errors import InputError
from hdbridge.files.csvfile import Column, CsvFile
from hdbridge.files.expectation import nearest, one_line
from hdbridge.units import DEG_PER_TURN, without_unit

REQUIRED: Final[Mapping[str, str]] = MappingProxyType(
    {
        "time_s": "time; never decreasing",
        "motor_position_deg": "measured motor angle, multi-turn",
        "load_position_deg": "measured load angle, multi-turn",
    }
)
OPTIONAL: Final[Mapping[str, str]] = MappingProxyType(
    {"motor_target_deg": "commanded motor angle, multi-turn", **{each.value: each.about for each in MEASURED}}
)
CHANNELS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "time": "time_s",
        "motor": "motor_position_deg",
        "load": "load_position_deg",
        "target": "motor_target_deg",
        **{without_unit(each.value).removesuffix("_c"): each.value for each in MEASURED},
    }
)
"""Column of a record for each channel name that the options accept."""
Said = str | Sequence[str] | Mapping[str, object] | None
"""Value of an option: ``channel=value,channel=value``, a sequence of such texts, or a mapping."""
ROW: Final = "row"
"""Placeholder for a column that contains the row number, for a file without a time column."""


class _Scale(NamedTuple):
    """Conversion of a column's value to ``at_zero + factor * value`` in the record's unit."""

    factor: float
    at_zero: float = 0.0
    per: str = ""
    """Quantity that must follow the unit after a colon, if any. It divides the factor or, for a torque,
    multiplies it."""


_RAD: Final = math.degrees(1.0)
_PER_TURN: Final = "counts per turn"
_RATED: Final = "rated torque in Nm"
UNITS: Final[Mapping[str, Mapping[str, _Scale]]] = {
    "s": {
        "s": _Scale(1.0),
        "ms": _Scale(1e-3),
        "us": _Scale(1e-6),
        "ns": _Scale(1e-9),
        "min": _Scale(60.0),
        "h": _Scale(3600.0),
    },
    "deg": {
        "deg": _Scale(1.0),
        "rad": _Scale(_RAD),
        "mrad": _Scale(1e-3 * _RAD),
        "arcmin": _Scale(1 / 60),
        "arcsec": _Scale(1 / 3600),
        "turns": _Scale(DEG_PER_TURN),
        "counts": _Scale(DEG_PER_TURN, per=_PER_TURN),
    },
    "nm": {
        "Nm": _Scale(1.0),
        "mNm": _Scale(1e-3),
        "kNm": _Scale(1e3),
        "percent": _Scale(1e-2, per=_RATED),
        "permille": _Scale(1e-3, per=_RATED),
    },
    "c": {"degC": _Scale(1.0), "K": _Scale(1.0, -273.15), "degF": _Scale(5 / 9, -160 / 9)},
}
"""Known units, by the unit at the end of the record's column name."""
_ALIASES: Final[Mapping[str, str]] = {
    alias: unit
    for unit, aliases in {
        "s": "sec second seconds",
        "ms": "msec millis milliseconds",
        "us": "usec µs μs micros microseconds",
        "ns": "nsec nanoseconds",
        "deg": "° degree degrees",
        "rad": "radian radians",
        "arcmin": "' arcminutes",
        "arcsec": '" arcseconds',
        "turns": "turn rev revs revolutions",
        "counts": "count cnt cnts inc incs increments ticks pulses lsb",
        "Nm": "nm n·m n*m",
        "mNm": "mnm",
        "kNm": "knm",
        "percent": "%",
        "permille": "‰",
        "degC": "°c c celsius degc",
        "K": "k kelvin",
        "degF": "°f degf",
    }.items()
    for alias in aliases.split()
}
_CLOCK_PERIODS: Final = sorted(
    period / 1000.0**step
    for step in range(4)
    for period in (2**16, 2**24, 2**31, 2**32, 60, 3600, 86400, 1e9)
)
"""Values at which clocks wrap, in the clock's own unit."""
_UNIT = re.compile(r"(-?)(\d*\.?\d*(?:[eE][+-]?\d+)?)\s*([^\d\s:.+-][^:]*?)(?::(.+))?$")
_IN_NAME = re.compile(r"[\[(]([^\])]+)[\])]\s*$|(?:[_ ./-]|\bin )([^\W\d_]+|[°%\"'‰µμ]\w*)\s*$")
_HINTS: Final[Mapping[str, frozenset[str]]] = {
    "time": frozenset({"time", "timestamp", "timestamps", "zeit", "clock", "ts", "t"}),
    "motor": frozenset({"motor", "mot", "input", "drive", "antrieb", "m"}),
    "load": frozenset({"load", "last", "output", "out", "link", "joint", "abtrieb", "l"}),
}
"""Words in column names that suggest the channel."""
_OTHERS: Final = frozenset(
    {"torque", "current", "speed", "velocity", "vel", "acceleration", "acc", "error", "temperature", "temp",
     "power", "target", "demand", "command", "cmd", "setpoint", "ref", "soll", "state", "status"}
)  # fmt: skip
"""Words in column names that rule out a time or a measured angle."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of a column; `str` formats it as in the options: rad, -counts:65536, 0.1degC."""

    name: str
    scale: _Scale
    per: float | None = None
    """Counts per turn, or rated torque in Nm, if the unit requires it."""
    times: float = 1.0
    """Number of units that correspond to a value of 1 in the column; negative for the opposite direction."""

    @classmethod
    def parse(cls, text: str, channel: str, where: str = "--units") -> Self:
        """Parses a unit, the text after ``channel=``; raises `InputError` with the possible units."""
        known = _units_of(channel)
        found = _UNIT.match(text.strip())
        name = _canonical(found[3], known) if found else None
        try:
            times = float(found[2] or 1.0) if found else 1.0
        except ValueError:
            name = None
        if found is None or name is None:
            close = nearest(found[3] if found else text, list(known))
            raise _wrong(
                f"{where}: {channel}={text}: no such unit; expected {_choices(known)}"
                + (f" (did you mean {close}?)" if close else "")
            )
        scale, per = known[name], None
        if scale.per or found[4] is not None:
            per = _positive(found[4])
            if not scale.per or per is None:
                expected = f"{name}:N with N the {scale.per}" if scale.per else name
                raise _wrong(f"{where}: {channel}={text}: expected {expected}")
        if not times:
            raise _wrong(f"{where}: {channel}={text}: expected a factor other than zero")
        return cls(name, scale, per, -times if found[1] else times)

    @property
    def factor(self) -> float:
        """Factor from the column's value to the record's unit; for a temperature, from differences."""
        factor = self.scale.factor * self.times
        if self.per is None:
            return factor
        return factor / self.per if self.scale.per == _PER_TURN else factor * self.per

    def convert(self, values: FloatArray) -> FloatArray:
        """Converts values to the record's unit; returns the same array if no conversion is needed."""
        factor, at_zero = self.factor, self.scale.at_zero
        if factor == 1.0 and not at_zero:
            return values
        converted: FloatArray = at_zero + factor * values if at_zero else factor * values
        return converted

    def named(self, name: str, channel: str) -> Self:
        """Returns the unit ``name`` with the same counts per turn and factor."""
        return replace(self, name=name, scale=_units_of(channel)[name])

    def scaled(self, by: float) -> Self:
        """Returns the unit with which a column's values are read ``by`` times as large."""
        return replace(self, times=self.times * by)

    def __str__(self) -> str:
        sign = "-" if self.times < 0.0 else ""
        times = "" if abs(self.times) == 1.0 else f"{abs(self.times):.10g}"
        return f"{sign}{times}{self.name}" + (f":{self.per:.12g}" if self.per is not None else "")


@dataclass(frozen=True, slots=True)
class CsvColumns:
    """Assignment of a CSV file's columns by the user; keys are the channels of `CHANNELS`."""

    columns: Mapping[str, str] = field(default_factory=dict)
    """Column name, column number (from 1) or `ROW`; other channels use the record's own column name."""
    units: Mapping[str, Unit] = field(default_factory=dict)
    unwrap: Mapping[str, float] = field(default_factory=dict)
    """Period of each wrapping counter, in the unit of its column."""

    @classmethod
    def of(cls, columns: Said = None, units: Said = None, unwrap: Said = None) -> Self:
        """Parses texts such as ``motor=theta_m,time=t``, ``motor=counts:65536,time=ms``, ``motor=65536``.

        Each argument may also be a mapping or a sequence. Later entries override earlier ones. Raises
        `InputError` for an unknown channel or an invalid unit or period.
        """
        periods: dict[str, float] = {}
        for channel, text in _pairs(unwrap, "--unwrap", "PERIOD").items():
            period = _positive(text)
            if period is None:
                raise _wrong(
                    f"--unwrap: {channel}={text}: expected the period of the counter in the column's unit, "
                    "for example 65536 for a 16-bit counter, 360 for degrees of one turn"
                )
            periods[channel] = period
        return cls(
            _pairs(columns, "--columns", "COLUMN"),
            {
                channel: Unit.parse(text, channel)
                for channel, text in _pairs(units, "--units", "UNIT").items()
            },
            periods,
        )

    def __bool__(self) -> bool:
        """Returns True if any column, unit or period was assigned."""
        return bool(self.columns or self.units or self.unwrap)

    def column(self, channel: str) -> str:
        """Returns the name or number of the column for a channel."""
        return self.columns.get(channel, CHANNELS[channel])


@dataclass(frozen=True, slots=True)
class Origin:
    """CSV file from which a record was read, and its interpretation, for messages with lines and options."""

    file: CsvFile
    columns: Mapping[str, str]
    """Column of the file for each channel of the record."""
    units: Mapping[str, Unit]
    """Unit in which each column was read."""
    stated: frozenset[str]
    """Channels whose unit the user stated."""
    unwrapped: frozenset[str]
    remarks: tuple[str, ...]
    """Assumptions about units and format, as text."""

    @property
    def remark(self) -> str:
        """One line with all assumptions; empty without assumptions."""
        return one_line(f"{self.file.path}: assumed {'; '.join(self.remarks)}") if self.remarks else ""

    def place(self, row: int) -> str:
        """Returns file and line of a row of the record."""
        return f"{self.file.path}:{self.file.line_of_row(row)}"

    def clock_cure(self, time_s: FloatArray) -> str:
        """Returns advice with the option for a clock that wraps at a common period; else empty."""
        raw = time_s / self.units["time"].factor
        steps = np.diff(raw)
        ahead = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
        lost = ahead - steps[steps < 0.0]
        for period in _CLOCK_PERIODS:
            if np.all(np.abs(lost - period) < 2.0 * ahead) and ahead < 0.1 * period:
                return f"for a clock that wraps, pass {option('--unwrap', {'time': f'{period:.12g}'})}"
        return ""

    def exchanged(self) -> str:
        """Returns the option that exchanges the columns of motor and load."""
        return option("--columns", {"motor": self.columns["load"], "load": self.columns["motor"]})

    def scaled(self, channel: str, by: float) -> str:
        """Returns the option that makes the values of a channel ``by`` times as large."""
        return option("--units", {channel: str(self.units[channel].scaled(by))})


def option(name: str, values: Mapping[str, str]) -> str:
    """Returns the text of a command-line option, quoted for a shell."""
    return f"{name} {shlex.quote(','.join(f'{channel}={value}' for channel, value in values.items()))}"


def read(file: CsvFile, said: CsvColumns) -> tuple[dict[str, Column], Origin]:
    """Reads the columns of a record from a CSV file, converts and unwraps them, and returns their origin too.

    The columns of channels come first. All other columns of the file are kept unchanged.
    """
    found = _located(file, said)
    units, remarks = _units(file, said, found)
    numeric = {name for name in found.values() if name != ROW}
    time = found["time"]
    columns = file.read(numeric, {time} - {ROW})
    rows = len(next(iter(columns.values())))
    converted: dict[str, Column] = {}
    for channel, name in found.items():
        values = columns[name] if name != ROW else np.arange(float(rows))
        if channel in said.unwrap:
            values = _unwrapped(values, said.unwrap[channel], ordered=channel == "time")
        if name == time and abs(units[channel].factor) < 1e-3 and rows:
            values = values - values[0]  # nanoseconds since 1970 exceed the precision of a float
        with np.errstate(over="ignore"):  # an infinite value is reported with its line
            converted[CHANNELS[channel]] = units[channel].convert(values)
    used = set(found.values())
    kept = {name: each for name, each in columns.items() if name not in used and name not in converted}
    origin = Origin(
        file, found, units, frozenset(said.units), frozenset(said.unwrap), (*file.remarks, *remarks)
    )
    order = {CHANNELS[channel]: None for channel in found}
    return {**{name: converted[name] for name in order}, **kept}, origin


def _located(file: CsvFile, said: CsvColumns) -> dict[str, str]:
    """Finds the column of each channel; for missing columns, raises `InputError` with the options to pass."""
    found: dict[str, str] = {}
    missing: list[str] = []
    for channel, own in CHANNELS.items():
        wanted = said.column(channel)
        name = ROW if wanted == ROW and ROW not in file.names else file.find(wanted)
        if channel not in said.columns and name != own:
            name = None  # a record's own column is identified by its name, not its number
        if name is not None:
            found[channel] = name
        elif channel in said.columns or own in REQUIRED:
            missing.append(channel)
        elif channel in said.units or channel in said.unwrap:
            what = "--units" if channel in said.units else "--unwrap"
            raise _wrong(
                f"{_where(file)}: there is no column '{own}' for {what} {channel}=...; name it: "
                f"{option('--columns', {channel: 'COLUMN'})}"
            )
    if missing:
        raise _missing(file, said, missing, found)
    for channel, name in found.items():
        other = next((each for each, column in found.items() if column == name and each != channel), None)
        if other is not None and name != ROW:
            raise _wrong(f"--columns: column '{name}' is both {other} and {channel}; expected one for each")
    return found


def _missing(file: CsvFile, said: CsvColumns, missing: Sequence[str], found: Mapping[str, str]) -> InputError:
    """Returns the error for missing columns, with the existing columns and the options to pass."""
    names = [f"'{said.column(each)}'" for each in missing]
    what = f"column{'s' * (len(names) > 1)} {', '.join(names)} {'are' if len(names) > 1 else 'is'} missing"
    if not file.header_line:
        numbers = ", ".join(f"{each}=N" for each in missing)
        return _wrong(
            f"{file.path}: the first line holds numbers and {what}; name the columns by their numbers, 1 to "
            f"{len(file.names)}: --columns {numbers.replace(', ', ',')}"
        )
    free = [name for name in file.names if name not in found.values()]
    columns, units = dict(said.columns), {name: str(each) for name, each in said.units.items()}
    for channel in missing:
        guess = (nearest(said.column(channel), free) if channel in said.columns else None) or _guess(
            channel, free
        )
        columns[channel] = guess or "COLUMN"
        unit = _unit_in_name(guess, channel) if guess else None
        if guess:
            free.remove(guess)
        if unit is not None and channel not in units and unit != _own_unit(channel):
            units[channel] = f"{unit}:N" if _units_of(channel)[unit].per else unit
    shown = [*file.names[:12], *(["..."] if len(file.names) > 12 else [])]
    advice = option("--columns", columns) + (f" {option('--units', units)}" if units else "")
    per = [
        _units_of(channel)[text.removesuffix(":N")].per
        for channel, text in units.items()
        if text.endswith(":N")
    ]
    more = f" (N: the {per[0]})" if per else ""
    if "time" in missing and columns["time"] == "COLUMN":
        more += f", or time={ROW} and its step as the unit, time=4ms, for a file without a time"
    return _wrong(f"{_where(file)}: {what}; found {', '.join(shown)}; pass {advice}{more}")


def _guess(channel: str, names: Sequence[str]) -> str | None:
    """Returns the column that probably contains a channel, or None."""
    hints = _HINTS.get(channel, frozenset({channel}))
    words = {
        name: set(re.findall(r"[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()))
        for name in names
    }
    for name in sorted(words, key=lambda name: not any(len(each) > 2 for each in hints & words[name])):
        if hints & words[name] and not _OTHERS & words[name]:
            return name
    return nearest(CHANNELS[channel], [name for name in names if not _OTHERS & words[name]])


def _units(file: CsvFile, said: CsvColumns, found: Mapping[str, str]) -> tuple[dict[str, Unit], list[str]]:
    """Determines the unit of each channel (stated by the user, else by the file, else the default).

    Also returns the assumptions, as text.
    """
    units: dict[str, Unit] = {}
    remarks: list[str] = []
    for channel, name in found.items():
        if channel in said.units:
            units[channel] = said.units[channel]
            continue
        own = _own_unit(channel)
        known = _units_of(channel)
        cell = file.units.get(name, "").strip("[]() ")
        by_row = _canonical(cell, known) if cell else None
        if cell and by_row is None:
            raise _wrong(
                f"{file.path}:{file.header_line + 1}: '{cell}' of column '{name}' is not a known unit; "
                f"expected {_choices(known)}: pass {option('--units', {channel: 'UNIT'})}"
            )
        by_name = own if name == CHANNELS[channel] else _unit_in_name(name, channel)
        if by_row and by_name and by_row != by_name:
            raise _wrong(
                f"{file.path}:{file.header_line + 1}: column '{name}' is in {by_name} by its name, but in "
                f"{by_row} by the row of units; pass {_with_per({channel: by_row})} or "
                f"{_with_per({channel: by_name})}"
            )
        unit = by_row or by_name or own
        if known[unit].per:
            raise _wrong(
                f"{_where(file)}: column '{name}' is in {unit}; pass {_with_per({channel: unit})} with N the "
                f"{known[unit].per}"
            )
        units[channel] = Unit(unit, known[unit])
        if name != CHANNELS[channel]:
            remarks.append(f"'{name}' in {unit}")
    return units, remarks


def _with_per(units: Mapping[str, str]) -> str:
    return option(
        "--units",
        {channel: f"{unit}:N" if _units_of(channel)[unit].per else unit for channel, unit in units.items()},
    )


def _unwrapped(values: FloatArray, period: float, *, ordered: bool) -> FloatArray:
    """Unwraps a counter; ``ordered`` indicates a clock, which only runs forward."""
    if ordered:
        begins = np.diff(values, prepend=values[:1]) < 0.0
        clock: FloatArray = values + period * np.cumsum(begins)
        return clock
    return np.asarray(np.unwrap(values, period=period))


def _units_of(channel: str) -> Mapping[str, _Scale]:
    """Returns the units that a channel can have."""
    own = CHANNELS[channel].rpartition("_")[2]
    return UNITS.get(own, {own: _Scale(1.0)})


def _own_unit(channel: str) -> str:
    return next(iter(_units_of(channel)))


def _canonical(text: str, known: Mapping[str, _Scale]) -> str | None:
    bare = text.strip()
    for each in (bare, bare.lower(), _ALIASES.get(bare.lower(), "")):
        if each in known:
            return each
    return None


def _unit_in_name(name: str, channel: str) -> str | None:
    """Returns the unit at the end of a column's name, or None."""
    found = _IN_NAME.search(name)
    return _canonical(found[1] or found[2], _units_of(channel)) if found else None


def _choices(known: Mapping[str, _Scale]) -> str:
    words = [f"{name}:N" if scale.per else name for name, scale in known.items()]
    needs = next((scale.per for scale in known.values() if scale.per), "")
    return ", ".join(words) + (f" (N: the {needs})" if needs else "")


def _pairs(said: Said, where: str, what: str) -> dict[str, str]:
    """Parses ``channel=value,channel=value``; a value may contain commas and equals signs."""
    if said is None:
        return {}
    if isinstance(said, str):
        names = "|".join(CHANNELS)
        pieces = re.split(rf",(?=\s*(?:{names})\s*=)", said)
        given = [piece.partition("=") for piece in pieces]
    elif isinstance(said, Mapping):
        given = [(str(name), "=", str(value)) for name, value in said.items()]
    else:
        return {name: value for each in said for name, value in _pairs(each, where, what).items()}
    pairs: dict[str, str] = {}
    for name, equals, value in given:
        channel = name.strip()
        if channel not in CHANNELS:
            close = nearest(channel, list(CHANNELS))
            raise _wrong(
                f"{where}: '{channel}' is not a channel of a record; expected {', '.join(CHANNELS)}"
                + (f" (did you mean {close}?)" if close else "")
            )
        if not equals or not value.strip():
            raise _wrong(f"{where}: {channel}: expected {channel}={what}")
        if channel in pairs:
            raise _wrong(f"{where}: {channel} is given twice; expected it once")
        pairs[channel] = value.strip()
    return pairs


def _positive(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if 0.0 < value < math.inf else None


def _where(file: CsvFile) -> str:
    return f"{file.path}:{file.header_line}" if file.header_line else f"{file.path}"


def _wrong(text: str) -> InputError:
    return InputError(one_line(text))
