"""The page of a calibration: what was measured, what the model makes of it, and how far to trust it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hdbridge import __version__
from hdbridge.calibration import Calibration
from hdbridge.calibration.result import unit_of
from hdbridge.identify.result import Traces
from hdbridge.modeldiff import diff
from hdbridge.report.page import Block, Chart, Facts, Mark, Page, Section, Series, Table
from hdbridge.units import DEG_PER_TURN

SIGMA = "3\N{GREEK SMALL LETTER SIGMA}"
HIGHEST_ORDER = 16.0
"""Of the spectrum that is drawn."""


def calibration_page(result: Calibration) -> Page:
    """The page of a calibration, or of a fit of somebody's records."""
    traces = result.fit.traces
    sections = [
        Section(
            "Transmission error",
            "What the load encoder showed beyond the motor angle divided by the ratio, the zero taken off; "
            "dots are means over short stretches.",
            [*_by_angle(traces)],
        )
    ]
    if loops := [*_loops(traces)]:
        sections.append(
            Section(
                "Hysteresis loops",
                "The error over the motor angle as it goes back and forth, measured and by the model.",
                loops,
            )
        )
    sections += [
        Section("Spectrum", "Without hysteresis and zero.", [_spectrum(result)]),
        Section("What the model leaves", result.fit.held_out.text.capitalize() + ".", [*_residual(result)]),
        Section("Parameters", "", [_parameters(result)]),
    ]
    if result.validation is not None:
        sections.append(Section("Stepping test", _stepping_text(result), [*_stepping(result)]))
    sections.append(Section("Where it comes from", "", [_provenance(result)]))
    return Page(
        title=f"Calibration of axis '{result.axis}'"
        if result.axis
        else "Fit of " + ", ".join(result.recordings),
        verdict=_verdict(result),
        sections=sections,
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; {SIGMA} is three standard "
        "deviations about the mean; intervals are of 95 %.",
    )


def _verdict(result: Calibration) -> str:
    text = result.offer.reason if result.offer is not None else result.fit.held_out.text
    if result.fit.warnings:
        count = len(result.fit.warnings)
        text += ". Read the note below" if count == 1 else f". Read the {count} notes below"
    return text[:1].upper() + text[1:] + "."


def _by_angle(traces: Traces) -> Iterator[Chart]:
    for angle, label in (
        (np.mod(traces.motor_deg, DEG_PER_TURN), "motor angle within its turn, deg"),
        (traces.load_deg, "load angle, deg"),
    ):
        sweeps = _of_kind(traces, "sweep")
        chosen = sweeps if np.any(sweeps) else traces.direction != 0.0
        series = []
        for sign, name in ((1.0, "forward"), (-1.0, "backward")):
            rows = chosen & (traces.direction == sign)
            if np.any(rows):
                series.append(
                    Series(f"{name}, measured", angle[rows], traces.error_arcsec[rows], Mark.POINTS)
                )
        rows = chosen & (traces.direction != 0.0)
        if np.any(rows):
            series.append(Series("model", angle[rows], traces.predicted_arcsec[rows], Mark.POINTS))
            yield Chart(f"Error over the {label.split(',')[0]}", label, "error, arcsec", series)


def _loops(traces: Traces) -> Iterator[Chart]:
    """One chart for each sine or run of reversals, in the order measured."""
    for kind in ("sine", "reversal"):
        for rows in _runs(_of_kind(traces, kind)):
            motor = traces.motor_deg[rows]
            reach = 0.5 * float(np.ptp(motor))
            if reach < 0.5 or len(motor) < 8:
                continue
            centre = float(np.min(motor)) + reach
            series = [
                Series("measured", motor - centre, traces.error_arcsec[rows], Mark.POINTS),
                Series("model", motor - centre, traces.predicted_arcsec[rows]),
            ]
            caption = f"{kind.capitalize()} of {reach:.0f} deg about {centre:.0f} deg of the motor"
            yield Chart(caption, "motor angle, deg", "error, arcsec", series, height_px=280)


def _spectrum(result: Calibration) -> Chart:
    spectrum = result.fit.spectrum
    curve = spectrum.curve
    shown = curve.order <= HIGHEST_ORDER
    series = [Series("amplitude", curve.order[shown], curve.amplitude_arcsec[shown])]
    chosen = [each for each in result.fit.orders if each.order.per_motor_turn <= HIGHEST_ORDER]
    if chosen:
        orders = [each.order.per_motor_turn for each in chosen]
        series.append(Series("in the model", orders, [each.amplitude_arcsec for each in chosen], Mark.POINTS))
    lines = [each for each in spectrum.lines if each.order.per_motor_turn <= HIGHEST_ORDER]
    if lines:
        orders = [each.order.per_motor_turn for each in lines]
        thresholds = [each.threshold_arcsec for each in lines]
        series.append(Series("threshold of noise", orders, thresholds, Mark.POINTS))
    caption = (
        f"Orders per motor turn; {spectrum.resolution.turns:.0f} motor turns tell orders apart that are "
        f"{spectrum.resolution.nearest_orders:.3f} or more from each other"
    )
    return Chart(caption, "order, per motor turn", "amplitude, arcsec", series)


def _residual(result: Calibration) -> Iterator[Block]:
    traces, fit = result.fit.traces, result.fit
    for x, label in ((traces.time_s, "time, s"), (traces.load_deg, "load angle, deg")):
        series = [Series("residual", x, traces.residual_arcsec, Mark.POINTS)]
        caption = f"Residual over the {label.split(',')[0]}"
        yield Chart(caption, label, "residual, arcsec", series, height_px=240)
    noise = fit.noise
    yield Facts(
        [
            ("residual, rms of a sample", f"{noise.residual_arcsec:.2f} arcsec"),
            (
                "noise at rest",
                f"{noise.standing.rms_arcsec:.2f} arcsec" if noise.standing else "not measured",
            ),
            (
                "lap to lap",
                f"{noise.laps_arcsec:.2f} arcsec" if noise.laps_arcsec is not None else "not measured",
            ),
            ("samples", f"{noise.samples:,}, worth {noise.effective_samples:,.0f} independent ones"),
            ("given no weight", f"{fit.outliers.samples} samples that stand out alone"),
        ]
    )
    rows = [
        [each.name.replace("_", " "), "passed" if each.passed else "look", each.text]
        for each in fit.residual_tests
    ]
    yield Table(["test of the residual", "", ""], rows)
    if fit.warnings:
        yield Facts([("note", each) for each in fit.warnings])


def _parameters(result: Calibration) -> Table:
    before = (
        {(each.effect, each.parameter): each.before for each in diff(result.active, result.model)}
        if result.active is not None
        else {}
    )
    header = ["parameter", "value", "\N{PLUS-MINUS SIGN} 95 %", "unit", *(["active model"] if before else [])]
    rows: list[list[str | float]] = []
    for each in result.fit.intervals:
        row: list[str | float] = [f"{each.effect}: {each.parameter}"]
        if each.identifiable:
            row += [_number(each.value), _number(each.half_width)]
        else:
            row += [f"({_number(each.value)})", "not known"]
        row.append(unit_of(each.parameter))
        if before:
            was = before.get((each.effect, each.parameter))
            row.append(_number(was) if was is not None else "new")
        rows.append(row)
    return Table(header, rows)


def _stepping_text(result: Calibration) -> str:
    checked = result.validation
    assert checked is not None
    share = checked.after.pooled.three_sigma_arcsec / checked.floor.three_sigma_arcsec
    return (
        f"The axis stepped both ways, before and after. This axis's counts and noise allow {SIGMA} = "
        f"{checked.floor.three_sigma_arcsec:.2f} arcsec at best; with the new model it is at "
        f"{share:.2f} of that."
    )


def _stepping(result: Calibration) -> Iterator[Block]:
    checked = result.validation
    assert checked is not None
    rows: list[list[str | float]] = []
    for each in (checked.before, checked.after):
        row: list[str | float] = [each.model]
        for part in (each.cw, each.ccw, each.pooled):
            row += [part.three_sigma_arcsec, part.mean_arcsec]
        rows.append(row)
    yield Table(
        ["with", f"CW {SIGMA}", "mean", f"CCW {SIGMA}", "mean", f"pooled {SIGMA}", "mean"], rows, "arcsec"
    )
    for each in (checked.before, checked.after):
        series = [
            Series(name, targets, errors, Mark.POINTS)
            for name, targets, errors in zip(
                ("there (CW)", "back (CCW)"), each.targets_deg, each.errors_arcsec, strict=True
            )
        ]
        yield Chart(f"With {each.model}", "load target, deg", "load error, arcsec", series, height_px=240)


def _provenance(result: Calibration) -> Facts:
    rows = [("recording", each) for each in result.recordings]
    rows += [
        (name, value)
        for name, value in (("date", result.date), ("plan", result.plan), ("axis", result.axis))
        if value is not None
    ]
    rows += [("the plan gave up", each) for each in result.shortened]
    rows += [(name.replace("_", " "), _text(value)) for name, value in result.model.provenance.items()]
    return Facts(rows)


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return str(value)


def _number(value: float) -> str:
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def _of_kind(traces: Traces, kind: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    if kind not in traces.kind:
        return np.zeros(len(traces.time_s), dtype=np.bool_)
    chosen: np.ndarray[tuple[int], np.dtype[np.bool_]] = traces.kind_index == traces.kind.index(kind)
    return chosen


def _runs(chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Iterator[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(first, last)
