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
from scipy.optimize import lsq_linear
from scipy.stats import t

from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.estimation.intervals import NORMAL_95
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, coarse, counted, prepare, scales
from hdbridge.twin.noise import with_load_noise
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

STEP = 0.1
"""Step of the first Jacobian's central differences, in a parameter's spread."""
RESPONSE = 30.0
"""Norm of the scaled residuals' change that the later differences are made for. A motor that sticks a substep
earlier makes residuals jump, by a norm of 2 or so (measured on random axes, steps of 0.01 against 0.1): in a
smaller step that would be taken for information. Along what the motion hardly shows the step is so much
larger."""
FARTHEST = 0.3
"""The longest of these steps, in parameters' spreads: the slopes are those of a curved valley."""
FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Where the resonance of the load is looked for: a fit finds only the nearest of its minima."""
FIT_S = 60.0
"""A longer recording is fitted on parts of it that take the axis about so long, of each kind of motion where
there is time: a thousand replays of a quarter of an hour would take hours."""
LAST = ("velocity feed-forward",)
"""Fitted last, if that earns it: most drives feed the whole speed forward, and otherwise it looks like a dead
time until all else is right."""
EARNED = 8.0
"""Half the drop of the scaled squares that such a parameter has to bring: exp(8) to one."""
SURE = 4.0
"""... and its distance from where it was, in standard deviations."""
FILTER_SHARES = (0.3, 0.6)
"""Shares of the lag that may be the command filter's, to begin with."""
DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0)
"""Shares of the information's diagonal that are added to it (Marquardt)."""
WORTH = 1.0
"""A drop of half the squares by less is no evidence of anything."""
RESCALED = 3
"""After so many steps the scales are made anew: what a start leaves is no measure of the noise."""
SETTLED = 2
"""So many steps in a row that bring no more end a fit: the differences of the second are made anew."""
DRAWS = 12
"""Simulated recordings that the intervals are held against."""
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
        spread = NORMAL_95 * np.sqrt(np.diag(self.covariance))
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
        starts = [solve(replays, each, parameters, prior, 12, most=most) for each in _filters(begun)]
        first = min(starts, key=lambda each: each.misfit)
    progress(0.3)
    with Replays(data, workers) as replays:
        most = scales(data, *replays([start]))
        best = solve(
            replays, first.truth, parameters, prior, 16, lambda share: progress(0.3 + 0.6 * share),
            most=most, near=first,
        )  # fmt: skip
        for name in LAST:
            wider = (*parameters, BY_NAME[name])
            if value_in(begun, BY_NAME[name]) is None or name in more:
                continue
            around = np.array(coordinates(begun, wider))
            tried = solve(replays, best.truth, wider, around, 1, known=best.scales)
            off = abs(float(tried.place[-1] - around[-1])) / math.sqrt(float(tried.covariance[-1, -1]))
            if best.cost - tried.cost > EARNED * best.inflation and off > SURE:
                best = tried
        best = _redrawn(replays, best)
    progress(1.0)
    return best


def _filters(truth: Truth) -> list[Truth]:
    """The truth with several command filters that make the same lag, the dead time being the rest.

    Between the two a fit finds only the nearest of the misfit's minima.
    """
    lag_ms = 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms
    return [
        with_values(
            truth, {"command filter": 0.5 * share * lag_ms, "servo dead time": (1.0 - share) * lag_ms}
        )
        for share in FILTER_SHARES
    ]


def _redrawn(replays: Replays, fitted: Fitted) -> Fitted:
    """The fit with intervals no narrower than how far it misses the parameters of simulated recordings.

    Each is a rounded and noisy replay of a truth drawn from the covariance, to which the fit goes by one
    linear step. So all counts that a smooth replay does not have: rounding that repeats itself while the
    command is even, a motor that sticks a substep earlier, a valley that is curved.
    """
    rng = np.random.default_rng(0)
    count = len(fitted.place)
    low, high = np.array([each.bounds for each in fitted.parameters]).T
    root = np.linalg.cholesky(fitted.covariance)
    places = [np.clip(fitted.place + root @ rng.standard_normal(count), low, high) for _ in range(DRAWS)]
    noisy = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    drawn = replays.drawn([at_coordinates(noisy, fitted.parameters, each.tolist()) for each in places])
    rows = np.concatenate([each * (1.0 - replays.data.out) > 0.0 for each in counted(replays.data).values()])
    spread = np.array([each.spread for each in fitted.parameters])
    jacobian = fitted.jacobian
    inverse = np.linalg.inv(jacobian.T @ jacobian + np.diag(spread**-2.0))
    squares = np.zeros(count)
    for place, left in zip(places, drawn, strict=True):
        # What the smooth replay of the fit leaves of the drawn recording.
        off = [(fitted.residuals[name] - left[name]) / fitted.scales[name] for name in CHANNELS]
        step = -inverse @ (jacobian.T @ _soft(np.concatenate(off)[rows]))
        squares += np.square(fitted.place + step - place)
    few = float(t.ppf(0.975, DRAWS)) / NORMAL_95
    larger = np.maximum(few * np.sqrt(squares / DRAWS / np.diag(fitted.covariance)), 1.0)
    return replace(fitted, covariance=fitted.covariance * np.outer(larger, larger))


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
    near: Fitted | None = None,
) -> Fitted:
    """Least squares from a truth, in so many steps at most; with none, the slopes where it stands.

    ``prior`` are the coordinates that the prior is about; ``known`` the channels' scales, by default those of
    what every third step leaves, ``most`` at most: a channel that has become worse does not count for less.
    Held-out legs count only where ``everything`` is to count. ``near`` is a fit of the same parameters whose
    directions the first differences are made along.
    """
    data = replays.data
    out = 0.0 if everything else data.out
    rows = np.concatenate([each * (1.0 - out) > 0.0 for each in counted(data).values()])
    spread = np.array([each.spread for each in parameters])
    low, high = np.array([each.bounds for each in parameters]).T
    place = np.clip(coordinates(start, parameters), low, high)
    (found,) = replays([at_coordinates(start, parameters, place.tolist())])
    scale = known if known is not None else _capped(scales(data, found), most)

    def vector(found: dict[str, FloatArray]) -> FloatArray:
        whole: FloatArray = np.concatenate([found[name] / scale[name] for name in CHANNELS])[rows]
        return whole

    def cost(place: FloatArray, found: dict[str, FloatArray]) -> float:
        """Half the squares of the softened residuals and the prior's."""
        soft, off = _soft(vector(found)), (place - prior) / spread
        return 0.5 * float(soft @ soft + off @ off)

    moves = np.diag(STEP * spread) if near is None else _moves(near.jacobian, spread)
    idle = done = 0
    while True:
        now = vector(found)
        slopes = _slopes(replays, start, parameters, place, moves, vector)
        slopes, soft = slopes * _softening(now)[:, None], _soft(now)
        if done == steps or idle == SETTLED:
            break
        moves = _moves(slopes, spread)
        tried = _damped_steps(slopes, soft, place, prior, spread, (low, high))
        left = replays([at_coordinates(start, parameters, each.tolist()) for each in tried])
        before, after = cost(place, found), [cost(*each) for each in zip(tried, left, strict=True)]
        best = int(np.argmin(after))
        if after[best] < before:
            place, found = tried[best], left[best]
        idle = idle + 1 if before - after[best] < WORTH else 0
        done += 1
        if known is None and done % RESCALED == 0:
            scale = _capped(scales(data, found), most)
        progress(done / steps)
    truth = at_coordinates(start, parameters, place.tolist())
    legs = np.concatenate([data.leg] * len(CHANNELS))[rows]
    covariance = _sandwich(slopes, soft, legs, spread)
    return Fitted(truth, parameters, place, covariance, scale, found, soft, slopes, 0.5 * float(soft @ soft))


def _capped(found: dict[str, float], most: dict[str, float] | None) -> dict[str, float]:
    return found if most is None else {name: min(scale, most[name]) for name, scale in found.items()}


def _damped_steps(
    slopes: FloatArray,
    left: FloatArray,
    place: FloatArray,
    prior: FloatArray,
    spread: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> list[FloatArray]:
    """Places to go to by the linear reckoning, within the bounds, the boldest first (Levenberg, Marquardt).

    All of them are tried: where the misfit is rough, one that comes out worse says little of the others.
    """
    information = slopes.T @ slopes + np.diag(spread**-2.0)
    gradient = slopes.T @ left + (place - prior) / spread**2
    low, high = bounds
    found = []
    for damping in DAMPINGS:
        root = np.linalg.cholesky(information + damping * np.diag(np.diag(information)))
        # Least squares of which these are the normal equations.
        target = -np.linalg.solve(root, gradient)
        room = (np.minimum(low - place, -1e-12), np.maximum(high - place, 1e-12))
        found.append(np.clip(place + lsq_linear(root.T, target, room).x, low, high))
    return found


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
    moves: FloatArray,
    vector: Callable[[dict[str, FloatArray]], FloatArray],
) -> FloatArray:
    """Derivative of the scaled residuals by each coordinate.

    By central differences along ``moves``, shape (moves, p), as far as the parameters' bounds allow.
    """
    low, high = np.array([each.bounds for each in parameters]).T
    ends = [np.clip(place + way * move, low, high) for move in moves for way in (1.0, -1.0)]
    there = [
        vector(each) for each in replays([at_coordinates(base, parameters, each.tolist()) for each in ends])
    ]
    moved = np.stack([one - other for one, other in zip(ends[::2], ends[1::2], strict=True)])
    changes = np.stack([one - other for one, other in zip(there[::2], there[1::2], strict=True)])
    slopes: FloatArray = (np.linalg.pinv(moved) @ changes).T
    return slopes


def _moves(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Along the principal directions of the information, each as far as residuals change by `RESPONSE`."""
    scaled = slopes * spread
    worth, directions = np.linalg.eigh(scaled.T @ scaled + np.eye(len(spread)))
    far = np.minimum(RESPONSE / np.sqrt(worth), FARTHEST)
    moves: FloatArray = (directions * far).T * spread
    return moves


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
