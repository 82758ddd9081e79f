"""Charts of residuals over all coordinates, and of the partial residual of a finding."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.analysis.findings import Diagnosis, Finding, Traces
from hdbridge.analysis.views import ResidualViews, coordinates
from hdbridge.axis.effects import CATALOGUE, BoolArray, Effect, FloatArray, IntArray, Part
from hdbridge.axis.effects.coordinate import Coordinate, Spacing, time
from hdbridge.axis.model import TransmissionModel
from hdbridge.report.page import Chart, Mark, Series, histogram, parted, sampled, thinned

LEAST_IN_BIN: Final = 3
"""Minimum number of points in a bin; bins with fewer points are not shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Means over bins of a coordinate that contain enough points; arrays of equal length."""

    place: FloatArray
    """Mean of the coordinate in each bin."""
    mean: FloatArray
    spread: FloatArray
    """Standard deviation of the points in each bin (not of their mean)."""
    count: IntArray


def binned(
    coordinate: Coordinate, y: FloatArray, rows: BoolArray | None = None, least: int = LEAST_IN_BIN
) -> Bins:
    """Returns the means of y over a coordinate, using only ``rows`` if given.

    Bins with fewer than ``least`` points are omitted.
    """
    number, x = coordinate.numbers(), coordinate.values
    if rows is not None:
        number, x, y = number[rows], x[rows], y[rows]
    count = np.bincount(number)
    kept = np.flatnonzero(count >= least)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(number, values, len(count))[kept] / count[kept])

    middle = mean(y)
    spread = np.sqrt(np.maximum(mean(y**2) - middle**2, 0.0))
    return Bins(mean(x), middle, np.asarray(spread), count[kept])


LEAST_POINTS: Final = 200
"""Minimum number of points in the stretch that shows the finding for drawing only these; else all are
drawn."""
SEEN_BINS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """Change of a model part's scale factor over a coordinate, bin by bin; arrays of equal length."""

    of: str
    """Name of the scaled part."""
    place: FloatArray
    measured_percent: FloatArray
    spread_percent: FloatArray
    """Standard deviation of the measured value, assuming white noise."""
    finding_percent: FloatArray
    """Change of the scale factor according to the finding."""


@dataclass(frozen=True, slots=True, eq=False)
class PartialResidual:
    """Partial residual of a finding over its coordinate; arrays of shape (m,), like those of `Traces`."""

    coordinate: Coordinate
    residual_arcsec: FloatArray
    """Measurement minus the extended model without this finding."""
    own_arcsec: FloatArray | None
    """Contribution of the finding; None for an unexplained residual, which has no law."""
    rows: BoolArray
    """Mask of the points that show the finding."""
    forward: BoolArray
    """True if the last motion was forward."""
    strength: Strength | None = None


def partial_residual(finding: Finding, diagnosis: Diagnosis) -> PartialResidual:
    """Computes the partial residual of one finding of a diagnosis."""
    traces = diagnosis.traces
    effect = _in_model(finding, diagnosis.model)
    own = None if effect is None else _does(effect, traces)
    left = traces.measured_arcsec - traces.extended_arcsec
    home = _home(finding, traces, diagnosis.model.ratio)
    rows = np.ones(len(left), dtype=np.bool_)
    stretch = None if effect is None else effect.shows(traces.motion)
    if stretch is not None and np.count_nonzero(stretch.rows[traces.rows]) >= LEAST_POINTS:
        rows = stretch.rows[traces.rows]
    residual = left if own is None else left + own
    forward = traces.direction > 0.0
    strength = _strength(effect, traces, home, residual, own)
    return PartialResidual(home, residual, own, rows, forward, strength)


def _in_model(finding: Finding, model: TransmissionModel) -> Effect | None:
    """Returns the finding's effect as contained in the extended model, so that chart and model agree."""
    effect = finding.effect
    if effect is None or (finding.within and effect.changes is not Part.LOOP):
        return effect
    return effect.found_in(model.effects)


def _does(effect: Effect, traces: Traces) -> FloatArray:
    """Returns the contribution of an effect at the points of the traces, arcsec, shape (m,)."""
    does = traces.predict(effect)
    if effect.replaces in CATALOGUE:  # it replaces another effect
        does = does - traces.predict(CATALOGUE[effect.replaces].model_validate(effect.parameters()))
    return does


def _home(finding: Finding, traces: Traces, ratio: float) -> Coordinate:
    """Returns the coordinate of a finding: that of its effect, else that on which the residual depends."""
    if finding.effect is not None:
        own = finding.effect.coordinate(traces.motion, ratio).at(traces.rows)
        return own if own.varies() else time(traces.motion).at(traces.rows)
    known = coordinates(traces.motion, traces.rows, ratio)
    name = finding.lives_in.removesuffix(" and direction")
    if name in known:
        apart = known[name].both_ways and ("direction" in finding.lives_in or "reversal" in name)
        return replace(known[name], both_ways=apart)
    return known["time"]


def _strength(
    effect: Effect | None, traces: Traces, home: Coordinate, residual: FloatArray, own: FloatArray | None
) -> Strength | None:
    scaled = None if effect is None else effect.scales()
    if scaled is None or own is None:
        return None
    part = traces.predict(scaled[1])
    coarse = replace(home, bins=SEEN_BINS)
    number = coarse.numbers()
    square = np.bincount(number, part**2)
    size = float(np.sqrt(np.mean(part**2)))
    kept = square > 50.0 * (0.1 * size) ** 2  # bins in which the part is large enough
    noise = float(np.std(residual - own))

    def percent(y: FloatArray) -> FloatArray:
        return np.asarray(100.0 * np.bincount(number, y * part, len(square))[kept] / square[kept])

    place = np.bincount(number, coarse.values, len(square))[kept] / np.bincount(number)[kept]
    return Strength(
        scaled[0].value, place, percent(residual), 100.0 * noise / np.sqrt(square[kept]), percent(own)
    )


R_LABEL: Final = "residual, arcsec"
E_LABEL: Final = "error, arcsec"
CLOUD: Final = 2500
"""Maximum number of raw points in a partial residual chart."""
SMALL_CLOUD: Final = 1200
"""Maximum number of raw points in a small chart."""
LINE_POINTS: Final = 2000
FINER: Final = 3
"""Number of bins of a finding's curve for each bin of the means."""
CLOSER_POINTS: Final = 400
MORE_TURNS_DEG: Final = 540.0
"""Minimum load travel for a chart over position; with less, it adds little to that over the load angle."""
BLUE: Final = 0
ORANGE: Final = 1
GREEN: Final = 2
FORWARD, BACKWARD = "forward", "backward"


def partial_residual_chart(partial_residual: PartialResidual) -> Chart:
    """Returns a chart of raw points, means with their spread, and the finding's contribution."""
    if partial_residual.strength is not None:
        return _strength_chart(partial_residual.strength, partial_residual.coordinate)
    home, residual, own = (
        partial_residual.coordinate,
        partial_residual.residual_arcsec,
        partial_residual.own_arcsec,
    )
    rows = partial_residual.rows
    series = [_cloud("readings", home.values[rows], residual[rows], CLOUD)]
    ways = _ways(partial_residual.forward, rows) if home.both_ways else [("", BLUE, rows)]
    for way, colour, chosen in ways:
        means = binned(home, residual, chosen)
        name = f"mean, {way}" if way else "mean"
        series.append(Series(name, means.place, means.mean, Mark.POINTS, spread=means.spread, colour=colour))
    if own is not None:
        fine = replace(home, bins=FINER * home.bins)
        for way, colour, chosen in ways:
            curve = binned(fine, own, chosen, least=1)
            name = f"the finding, {way}" if way else "the finding"
            series.append(Series(name, curve.place, curve.mean, colour=colour if way else ORANGE))
    shown = residual[rows] if own is None else np.concatenate([residual[rows], own[rows]])
    return Chart(
        f"{'Unexplained residual' if own is None else 'Residual without it'}, over the {home.name}",
        home.label,
        R_LABEL,
        series,
        height_px=360,
        y_range=_reach(shown),
        x_log=home.spacing is Spacing.LOGARITHMIC,
    )


def _strength_chart(strength: Strength, home: Coordinate) -> Chart:
    series = [
        Series(
            "measured, each bin separately",
            strength.place,
            strength.measured_percent,
            Mark.POINTS,
            spread=strength.spread_percent,
        ),
        Series("the finding", strength.place, strength.finding_percent),
    ]
    words = f"hange of the {strength.of}"
    return Chart(f"C{words}, over the {home.name}", home.label, f"c{words}, %", series, height_px=360)


def residual_charts(seen: ResidualViews) -> Iterator[Chart]:
    """Yields a chart of the residuals of given and extended model over each coordinate, all to one scale."""
    reach = _reach(seen.given_arcsec)
    shares = seen.shares()
    forward = seen.direction > 0.0
    everywhere = np.ones_like(forward)
    for name, _ in sorted(shares.items(), key=lambda each: -each[1][0]):
        home = seen.coordinates[name]
        few_turns = name == "position" and float(np.ptp(home.values)) < MORE_TURNS_DEG
        if name == "direction" or few_turns:
            continue
        series = [_cloud("readings, as given", home.values, seen.given_arcsec, SMALL_CLOUD)]
        for words, colour, values in (
            ("as given", ORANGE, seen.given_arcsec),
            ("extended", BLUE, seen.left_arcsec),
        ):
            ways = _ways(forward, everywhere) if home.both_ways else [("", colour, everywhere)]
            for way, _, chosen in ways:
                means = binned(home, values, chosen)
                series.append(
                    Series(
                        f"{words}, {way}" if way else words,
                        means.place,
                        means.mean,
                        Mark.DASHED if way == BACKWARD else Mark.LINE,
                        colour=colour,
                    )
                )
        yield Chart(
            f"Over the {name}",
            home.label,
            R_LABEL,
            series,
            height_px=230,
            y_range=reach,
            x_log=home.spacing is Spacing.LOGARITHMIC,
        )
    groups = {way: seen.given_arcsec[rows] for way, _, rows in _ways(forward, everywhere)}
    yield histogram("Residual histogram by direction, as given", R_LABEL, groups, bins=40, height_px=230)


def beside_charts(traces: Traces) -> Iterator[Chart]:
    """Yields charts of models and measurement over time: the whole record, and the part with most gain."""
    whole = np.arange(len(traces.time_s))
    given = (traces.measured_arcsec - traces.model_arcsec) ** 2
    left = (traces.measured_arcsec - traces.extended_arcsec) ** 2
    length = min(CLOSER_POINTS, len(whole))
    gained = np.concatenate([[0.0], np.cumsum(given - left)])
    first = int(np.argmax(gained[length:] - gained[:-length]))
    stretches = [("The whole record", whole)]
    if length < len(whole):
        stretches.append(("Closer: where the extended model gains most", whole[first : first + length]))
    for caption, rows in stretches:
        time = traces.time_s[rows]
        lines = [
            Series(name, *thinned(time, parted(values[rows], time), LINE_POINTS), colour=colour)
            for name, colour, values in (
                ("the model as given", ORANGE, traces.model_arcsec),
                ("the extended model", BLUE, traces.extended_arcsec),
            )
        ]
        dots = Series(
            "measured", *sampled(time, traces.measured_arcsec[rows], LINE_POINTS), Mark.POINTS, colour=GREEN
        )
        dots_on_top = len(time) <= CLOSER_POINTS
        yield Chart(
            caption, "time, s", E_LABEL, [*lines, dots] if dots_on_top else [dots, *lines], height_px=280
        )


def _cloud(label: str, x: FloatArray, y: FloatArray, most: int) -> Series:
    """Returns at most ``most`` points, chosen at random but reproducibly, to preserve the cloud's shape."""
    if len(x) > most:
        kept = np.sort(np.random.default_rng(0).choice(len(x), most, replace=False))
        label, x, y = f"{label} ({most:,} of {len(x):,})", x[kept], y[kept]
    return Series(label, x, y, Mark.FAINT)


def _ways(forward: BoolArray, rows: BoolArray) -> list[tuple[str, int, BoolArray]]:
    """Returns name, colour and mask of the points for each direction of motion that has points."""
    both = ((FORWARD, BLUE, rows & forward), (BACKWARD, ORANGE, rows & ~forward))
    return [each for each in both if np.any(each[2])]


def _reach(values: FloatArray) -> tuple[float, float]:
    """Returns an axis range that excludes the outermost 0.4 % of the values, with a margin."""
    low, high = np.quantile(values, [0.002, 0.998]).tolist()
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin
