"""Fitting the plant's parameters to recordings: regressions first, then least squares over replays.

The residuals of following error, torque and load angle are scaled by what each channel is left with; a weak
prior about the start holds what the motion does not show. Intervals allow for residuals that go together
within a leg (a sandwich of the Jacobian and the legs' own gradients), because what a replay cannot follow is
no white noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, coarse, counted, prepare, scales
from hdbridge.twin.parameters import (
    BY_NAME,
    LOAD,
    PARAMETERS,
    Parameter,
    at_coordinates,
    coordinates,
    value_in,
    with_values,
)
from hdbridge.twin.regressions import start_of
from hdbridge.twin.replays import Replays

STEP = 0.03
"""Step of the Jacobian's central differences: of a logarithm, or of a parameter's spread where it is linear.
A motor that sticks a substep earlier makes residuals jump; in a smaller step that would be all of it."""
FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Where the resonance of the load is looked for: a fit finds only the nearest of its minima."""
FIT_S = 60.0
"""A longer recording is fitted on parts of it that take the axis about so long, of each kind of motion where
there is time: a thousand replays of a quarter of an hour would take hours."""
NINETY_FIVE = 1.96
LAST = ("velocity feed-forward",)
"""Fitted last, if that earns it: most drives feed the whole speed forward, and otherwise it looks like a dead
time until all else is right."""
EARNED = 8.0
"""Half the drop of the scaled squares that such a parameter has to bring: exp(8) to one."""
SURE = 4.0
"""... and its distance from where it was, in standard deviations."""
FILTER_SHARES = (0.3, 0.9)
"""Shares of the lag that may be the command filter's, to begin with."""
ROUGH_TRIES = 6
OPTIONAL = (*LAST, "load friction", "temperature", "current limit", "motor encoder delay")
"""Not fitted unless asked for: the ordinary motion does not show them, or others can take their place."""
SOFT = 4.0
"""Residuals beyond so many scales count less: a replay that slips elsewhere is no measure of a parameter."""

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The outcome of a fit over some parameters."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    place: FloatArray
    """Coordinates of the parameters, shape (p,)."""
    covariance: FloatArray
    """Of the coordinates, shape (p, p)."""
    scales: dict[str, float]
    """Scale of each channel's residuals."""
    residuals: dict[str, FloatArray]
    vector: FloatArray
    """The scaled residuals of the fitted rows, softened."""
    jacobian: FloatArray
    """Of these, by coordinate."""
    cost: float
    """Half the sum of the squares of the scaled residuals, softened."""

    @property
    def misfit(self) -> float:
        """Mean size of the scaled residuals over the channels, in their units: comparable between fits."""
        return float(np.prod([np.mean(np.abs(each)) + 1e-12 for each in self.residuals.values()]))

    @property
    def inflation(self) -> float:
        """Mean square of the scaled residuals, 1 at least: what one of them is worth."""
        return max(1.0, float(self.vector @ self.vector) / max(len(self.vector), 1))

    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by the parameters' names."""
        spread = NINETY_FIVE * np.sqrt(np.diag(self.covariance))
        return {
            each.name: (each.value(float(x - s)), each.value(float(x + s)))
            for each, x, s in zip(self.parameters, self.place, spread, strict=True)
        }


def free_parameters(truth: Truth, more: Sequence[str] = ()) -> tuple[Parameter, ...]:
    """What a fit changes: every parameter that the truth has, without those that need to be asked for."""
    free = []
    for each in PARAMETERS:
        value = value_in(truth, each)
        absent = value is None or (value <= each.least and not each.linear)
        if not absent and (each.name not in OPTIONAL or each.name in more):
            free.append(each)
    return tuple(free)


def fit(
    recording: Recording,
    axis: AxisConfig,
    start: Truth,
    progress: Progress = lambda _: None,
    workers: int | None = None,
    more: Sequence[str] = (),
) -> Fitted:
    """From the start to the parameters that explain the recording best.

    InputError where it has no command.
    """
    data = coarse(prepare(recording, axis, start), FIT_S)
    rough = coarse(data)
    begun = start_of(start, data)
    parameters = free_parameters(begun, more)
    prior = np.array(coordinates(begun, parameters))
    with Replays(rough, workers) as replays:
        most = scales(rough, *replays([start]))
        begun = _at_best_frequency(replays, begun)
        progress(0.1)
        starts = [solve(replays, each, parameters, prior, 8, most=most) for each in _filters(begun)]
        first = min(starts, key=lambda each: each.misfit)
    progress(0.4)
    with Replays(data, workers) as replays:
        most = scales(data, *replays([start]))
        second = solve(
            replays, first.truth, parameters, prior, 12, lambda share: progress(0.4 + 0.3 * share), most=most
        )
        best = solve(
            replays, second.truth, parameters, prior, 12, lambda share: progress(0.7 + 0.2 * share), most=most
        )
        for name in LAST:
            wider = (*parameters, BY_NAME[name])
            if value_in(begun, BY_NAME[name]) is None or name in more:
                continue
            around = np.array(coordinates(begun, wider))
            tried = solve(replays, best.truth, wider, around, 3, known=best.scales)
            off = abs(float(tried.place[-1] - around[-1])) / math.sqrt(float(tried.covariance[-1, -1]))
            if best.cost - tried.cost > EARNED * best.inflation and off > SURE:
                best = tried
        best = _roughened(replays, best)
    progress(1.0)
    return best


def _filters(truth: Truth) -> list[Truth]:
    """The truth with several command filters that make the same lag, the dead time being the rest.

    Between the two a fit finds only the nearest of the misfit's minima.
    """
    filter_ms, dead_ms = truth.servo.command_filter_ms, truth.servo.dead_time_ms
    lag_ms = 2.0 * filter_ms + dead_ms
    tried = [truth]
    for share in FILTER_SHARES:
        other_ms = 0.5 * share * lag_ms
        values = {"command filter": other_ms, "servo dead time": lag_ms - 2.0 * other_ms}
        tried.append(with_values(truth, values))
    return tried


def _roughened(replays: Replays, fitted: Fitted) -> Fitted:
    """The fit with wider intervals where the misfit is rough: its least place is known no better than that.

    A motor that sticks a substep earlier or later makes the misfit jump; what it is off a parabola within the
    intervals is how much of it says nothing about the parameters.
    """
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(fitted.covariance)
    rows = np.concatenate([each * (1.0 - replays.data.out) > 0.0 for each in counted(replays.data).values()])
    tried = [fitted.place + 0.5 * root @ rng.standard_normal(len(fitted.place)) for _ in range(ROUGH_TRIES)]
    low, high = np.array([each.bounds for each in fitted.parameters]).T
    tried = [np.clip(each, low, high) for each in tried]
    found = replays([at_coordinates(fitted.truth, fitted.parameters, each.tolist()) for each in tried])
    off = []
    for place, left in zip(tried, found, strict=True):
        soft = _soft(np.concatenate([left[name] / fitted.scales[name] for name in CHANNELS])[rows])
        foretold = fitted.vector + fitted.jacobian @ (place - fitted.place)
        off.append(0.5 * float(soft @ soft - foretold @ foretold))
    rough = float(np.std(off))
    return replace(fitted, covariance=fitted.covariance * (1.0 + 2.0 * rough / len(fitted.place)))


def solve(
    replays: Replays,
    start: Truth,
    parameters: tuple[Parameter, ...],
    prior: FloatArray,
    steps: int,
    progress: Progress = lambda _: None,
    known: dict[str, float] | None = None,
    everything: bool = False,
    most: dict[str, float] | None = None,
) -> Fitted:
    """Least squares from a truth, in so many steps at most; with none, the slopes where it stands.

    ``prior`` are the coordinates that the prior is about; ``known`` the channels' scales, by default those of
    what the start leaves, ``most`` at most: a channel that has become worse does not count for less. Held-out
    legs count only where ``everything`` is to count.
    """
    data = replays.data
    out = 0.0 if everything else data.out
    rows = np.concatenate([each * (1.0 - out) > 0.0 for each in counted(data).values()])
    spread = np.array([each.spread for each in parameters])
    low, high = np.array([each.bounds for each in parameters]).T
    place = np.clip(coordinates(start, parameters), low + 1e-9, high - 1e-9)
    if known is None:
        (left,) = replays([start])
        known = scales(data, left)
        if most is not None:
            known = {name: min(scale, most[name]) for name, scale in known.items()}
    scale = known
    done = 0

    def vector(found: dict[str, FloatArray]) -> FloatArray:
        whole: FloatArray = np.concatenate([found[name] / scale[name] for name in CHANNELS])[rows]
        return whole

    last: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def slopes_at(place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobian and residuals; those of the place that was asked for last are kept."""
        nonlocal last
        if last is None or not np.array_equal(last[0], place):
            last = (place.copy(), *_slopes(replays, start, parameters, place, vector))
        return last[1], last[2]

    def misfit(place: FloatArray) -> FloatArray:
        (found,) = replays([at_coordinates(start, parameters, place.tolist())])
        return np.concatenate([_soft(vector(found)), (place - prior) / spread])

    def jacobian(place: FloatArray) -> FloatArray:
        nonlocal done
        slopes, now = slopes_at(place)
        done += 1
        progress(min(done / steps, 1.0))
        return np.concatenate([slopes * _softening(now)[:, None], np.diag(1.0 / spread)])

    if steps:
        place = least_squares(
            misfit, place, jacobian, bounds=(low, high), x_scale=spread, max_nfev=steps, ftol=1e-6, xtol=1e-5
        ).x
    best = at_coordinates(start, parameters, place.tolist())
    (found,) = replays([best])
    slopes, now = slopes_at(place)
    slopes, soft = slopes * _softening(now)[:, None], _soft(now)
    legs = np.concatenate([data.leg] * len(CHANNELS))[rows]
    covariance = _sandwich(slopes, soft, legs, spread)
    return Fitted(best, parameters, place, covariance, scale, found, soft, slopes, 0.5 * float(soft @ soft))


def _at_best_frequency(replays: Replays, truth: Truth) -> Truth:
    """The truth with the spring at which the load's angle comes out best."""
    inertia = truth.load_.whole_inertia_kg_m2
    now = truth.gear.stiffness_nm_per_rad
    tried = [truth]
    for hz in FREQUENCIES_HZ:
        stiffness = inertia * (math.tau * hz) ** 2
        damping = truth.gear.damping_nm_s_per_rad * math.sqrt(stiffness / now)
        if stiffness < 0.9 * truth.highest_stiffness_nm_per_rad:
            tried.append(with_values(truth, {"gear stiffness": stiffness, "gear damping": damping}))
    off = [float(np.mean(np.abs(found[LOAD]))) for found in replays(tried)]
    return tried[int(np.argmin(off))]


def _slopes(
    replays: Replays,
    base: Truth,
    parameters: Sequence[Parameter],
    place: FloatArray,
    vector: Callable[[dict[str, FloatArray]], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Derivative of the scaled residuals by each coordinate, and the residuals themselves."""
    truths, ways = [at_coordinates(base, parameters, place.tolist())], []
    for number, each in enumerate(parameters):
        step = STEP * (each.spread if each.linear else 1.0)
        ends = [min(max(place[number] + way, each.bounds[0]), each.bounds[1]) for way in (step, -step)]
        ways.append(ends[0] - ends[1])
        for end in ends:
            moved = place.copy()
            moved[number] = end
            truths.append(at_coordinates(base, parameters, moved.tolist()))
    here, *there = (vector(each) for each in replays(truths))
    slopes = [(there[2 * number] - there[2 * number + 1]) / way for number, way in enumerate(ways)]
    return np.stack(slopes, axis=1), here


def _soft(values: FloatArray) -> FloatArray:
    """Residuals whose squares grow evenly beyond `SOFT`."""
    size = np.abs(values) / SOFT
    bent = np.where(size > 1.0, np.sqrt(np.maximum(2.0 * size - 1.0, 1.0)), size)
    return np.sign(values) * SOFT * bent


def _softening(values: FloatArray) -> FloatArray:
    """Derivative of `_soft`."""
    size = np.maximum(np.abs(values) / SOFT, 1.0)
    return np.where(size > 1.0, 1.0 / np.sqrt(2.0 * size - 1.0), 1.0)


def _sandwich(slopes: FloatArray, left: FloatArray, legs: FloatArray, spread: FloatArray) -> FloatArray:
    """Covariance of the coordinates where residuals of one leg go together and legs are independent."""
    information = slopes.T @ slopes + np.diag(spread**-2.0)
    inverse = np.linalg.inv(information)
    gradients = slopes * left[:, None]
    order = np.argsort(legs, kind="stable")
    firsts = np.flatnonzero(np.diff(legs[order], prepend=-1.0))
    by_leg = np.add.reduceat(gradients[order], firsts, axis=0)
    count = len(by_leg)
    few = count / max(count - 1, 1)
    meat = few * by_leg.T @ by_leg + np.diag(spread**-2.0)
    covariance = inverse @ meat @ inverse
    # Never better than what independent residuals of the present size would give.
    white = inverse * max(1.0, float(left @ left) / max(len(left) - len(spread), 1))
    larger = np.maximum(np.sqrt(np.diag(white) / np.diag(covariance)), 1.0)
    given: FloatArray = covariance * np.outer(larger, larger)
    return given
