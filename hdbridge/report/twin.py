"""Report page of a twin: measured and simulated signals, errors of the simulation, fitted values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge import __version__
from hdbridge.axis.effects import FloatArray
from hdbridge.report.page import (
    Chart,
    Command,
    Facts,
    Grid,
    Heading,
    Mark,
    Page,
    Section,
    Series,
    Status,
    Table,
    sentence,
)
from hdbridge.twin.compare import ALL, TITLES, UNITS, Comparison, Row, Spectrum, Trace
from hdbridge.twin.misfit import ChannelResidual, Values
from hdbridge.twin.naming import Finding, InseparableSet
from hdbridge.twin.translate import Row as Translated
from hdbridge.units import figure

WINDOW_S: Final = 1.0
"""Duration shown in a detail chart."""
MEASURED, SIMULATED, BEFORE, DIFFERENCE = "measured", "simulated", "before", "difference"


@dataclass(frozen=True, slots=True)
class Learned:
    """A fitted parameter of the simulated plant."""

    name: str
    unit: str
    before: float | None
    """Value before the fit; None if it was only assumed."""
    after: float
    interval: tuple[float, float] | None
    """95 % interval; None if the value only replays the recording and is not that of the axis."""

    @property
    def text(self) -> str:
        """Description of the value as an estimate, in one line."""
        between = f" ({_figure(self.interval[0])} to {_figure(self.interval[1])})" if self.interval else ""
        return f"estimate: {self.name} {_figure(self.after)}{f' {self.unit}' if self.unit else ''}{between}"


@dataclass(frozen=True, eq=False)
class TwinReport:
    """Content of a twin's report page."""

    axis: str
    before: Comparison
    """Comparison of the measured record with the initial simulation."""
    after: Comparison | None = None
    """Comparison with the fitted simulation; None without a fit."""
    learned: Sequence[Learned] = ()
    named: Sequence[Finding | InseparableSet | ChannelResidual] = ()
    translated: Sequence[Translated] = ()
    facts: Sequence[tuple[str, str]] = ()
    verdict: str = ""
    """One sentence on the quality of the values and the outcome for the twin."""
    values: str = ""
    """Origin of the values (`hdbridge.twin.twin.Values`); empty without a fit."""
    channel_residuals: Sequence[ChannelResidual] = ()
    """Remaining difference of each channel."""
    commands: Sequence[Command] = ()
    status: Status = Status.MEASURED

    @property
    def now(self) -> Comparison:
        """Comparison with the fitted simulation, else with the initial one."""
        return self.after or self.before


def twin_page(report: TwinReport) -> Page:
    """Returns the page of a twin."""
    sections = [
        Section(
            "Differences between simulation and axis",
            "Each figure is the rms difference of the two records, sample by sample or stop by stop, also "
            "in units of the noise of the measured channel. Two equal axes differ by less than one.",
            [Table(*figures(report))],
        )
    ]
    if report.named:
        rows = [[each.cause, each.text] for each in report.named]
        sections.append(Section("Errors of the initial simulation", "", [Table(["cause", ""], rows)]))
    sections += [_pictures(name, report) for name in report.now.traces]
    sections.append(
        Section(
            "By kind of motion",
            "The same figures for the legs of each kind.",
            [Table(*figures(report, by_kind=True))],
        )
    )
    if report.learned:
        sections.append(
            Section(
                "What the plant is" if report.values == Values.AXIS else "Values of the replay",
                "Intervals are of 95 %."
                if report.values == Values.AXIS
                else "These values replay the recording. They are not the axis's, so they have no intervals.",
                [_learned(report.learned)],
            )
        )
    if report.translated:
        rows = [[each.effect, each.counterpart or "none", each.note] for each in report.translated]
        sections.append(
            Section(
                "From the model",
                "Translation of each effect of the axis's model to the simulated plant.",
                [Table(["effect", "path in the truth file", "differences"], rows)],
            )
        )
    if report.facts:
        sections.append(Section("Provenance", "", [Facts([*report.facts])]))
    return Page(
        title=f"Twin of axis '{report.axis}'",
        verdict=" ".join(
            each for each in (sentence(report.verdict) if report.verdict else "", verdict(report)) if each
        ),
        status=report.status,
        commands=report.commands,
        sections=sections,
        footer=f"hdbridge {__version__}. The load error is load angle minus motor angle over the ratio, in "
        "arcsec at the load; the following error is command minus motor angle. Both records have the same "
        "commands.",
    )


def verdict(report: TwinReport) -> str:
    """Returns one sentence on the differences in all signals."""
    parts = []
    for name in report.now.traces:
        now, before = report.now.row(name), report.before.row(name)
        if now is None or before is None:
            continue
        was = f" (before: {_figure(before.difference)})" if report.after is not None else ""
        noisy = math.isfinite(now.in_noise)
        times = f"{_figure(now.in_noise)} times the noise" if noisy else "without measurable noise"
        parts.append(f"{TITLES[name]} {_figure(now.difference)} {now.unit}{was}, {times}")
    return f"The simulated drive differs from the axis by, rms: {'; '.join(parts)}." if parts else ""


def _figure(value: float) -> str:
    return figure(value, 3)


def _title(row: Row) -> str:
    name, _, signal = row.channel.partition(":")
    return f"{TITLES[name]}, {TITLES[signal]}" if signal else TITLES[name]


def figures(report: TwinReport, *, by_kind: bool = False) -> tuple[list[str], list[list[str]]]:
    """Returns header and rows of a table of all channels, for the whole record or by kind of motion."""
    before = ["difference before"] if report.after is not None else []
    header = ["", "measured", "simulated", *before, "difference", "of the noise", "unit"]
    if not by_kind:
        return header, [_cells(report, row, _title(row)) for row in report.now.rows if row.kind == ALL]
    kinds = [kind for kind in dict.fromkeys(row.kind for row in report.now.rows) if kind != ALL]
    rows = [
        _cells(report, row, f"{kind}: {_title(row)}")
        for kind in kinds
        for row in report.now.rows
        if row.kind == kind and ":" not in row.channel
    ]
    return header, rows


def _cells(report: TwinReport, row: Row, title: str) -> list[str]:
    cells = [title, _figure(row.measured), _figure(row.simulated)]
    if report.after is not None:
        before = report.before.row(row.channel, row.kind)
        cells.append(_figure(before.difference) if before is not None else "")
    in_noise = _figure(row.in_noise) if math.isfinite(row.in_noise) else ""
    return [*cells, _figure(row.difference), in_noise, row.unit]


def _learned(learned: Sequence[Learned]) -> Table:
    rows: list[list[str | float]] = [
        [
            each.name,
            _figure(each.before) if each.before is not None else "",
            _figure(each.after),
            f"{_figure(each.interval[0])} to {_figure(each.interval[1])}" if each.interval else "none",
            each.unit,
        ]
        for each in learned
    ]
    return Table(["", Heading("before", ""), Heading("now", ""), Heading("95 %", ""), "unit"], rows)


def _pictures(name: str, report: TwinReport) -> Section:
    """Returns the charts of one signal: whole record, largest deviation, difference, spectrum."""
    trace, before = report.now.traces[name], report.before.traces[name]
    label = f"{TITLES[name]}, {UNITS[name]}"
    worst = _worst(before)
    grid = Grid(
        [
            _chart(f"{TITLES[name].capitalize()} over the whole record", label, trace, slice(None)),
            _chart(
                "Largest deviation of the initial simulation"
                if report.after
                else "Largest deviation of the simulation",
                label,
                trace,
                worst,
                before if report.after else None,
            ),
            _difference(f"Difference, {label}", before, trace if report.after else None),
            *_spectrum(name, report.now.spectra.get(name)),
        ]
    )
    return Section(TITLES[name].capitalize(), "", [grid])


def _chart(caption: str, label: str, trace: Trace, where: slice, before: Trace | None = None) -> Chart:
    time_s = trace.time_s[where]
    series = [Series(MEASURED, time_s, trace.measured[where], colour=0)]
    if before is not None:
        series.append(Series(BEFORE, time_s, before.simulated[where], Mark.DASHED, colour=2))
    series.append(Series(SIMULATED, time_s, trace.simulated[where], Mark.DASHED, colour=1))
    return Chart(caption, "time, s", label, series, height_px=260)


def _difference(caption: str, before: Trace, after: Trace | None) -> Chart:
    series = [Series(BEFORE if after is not None else DIFFERENCE, before.time_s, before.difference, colour=2)]
    if after is not None:
        series.append(Series("now", after.time_s, after.difference, colour=1))
    return Chart(caption, "time, s", "measured minus simulated", series, height_px=260)


def _spectrum(name: str, spectrum: Spectrum | None) -> list[Chart]:
    if spectrum is None:
        return []
    inside = spectrum.frequency_hz > 0.0
    x = spectrum.frequency_hz[inside]
    by_name: Mapping[str, FloatArray] = {
        MEASURED: spectrum.measured, SIMULATED: spectrum.simulated, DIFFERENCE: spectrum.difference,
    }  # fmt: skip
    series = [
        Series(label, x, values[inside], Mark.DASHED if label == DIFFERENCE else Mark.LINE, colour=colour)
        for colour, (label, values) in enumerate(by_name.items())
    ]
    label = f"{UNITS[name]} per root Hz"
    return [Chart("Spectrum", "frequency, Hz", label, series, height_px=260, x_log=True, y_log=True)]


def _worst(trace: Trace) -> slice:
    """Returns the rows of the window of `WINDOW_S` with the largest difference."""
    time_s = trace.time_s
    ends = np.searchsorted(time_s, time_s + WINDOW_S)
    power = np.concatenate([[0.0], np.cumsum(trace.difference**2)])
    begin = int(np.argmax(power[ends] - power[: len(time_s)]))
    return slice(begin, int(ends[begin]))
