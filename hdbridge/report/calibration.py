"""Report page of a calibration: measurements, fitted model, and uncertainty of the model."""

import math
import re
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from scipy.stats import binned_statistic

from hdbridge import __version__
from hdbridge.analysis.identification import Traces
from hdbridge.axis.effects import FloatArray
from hdbridge.axis.model.difference import diff
from hdbridge.commissioning.calibration import Calibration
from hdbridge.errors import command
from hdbridge.report.motion import motion_sections
from hdbridge.report.page import (
    SIGMA,
    Block,
    Chart,
    Command,
    Facts,
    Grid,
    Mark,
    Page,
    Section,
    Series,
    Status,
    Table,
    histogram,
    parted,
    sentence,
)
from hdbridge.report.stepping import of_offer, stepping_sections
from hdbridge.units import DEG_PER_TURN, figure, unit_of, with_interval, without_unit

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]

Y_LABEL: Final = "error, arcsec"
TURN_LABEL: Final = "motor angle within its turn, deg"
LOAD_LABEL: Final = "load angle, deg"
R_LABEL: Final = "residual, arcsec"
HIGHEST_ORDER: Final = 16.0
"""Highest order in the spectrum chart."""
BINS_PER_TURN: Final = 128


def calibration_page(result: Calibration) -> Page:
    """Returns the page of a calibration or a fit: the result first, then the evidence."""
    traces = result.fit.traces
    sections = []
    if result.validation is not None:
        sections += stepping_sections(result.validation)
    if result.motion is not None:
        sections += motion_sections(result.motion)
    sections += [
        Section(
            "Parameters",
            ""
            if all(each.identifiable for each in result.fit.intervals)
            else "In brackets: not determined by these data.",
            [*parameters(result)],
        ),
        Section(
            "Transmission error",
            "Load encoder angle minus motor angle divided by the ratio, without the zero offset; dots are "
            "means over short stretches.",
            [Grid([*_by_angle(traces, result.model.ratio)])],
        ),
    ]
    if loops := [*_loops(traces)]:
        sections.append(
            Section(
                "Hysteresis loops",
                "The error over the motor angle in back-and-forth motion, measured and from the model.",
                [Grid(loops, columns=3 if len(loops) > 2 else 2)],
            )
        )
    sections += [
        Section(
            "Spectrum",
            "Amplitudes by least squares at the true angles, without hysteresis and zero offset. Bars: the "
            "orders fitted together; those below the threshold cannot be distinguished from noise. Line: "
            "each order fitted alone, which also shows the side lobes of its neighbours.",
            [_spectrum(result)],
        ),
        Section("Residual of the model", "", [*_residual(result)]),
    ]
    if len(result.drift) > 1:
        sections.append(_drift(result))
    sections.append(Section("Provenance", "", [_provenance(result)]))
    status, commands = _status(result)
    return Page(
        title=f"Calibration of axis '{result.axis}'"
        if result.axis
        else "Fit of " + ", ".join(result.recordings),
        verdict=_verdict(result),
        status=status,
        commands=commands,
        sections=sections,
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; {SIGMA} is three standard "
        "deviations about the mean; intervals are of 95 %.",
    )


def _status(result: Calibration) -> tuple[Status, tuple[Command, ...]]:
    if result.offer is not None:
        return of_offer(result.offer)
    line = command("diagnose", *result.recordings, "--model", "MODEL.yaml")
    return Status.MEASURED, (Command(line, "lists the causes that the fitted model lacks"),)


def _verdict(result: Calibration) -> str:
    offer, checked = result.offer, result.validation
    text = "" if checked is None else sentence(checked.summary)
    if checked is None or offer is None or not offer.made or checked.worse:
        reason = sentence(offer.reason if offer is not None else result.fit.held_out.text)
        text = f"{text} {reason}".strip()
    if notes := len(result.fit.warnings):
        text += f" Read the {'note' if notes == 1 else f'{notes} notes'} under 'Residual of the model'."
    return text


def _by_angle(traces: Traces, ratio: float) -> Iterator[Chart]:
    """Yields a chart over the motor angle with the model, and one over the load angle with means per turn."""
    sweeps = _of_kind(traces, "sweep")
    chosen = (sweeps if np.any(sweeps) else np.ones_like(sweeps)) & (traces.direction != 0.0)
    if not np.any(chosen):
        return
    motor, load = np.mod(traces.motor_deg, DEG_PER_TURN), traces.load_deg
    for angle, drawn, width_deg, statistic, kind, name, unit in (
        (motor, traces.predicted_arcsec, 2.0, "median", "model", "motor angle", TURN_LABEL),
        (load, traces.error_arcsec, DEG_PER_TURN / ratio, "mean", "mean", "load angle", LOAD_LABEL),
    ):
        series = _both_ways(traces, angle, traces.error_arcsec, chosen)
        for sign, way in ((1.0, "forward"), (-1.0, "backward")):
            rows = chosen & (traces.direction == sign)
            if np.any(rows):
                x, y = _over(angle[rows], drawn[rows], width_deg, statistic)
                series.append(Series(f"{kind}, {way}", x, y))
        yield Chart(f"Error over the {name}", unit, Y_LABEL, series)


def _over(x: FloatArray, y: FloatArray, width: float, statistic: str) -> tuple[FloatArray, FloatArray]:
    """Returns the "mean" or "median" of y in intervals of x; intervals without samples become gaps."""
    edges = float(np.min(x)) + width * np.arange(int(np.ptp(x) / width) + 2)
    values: FloatArray = binned_statistic(x, y, statistic, edges).statistic
    return np.asarray(edges[:-1] + 0.5 * width), values


def _both_ways(traces: Traces, x: FloatArray, y: FloatArray, chosen: BoolArray) -> list[Series]:
    """Returns one series of the chosen samples per direction; omits a direction without samples."""
    ways = (("forward", chosen & (traces.direction > 0.0)), ("backward", chosen & (traces.direction < 0.0)))
    return [Series(name, x[rows], y[rows], Mark.POINTS) for name, rows in ways if np.any(rows)]


def _loops(traces: Traces) -> Iterator[Chart]:
    """Yields one chart for each sine or run of reversals, in the order of measurement."""
    for kind, words in (("sine", "Sine"), ("reversal", "Reversals")):
        runs = [(rows, traces.motor_deg[rows]) for rows in _runs(_of_kind(traces, kind))]
        runs = [each for each in runs if len(each[1]) >= 8 and np.ptp(each[1]) >= 1.0]
        for number, (rows, motor) in enumerate(runs, 1):
            reach = 0.5 * float(np.ptp(motor))
            centre = float(np.min(motor)) + reach
            caption = f"{words} of \N{PLUS-MINUS SIGN}{reach:.0f} deg"
            if kind == "reversal" and len(runs) > 1:
                caption += f", {number} of {len(runs)}"
            series = [
                Series("measured", motor - centre, traces.error_arcsec[rows], Mark.POINTS),
                Series("model", motor - centre, parted(traces.predicted_arcsec[rows], traces.time_s[rows])),
            ]
            label = f"motor angle \N{MINUS SIGN} {centre:.0f}, deg" if round(centre) else "motor angle, deg"
            yield Chart(caption, label.replace("\N{MINUS SIGN} -", "+ "), Y_LABEL, series, height_px=230)


def _spectrum(result: Calibration) -> Chart:
    series = [Series("one order alone", *_alone(result.fit.traces))]
    lines = sorted(
        (each for each in result.fit.spectrum if each.order.per_motor_turn <= HIGHEST_ORDER),
        key=lambda each: each.order.per_motor_turn,
    )
    if lines:
        orders = [each.order.per_motor_turn for each in lines]
        together = [each.amplitude_arcsec for each in lines]
        series.append(Series("orders together", orders, together, Mark.BARS, bar_width=0.12))
        thresholds = [each.threshold_arcsec for each in lines]
        series.append(Series("threshold", orders, thresholds, Mark.DASHED))
    chosen = [each for each in result.fit.orders if each.order.per_motor_turn <= HIGHEST_ORDER]
    if chosen:
        orders = [each.order.per_motor_turn for each in chosen]
        series.append(Series("in the model", orders, [each.amplitude_arcsec for each in chosen], Mark.POINTS))
    turns = float(np.ptp(result.fit.traces.motor_deg)) / DEG_PER_TURN
    caption = f"Orders per motor turn; {turns:.0f} motor turns distinguish orders that are "
    caption += f"{1.0 / turns if turns else math.inf:.3f} or more apart"
    return Chart(caption, "order, per motor turn", "amplitude, arcsec", series, y_log=True)


def _alone(traces: Traces) -> tuple[FloatArray, FloatArray]:
    """Returns orders and amplitudes of the error for display, from an FFT over equal bins of the motor angle.

    Empty bins count as zero, and the amplitudes are corrected for the fraction of filled bins.
    """
    moving = traces.direction != 0.0
    shown = moving if np.mean(moving) > 0.5 else np.ones_like(moving)
    motor, error = traces.motor_deg[shown], traces.orders_arcsec[shown]
    turns = max(math.ceil(float(np.ptp(motor)) / DEG_PER_TURN), 1)
    edges = np.min(motor) + DEG_PER_TURN / BINS_PER_TURN * np.arange(turns * BINS_PER_TURN + 1)
    filled, total = np.histogram(motor, edges)[0], np.histogram(motor, edges, weights=error)[0]
    binned = total / np.maximum(filled, 1)
    # Averaging over a bin attenuates high orders; division by the sinc function corrects this.
    order = np.fft.rfftfreq(len(binned), 1.0 / BINS_PER_TURN)
    lines = np.abs(np.fft.rfft(binned)) / np.count_nonzero(filled) / np.sinc(order / BINS_PER_TURN)
    below = order <= HIGHEST_ORDER
    return np.asarray(order[below], dtype=np.float64), np.asarray(2.0 * lines[below])


def _residual(result: Calibration) -> Iterator[Block]:
    traces, fit = result.fit.traces, result.fit
    left = traces.residual_arcsec
    yield Chart(
        "Residual over time", "time, s", R_LABEL, [Series("residual", traces.time_s, left, Mark.POINTS)], 220
    )
    moving = traces.direction != 0.0
    motor = np.mod(traces.motor_deg, DEG_PER_TURN)
    yield Grid(
        [
            Chart(f"Residual over the {name}", label, R_LABEL, _both_ways(traces, angle, left, moving), 240)
            for name, angle, label in (
                ("motor angle", motor, TURN_LABEL),
                ("load angle", traces.load_deg, LOAD_LABEL),
            )
        ]
    )
    yield histogram("Residual histogram", R_LABEL, {"residual": left}, height_px=200)
    yield fit_facts(result)
    rows = [
        [each.name.replace("_", " "), "passed" if each.passed else "look", each.text]
        for each in fit.residual_tests
    ]
    yield Table(["test of the residual", "", "result"], rows)


def fit_facts(result: Calibration) -> Facts:
    """Returns the figures of the fit, its test on held-out data, failed tests of the residual, and notes."""
    fit, noise = result.fit, result.fit.noise

    def arcsec(value: float | None) -> str:
        return "not measured" if value is None else f"{value:.2f} arcsec"

    rows = [
        ("held out", fit.held_out.text),
        ("residual of the model, rms of a sample", arcsec(noise.residual_arcsec)),
        ("... with the terms fitted in addition", arcsec(noise.fitted_arcsec)),
        ("noise at rest", arcsec(noise.standing_arcsec)),
        ("lap to lap", arcsec(noise.laps_arcsec)),
        ("samples", f"{noise.samples:,}, worth {noise.effective_samples:,.0f} independent ones"),
        ("outliers", f"{fit.outliers.samples} samples, given no weight"),
    ]
    if len(result.drift) > 1:
        errors = [error for _, error in result.drift]
        moved = f"{max(errors) - min(errors):.2f} arcsec"
        rows.append(("reference pose", f"zero position moved by {moved} over {len(errors)} visits"))
    rows += [("residual", each.text) for each in fit.residual_tests if not each.passed]
    return Facts([*rows, *(("note", each) for each in fit.warnings)])


def parameters(result: Calibration) -> Iterator[Block]:
    """Yields a table of the model's parameters, and one of the quantities fitted in addition."""
    changes = diff(result.active, result.model) if result.active is not None else []
    before = {(each.effect, each.parameter): each.before for each in changes}
    header = ["parameter", "value", "\N{PLUS-MINUS SIGN} 95 %", "unit"]
    if before:
        header += ["active model", "change"]
    rows: list[list[str | float]] = []
    for each in result.fit.intervals:
        row: list[str | float] = [_parameter_words(each.effect, each.parameter)]
        if each.identifiable:
            row += with_interval(each.value, each.half_width)
        else:
            row += [f"({figure(each.value)})", "not known"]
        unit = unit_of(each.parameter)
        row.append("" if unit == "1" else unit)
        if before:
            was = before.get((each.effect, each.parameter))
            row += ["new", ""] if was is None else [figure(was), _change(each.value - was, each.parameter)]
        rows.append(row)
    yield Table(header, rows)
    if result.fit.nuisances:
        fitted: list[list[str | float]] = [
            [each.text, *with_interval(each.value, each.half_width), each.unit]
            for each in result.fit.nuisances
        ]
        yield Table(
            ["in addition to the model", "value", "\N{PLUS-MINUS SIGN} 95 %", "unit"],
            fitted,
            "Fitted as well, so that it does not bias the parameters; not part of the model.",
        )


def _parameter_words(effect: str, parameter: str) -> str:
    """Formats ``orders[2].amplitude_arcsec`` of synchronous as "synchronous, order 2: amplitude"."""
    words = re.sub(r"^orders\[(\d+)\]\.", r"order \1: ", without_unit(parameter)).replace("_", " ")
    return f"{effect.replace('_', ' ')}, {words}" if ": " in words else f"{effect.replace('_', ' ')}: {words}"


def _change(change: float, parameter: str) -> str:
    if parameter.endswith("phase_deg"):
        change = math.remainder(change, DEG_PER_TURN)
    return f"{change:+.3g}"


def _drift(result: Calibration) -> Section:
    times, errors = zip(*result.drift, strict=True)
    text = "The axis returned to one pose several times, always from the same side."
    series = [Series("error at the pose", times, errors), Series("visits", times, errors, Mark.POINTS)]
    chart = Chart("Error at the reference pose", "time, s", Y_LABEL, series, height_px=200)
    return Section("Reference pose", text, [chart])


def _provenance(result: Calibration) -> Facts:
    rows = [("recording", each) for each in result.recordings]
    rows += [
        (name, value)
        for name, value in (("date", result.date), ("plan", result.plan), ("axis", result.axis))
        if value is not None
    ]
    rows += [("shortened parts of the plan", each) for each in result.shortened]
    rows += [(name.replace("_", " "), _text(value)) for name, value in result.model.provenance.items()]
    return Facts(rows)


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return str(value)


def _of_kind(traces: Traces, kind: str) -> BoolArray:
    if kind not in traces.kind:
        return np.zeros(len(traces.time_s), dtype=np.bool_)
    chosen: BoolArray = traces.kind_index == traces.kind.index(kind)
    return chosen


def _runs(chosen: BoolArray) -> Iterator[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(first, last)
