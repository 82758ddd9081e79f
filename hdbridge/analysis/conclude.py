"""Covariance, residual tests, held-out test and result of an identification.

Under the noise model, the covariance of a fit is the inverse information matrix. If the noise model is wrong,
the scores of longer stretches of time vary more than the model predicts. A sandwich estimate over stretches
(Liang and Zeger 1986) measures this variation and replaces the model's variance wherever it is larger. The
rounding error of a harmonic is constant along a sweep but differs in the next. For harmonics, whole legs
therefore also serve as stretches. Because legs are few, all harmonics are pooled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from hdbridge.analysis.blocks import Blocks, Design, clusters
from hdbridge.analysis.gain import RECORDINGS, Gain
from hdbridge.analysis.identification import (
    FitResult,
    HeldOut,
    NoiseFigures,
    Nuisance,
    ResidualTest,
    State,
    Traces,
    laps_arcsec,
    standing_arcsec,
)
from hdbridge.analysis.intervals import NORMAL_95, Interval, intervals_of, nested_half_widths
from hdbridge.analysis.linear import (
    Linearised,
    about_zeros,
    counted,
    inverse_symmetric,
    sandwich,
    steps_without,
    sums,
)
from hdbridge.analysis.noise import NoiseModel, Precision
from hdbridge.analysis.nuisances import DELAY, TEXTS, UNITS, delay_column, is_turn
from hdbridge.analysis.orders import Family, Line, Order, System, spectrum
from hdbridge.analysis.separable import Solution
from hdbridge.axis.effects import FloatArray, IntArray, Part
from hdbridge.axis.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

CLUSTERS = 100
"""Approximate number of stretches for the sandwich estimate."""


def covariance(solution: Solution, precision: Precision, blocks: Blocks) -> FloatArray:
    """Returns the covariance of the solution's parameters, one per column, shape (p, p)."""
    model = inverse_symmetric(solution.information)
    number = clusters(blocks, CLUSTERS)
    # Turning-point columns describe noise. Each lies in a single stretch, so their scores are meaningless.
    main = [at for at, column in enumerate(solution.columns) if not is_turn(column.name)]
    if int(number[-1]) + 1 < 2 * len(main):
        return model
    inner = model[np.ix_(main, main)]
    weighted = precision.apply(solution.residual)
    spread = sandwich(solution.jacobian[:, main] @ inner * weighted[:, np.newaxis], number)
    widen = np.ones(len(model))
    widen[main] = np.sqrt(np.maximum(np.diag(spread) / np.maximum(np.diag(inner), 1e-300), 1.0))
    orders = {at for at, each in enumerate(solution.effects) if each.part is Part.ORDERS}
    waves = [at for at, each in enumerate(solution.columns) if each.effect in orders]
    if waves:
        between = math.sqrt(_between_legs(solution.jacobian[:, waves], precision, solution.residual, blocks))
        widen[waves] = np.maximum(widen[waves], between)
    return np.asarray(model * np.outer(widen, widen))


def of_effect(solution: Solution, index: int, cov: FloatArray) -> list[Interval]:
    """Returns the confidence intervals of one effect's parameters, from the solution's covariance ``cov``."""
    mine = [at for at, column in enumerate(solution.columns) if column.effect == index]
    columns = [solution.columns[at] for at in mine]
    return intervals_of(solution.effects[index], columns, cov[np.ix_(mine, mine)])


def _between_legs(waves: FloatArray, precision: Precision, residual: FloatArray, blocks: Blocks) -> float:
    """Returns the variance of harmonics between legs, relative to that of the noise model; at least 1.

    The columns ``waves`` (b, p) carry nearly equal information and overlap little, so each is an independent
    estimate of the ratio.
    """
    scores = sums(waves * precision.apply(residual)[:, np.newaxis], blocks.leg)
    own = sums(waves * precision.apply(waves), blocks.leg)
    information = np.sum(own, axis=0)
    legs = information**2 / np.sum(own**2, axis=0)
    ratio = np.sum(scores**2, axis=0) / information * legs / np.maximum(legs - 1.0, 0.5)
    return max(float(np.mean(ratio)), 1.0)


# Residual tests: does the residual depend on motor angle, load angle, direction or time?


SURE = 3.0
"""Minimum size of a significant deviation, standard errors."""
WORTH_ARCSEC = 0.3
"""Smallest deviation that fails a test. A smaller one passes even if it is significant."""
LEAST_REPORTED_ARCSEC = 0.005
"""Smallest deviation stated in the text; a smaller deviation would be printed as 0.00."""


def residual_tests(
    residual: FloatArray,
    blocks: Blocks,
    precision: Precision,
    left: Sequence[Line],
    figures: NoiseFigures,
) -> tuple[ResidualTest, ...]:
    """Runs all residual tests. ``left`` contains the spectral lines of orders that are not in the fit."""
    return (
        _orders("motor_angle", [each for each in left if each.order.family is not Family.LOAD]),
        _orders("load_angle", [each for each in left if each.order.family is Family.LOAD]),
        _contrast("direction", np.sign(blocks.speed_deg_s) * blocks.moving, residual, precision, 2.0),
        _contrast("time", _centred(blocks.time_s), residual, precision, 1.0),
        _whiteness(figures.model),
        _level(figures),
    )


def _orders(name: str, left: Sequence[Line]) -> ResidualTest:
    significant = [each for each in left if each.significant]
    worst = max(significant, key=lambda each: each.amplitude_arcsec, default=None)
    size = worst.amplitude_arcsec if worst else 0.0
    text = f"{worst.order} of {size:.2f} arcsec remains" if worst else "no order remains"
    return ResidualTest(name, size < WORTH_ARCSEC, size, text)


def _contrast(
    name: str, column: FloatArray, residual: FloatArray, precision: Precision, scale: float
) -> ResidualTest:
    """Tests whether the residual depends on ``column``.

    Fits the column and a mean by generalised least squares. The reported size is ``scale`` times the
    coefficient.
    """
    columns = np.stack([np.ones(len(column)), column], axis=1)
    weighted = precision.apply(columns)
    information = columns.T @ weighted
    if np.linalg.cond(information) > 1e12:
        return ResidualTest(name, True, 0.0, f"the record does not vary in {name}")
    inverse = np.linalg.inv(information)
    value = float((inverse @ (weighted.T @ residual))[1]) * scale
    error = math.sqrt(max(inverse[1, 1], 0.0)) * scale
    passed = abs(value) < max(SURE * error, WORTH_ARCSEC)
    return ResidualTest(name, passed, abs(value), f"{value:+.2f} arcsec, standard error {error:.2f}")


def _centred(time_s: FloatArray) -> FloatArray:
    span = float(np.ptp(time_s))
    return (time_s - np.mean(time_s)) / span if span else np.zeros(len(time_s))


def _whiteness(noise: NoiseModel) -> ResidualTest:
    size = math.hypot(noise.slow_arcsec, noise.place_arcsec)
    spans = [
        f"{arcsec:.2f} arcsec within {span}"
        for arcsec, span in (
            (noise.slow_arcsec, f"{noise.slow_s:.1f} s"),
            (noise.place_arcsec, f"{noise.place_deg:.2f} deg of the motor"),
        )
        if arcsec >= LEAST_REPORTED_ARCSEC
    ]
    text = f"correlated noise: {' and '.join(spans)}; the intervals allow for it" if spans else "white noise"
    return ResidualTest("whiteness", size < WORTH_ARCSEC, size, text)


def _level(figures: NoiseFigures) -> ResidualTest:
    rest = figures.standing_arcsec
    if rest is None:
        return ResidualTest(
            "noise_level", True, 0.0, "the axis never stood still long enough to measure its noise"
        )
    size = math.sqrt(max(figures.fitted_arcsec**2 - rest**2, 0.0))
    text = f"{figures.fitted_arcsec:.2f} arcsec remains; the noise at rest is {rest:.2f}"
    return ResidualTest("noise_level", size < max(rest, 1.0), size, text)


# Held-out test: the model is fitted without parts of the record, and predicts these parts.


FOLDS = 4
STRETCHES = 40
"""Approximate number of stretches of time. Each fold contains every fourth stretch."""


def held_out(
    state: State, solution: Solution, measured_arcsec: FloatArray, inside_variance: float
) -> HeldOut:
    """Cross-validates the model and compares it with the active model, or with no model if none is active.

    ``measured_arcsec`` (b,) is the measured error before delay correction. ``inside_variance`` is the
    variance of samples within their blocks, which is independent of the model.
    """
    design, blocks, active = state.design, state.design.blocks, state.options.active
    fold, stretch, over = folds(design)
    written = {place for place, each in enumerate(solution.effects) if not each.violations()}
    shift = [at for at, each in enumerate(solution.columns) if each.effect < 0]
    kept = shift + [at for at, each in enumerate(solution.columns) if each.effect in written]
    rest_arcsec = blocks.error_arcsec - solution.jacobian[:, shift] @ solution.nuisances[shift]
    added, alone = (np.zeros((2, len(blocks))) for _ in range(2))
    # The active model has no nuisances of its own, so the best-fitting ones are used.
    own = active.effects if active else ()
    new = [solution.effects[place] for place in sorted(written)]
    for row, (effects, of) in enumerate(((own, shift), (new, kept))):
        model_arcsec, columns = design.predict(effects), solution.jacobian[:, of]
        fit = Linearised(columns, rest_arcsec - model_arcsec, solution.known[of])
        steps = steps_without(fit, fold, lambda rows: Precision(state.noise, blocks.picked(rows)))
        for number, step in enumerate(steps):
            out = fold == number
            # Zero offsets are taken from the other folds; one that occurs only in this fold is fitted here.
            lost = ~np.isin(blocks.zero, blocks.zero[~out])
            left = fit.residual - columns @ step
            added[row, out] = about_zeros(left, blocks.zero, blocks.count * lost)[out]
            left = measured_arcsec - model_arcsec - columns[:, len(shift) :] @ step[len(shift) :]
            alone[row, out] = about_zeros(left, blocks.zero, blocks.count * (lost | ~out))[out]
    used = len(fold) - np.bincount(fold)[fold] >= 2 * len(solution.columns)
    weight = blocks.count * used
    if not np.sum(weight):
        return HeldOut(
            None, None, math.nan, "nothing was held out: there is too little data to leave any out"
        )
    number = len(np.unique(fold[used]))

    def gain(left: FloatArray) -> Gain:
        rows = np.stack([weight, *(weight * (each**2 + inside_variance) for each in left)], axis=1)
        return Gain(over, number, *sums(rows, stretch).T)

    fitted = math.sqrt(float(weight @ solution.residual**2) / float(np.sum(weight)) + inside_variance)
    result = HeldOut(gain(alone), gain(added), fitted, "")
    assert result.gain is not None
    words = "improves on" if result.improves else "does not improve on"
    against = "the active model" if active else "no model"
    figures = f"{result.gain.before_arcsec:.2f} to {result.gain.after_arcsec:.2f} arcsec"
    return replace(result, text=f"{words} {against}: {figures} on {over} left out")


def gain_of_law(before: tuple[State, Solution], after: tuple[State, Solution]) -> Gain:
    """Returns the gain of the law in ``after`` over that in ``before`` on held-out data.

    Each fold is predicted by a fit to the other folds, with nuisances refitted.
    """
    design = before[0].design
    fold, stretch, over = folds(design)
    count = design.blocks.count
    squares = [count * _left_out(state, solution, fold) ** 2 for state, solution in (before, after)]
    return Gain(over, int(np.max(fold)) + 1, *sums(np.stack([count, *squares], axis=1), stretch).T)


def _left_out(state: State, solution: Solution, fold: IntArray) -> FloatArray:
    """Returns the residual of each block (b,), arcsec, from a fit without the block's fold."""
    blocks, left = state.design.blocks, solution.residual.copy()
    fit = Linearised(solution.jacobian, solution.residual, solution.known)
    steps = steps_without(fit, fold, lambda rows: Precision(state.noise, blocks.picked(rows)))
    for number, step in enumerate(steps):
        out = fold == number
        lost = ~np.isin(blocks.zero, blocks.zero[~out])
        left[out] = about_zeros(fit.residual - fit.columns @ step, blocks.zero, blocks.count * lost)[out]
    return left


def folds(design: Design) -> tuple[IntArray, IntArray, str]:
    """Returns the fold and the stretch of each block (b,), and a description of the parts left out.

    In sweeps, a fold contains every fourth motor turn, in both directions. Motion that reverses within a
    motor turn (sines, reversals) is divided into stretches of time. The loop is not determined without
    reversals, so no fold may contain them all. Of several short recordings of unknown motion, whole
    recordings are left out, because neighbouring stretches would predict a correlated residual.
    """
    blocks = design.blocks
    turns = (blocks.motor_deg - np.min(blocks.motor_deg)) / DEG_PER_TURN
    stretch = clusters(blocks, STRETCHES)
    if np.max(turns) < 2 * FOLDS:
        if design.samples.repeated:
            return blocks.chain % FOLDS, blocks.chain, RECORDINGS
        return stretch % FOLDS, stretch, "stretches of time"
    begins = np.flatnonzero(np.diff(blocks.leg, prepend=-1))
    span_deg = np.maximum.reduceat(blocks.motor_deg, begins) - np.minimum.reduceat(blocks.motor_deg, begins)
    local = (span_deg < DEG_PER_TURN)[counted(blocks.leg)]
    words = "motor turns, and stretches of sines and reversals," if local.any() else "motor turns"
    return counted(np.where(local, stretch, turns.astype(np.intp)) % FOLDS), stretch, words


# Result.


MOST_NAMED = 4
"""Maximum number of orders listed individually in a warning."""


def conclude(
    state: State, solution: Solution, cov: FloatArray, system: System, warnings: list[str]
) -> FitResult:
    """Assembles the result of an identification; ``system`` is that of ``state`` with its final noise."""
    design, blocks, samples = state.design, state.design.blocks, state.design.samples
    precision, chosen = state.precision(), state.selection.chosen
    intervals = [each for index in range(len(solution.effects)) for each in of_effect(solution, index, cov)]
    effects = tuple(each for each in solution.effects if not each.violations())
    uncertainty = {each.name: nested_half_widths(each, intervals) for each in effects}
    inside = _inside_variance(design, solution, state.columns().columns @ solution.nuisances)
    # Undoes the delay correction of the samples, because the delay is not part of any model.
    measured = blocks.error_arcsec + state.delay_ms * delay_column(design)[:, 0]
    written = about_zeros(measured - design.predict(effects), blocks.zero, blocks.count)

    def rms(left_arcsec: FloatArray) -> float:
        return math.sqrt(float(blocks.count @ left_arcsec**2) / float(np.sum(blocks.count)) + inside)

    ones = np.ones(len(blocks))
    figures = NoiseFigures(
        standing_arcsec=standing_arcsec(samples),
        laps_arcsec=laps_arcsec(samples),
        model=state.noise,
        residual_arcsec=rms(written),
        fitted_arcsec=rms(solution.residual),
        samples=int(np.sum(blocks.count)),
        effective_samples=rms(solution.residual) ** 2 * float(ones @ precision.apply(ones)),
    )
    further = {
        column.name: (value, NORMAL_95 * math.sqrt(max(variance, 0.0)))
        for column, value, variance in zip(
            solution.columns, solution.nuisances.tolist(), np.diag(cov).tolist(), strict=False
        )
    }
    zeros = tuple(value for name, (value, _) in further.items() if name.startswith("zero"))
    waves = design.predict([each for each in solution.effects if each.part is Part.ORDERS])
    lines = spectrum(state.candidates, chosen, system, state.options.family_wise)
    _describe_limits(state, lines, warnings)
    used = blocks.count > 0  # a block without any weight has no mean to plot
    return FitResult(
        model=TransmissionModel(samples.ratio, effects, uncertainty),
        intervals=tuple(intervals),
        zeros_arcsec=zeros,
        nuisances=_nuisances(state, further),
        noise=figures,
        outliers=state.outliers,
        orders=tuple(each for each in lines if each.order in chosen and each.order.family is Family.MOTOR),
        spectrum=lines,
        residual_tests=residual_tests(
            solution.residual,
            blocks,
            precision,
            [each for each in lines if each.order not in chosen],
            figures,
        ),
        held_out=held_out(state, solution, measured, inside),
        traces=Traces(
            time_s=blocks.time_s[used],
            motor_deg=blocks.motor_deg[used],
            load_deg=(blocks.motor_deg / samples.ratio + blocks.error_arcsec / ARCSEC_PER_DEG)[used],
            direction=(blocks.heading * blocks.moving)[used],
            kind=samples.kinds,
            kind_index=blocks.kind[used],
            error_arcsec=(blocks.error_arcsec - np.array(zeros)[blocks.zero])[used],
            predicted_arcsec=design.predict(solution.effects)[used],
            residual_arcsec=written[used],
            orders_arcsec=(solution.residual + waves)[used],
        ),
        warnings=tuple(warnings),
    )


def _inside_variance(design: Design, solution: Solution, nuisances: FloatArray) -> float:
    """Returns the variance of the samples' residuals about their block means, arcsec squared."""
    blocks = design.blocks
    residual = design.residual(solution.effects, nuisances)
    off = residual[blocks.index] - np.repeat(blocks.mean(residual), blocks.sizes)
    return float(blocks.weight @ off**2) / max(float(np.sum(blocks.count)), 1.0)


def _nuisances(state: State, further: Mapping[str, tuple[float, float]]) -> tuple[Nuisance, ...]:
    """Returns the nuisances that have a physical meaning.

    ``further`` contains the value and 95 % half width of each nuisance by name.
    """
    found = []
    for name in state.nuisances:
        if name in TEXTS and name in further:
            value, half = further[name]
            value += state.delay_ms if name == DELAY else 0.0
            found.append(Nuisance(name, TEXTS[name], value, half, UNITS[name]))
    for order in _not_the_motors(state):
        cosine, sine = further[f"{order} cosine"], further[f"{order} sine"]
        text = f"an error that repeats with {order}, for which the model has no part"
        size = math.hypot(cosine[0], sine[0])
        found.append(Nuisance(str(order), text, size, max(cosine[1], sine[1]), "arcsec"))
    return tuple(found)


def _not_the_motors(state: State) -> list[Order]:
    return [each for each in state.selection.chosen if each.family is not Family.MOTOR]


def _describe_limits(state: State, lines: Sequence[Line], warnings: list[str]) -> None:
    """Appends warnings about orders that are not separable, short travel and outliers."""
    samples, outliers = state.design.samples, state.outliers
    for alike in _families(lines):
        warnings.append(f"{_named(alike)} are not separable at the angles of this record")
    if state.selection.unresolved:
        unresolved = _named(state.selection.unresolved)
        warnings.append(f"{unresolved} are not separable from the other fitted terms")
    load_turns = float(np.ptp(state.design.blocks.motor_deg)) / DEG_PER_TURN / samples.ratio
    if load_turns < 0.95:
        warnings.append(
            f"the record spans {load_turns:.2f} load turns: errors that repeat with the "
            "load turn are not visible and may bias the other parameters; sweep over two"
        )
    if outliers.swinging:
        warnings.append(
            f"{outliers.swinging} samples ({outliers.swinging / len(samples):.2%}) in or just after fast "
            "accelerations stand out and have no weight: the load oscillates on its spring there"
        )
    if others := outliers.samples - outliers.swinging:
        warnings.append(
            f"{others} samples ({others / len(samples):.2%}, at most {outliers.longest_run} in a row) "
            f"stand out from their neighbours and have no weight: look for lost counts, plugs, shields"
        )
    for order in _not_the_motors(state):
        warnings.append(
            f"{order} is visible in this record, but the model has no part for it; a diagnosis may find its "
            "cause"
        )


def _families(lines: Sequence[Line]) -> list[list[Order]]:
    """Groups the orders that are aliases of each other."""
    alike = [[other.order in each.aliases for other in lines] for each in lines]
    number = connected_components(np.array(alike).reshape(len(lines), -1))[1].tolist() if lines else []
    families = [
        [each.order for each, own in zip(lines, number, strict=True) if own == one]
        for one in range(len(lines))
    ]
    return [each for each in families if len(each) > 1]


def _named(orders: Sequence[Order]) -> str:
    """Lists orders by name; abbreviates a long list to its first and last order."""
    if len(orders) > MOST_NAMED:
        return f"{orders[0]} to {orders[-1]} ({len(orders)} orders)"
    return " and ".join(map(str, orders))
