"""Least squares over replays: fits the plant's parameters from a start to a minimum of the misfit.

The residuals of following error, torque and load angle are scaled by each channel's own deviation; a weak
prior about the start holds parameters that the motion does not show. The misfit has long, narrow and curved
valleys, because filter, dead time and feed-forwards compensate for each other. Steps with several dampings
are therefore tried, at several lengths along a path that curves with the valley. The covariance allows for
residuals correlated within a leg (sandwich estimator), because model errors are not white noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, lsq_linear

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.linear import counted as numbered
from hdbridge.analysis.linear import sums
from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, Data, counted
from hdbridge.twin.noise import FINE, Loops, Scales, rooted, scales, surprise
from hdbridge.twin.parameters import Parameter, at_coordinates, coordinates
from hdbridge.twin.replays import Replays

# ----------------------------------------------------------------
# Uncertainty of the coordinates: information from the slopes, and a jackknife over legs.

LEAST = 1e-9
"""Regularisation of the jackknife: share of the information that a single leg cannot have alone."""


def information_of(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Returns the information matrix of unit-variance residuals and the prior, shape (p, p)."""
    return np.asarray(slopes.T @ slopes + np.diag(spread**-2.0), dtype=np.float64)


def over_legs(rows: FloatArray, legs: FloatArray) -> FloatArray:
    """Sums rows (n, p) over each leg, shape (legs, p), with a correction of the squares for few legs."""
    by_leg = sums(rows, numbered(legs.astype(np.intp)))
    return np.asarray(by_leg * np.sqrt(len(by_leg) / max(len(by_leg) - 1, 1)), dtype=np.float64)


def principal(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Returns principal directions of the coordinates as columns, shape (p, p), scaled to unit information.

    A long valley is one of them. The covariance may inflate each direction separately; inflating each
    *coordinate* would lose the well-known combinations of two coordinates.
    """
    worth, directions = eigen(slopes, spread)
    return np.asarray(spread[:, None] * directions / np.sqrt(worth), dtype=np.float64)


def sandwich(slopes: FloatArray, left: FloatArray, legs: FloatArray, spread: FloatArray) -> FloatArray:
    """Returns the covariance of the coordinates for correlated residuals within independent legs, (p, p).

    It is a jackknife over legs: the shift of the fit when one leg is left out (Bell and McCaffrey, Survey
    Methodology 28, 2002). A leg that a replay cannot follow shifts the fit in every direction that the others
    leave open, and has small residuals itself.

    Variances are estimated by principal direction, because a few legs do not determine more. Each is at least
    that of independent residuals of the present size and at most the prior's. The part of the residuals that
    the slopes can still explain is removed first, because it is not scatter of the legs.
    """
    along = principal(slopes, spread)
    rows = slopes @ along
    left = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    numbers = numbered(legs.astype(np.intp))
    order = np.argsort(numbers, kind="stable")
    drawn = []
    for leg in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
        others = (1.0 + LEAST) * np.eye(len(spread)) - rows[leg].T @ rows[leg]
        drawn.append(np.linalg.solve(others, rows[leg].T @ left[leg]))
    squares = np.sum(np.square(drawn), axis=0) * (1.0 - 1.0 / len(drawn))
    before = 1.0 / np.sum(np.square(along / spread[:, None]), axis=0)
    white = max(1.0, float(left @ left) / max(len(left) - len(spread), 1))
    times = np.minimum(np.maximum(squares, white), before)
    return np.asarray(along * times @ along.T, dtype=np.float64)


def eigen(slopes: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns information and principal directions of the coordinates, in units of their spreads."""
    _, size, directions = np.linalg.svd(root_of(slopes * spread, np.eye(len(spread))))
    return size**2, np.asarray(directions.T, dtype=np.float64)


def root_of(*tables: FloatArray) -> FloatArray:
    """Returns the upper triangular R with R'R equal to the sum of the tables' A'A."""
    return np.asarray(np.linalg.qr(np.concatenate(tables), mode="r"), dtype=np.float64)


# ----------------------------------------------------------------

STEP = 0.01
"""Step of the first Jacobian's finite differences, in spreads of a parameter."""
RESPONSE = 1.0
"""Norm of the scaled residuals' change that sets the later difference steps: one standard deviation, the
smallest change that a motion shows."""
FARTHEST = 0.1
"""Longest of these steps, in spreads, because the valley is curved."""
WIDE = 3.0
"""Factor of the difference steps for intervals, which are two-sided. A sticking motor breaks away differently
in each replay, so short differences are too steep and intervals too narrow."""
TOO_FAR = 1.0
"""Change of the scaled residuals (rms) above which the end of a difference has unstable loops."""
NEARER = 0.1
"""Factor by which such a difference is shortened."""
DAMPINGS = (0.0, 0.001, 0.01, 0.1)
"""Shares of the information's diagonal that are added to it (Marquardt)."""
LONGEST = (4.0, 1.5, 0.6, 0.2)
"""Maximum length of each of these steps, in spreads of the parameters. Far from the minimum, linear steps
move weakly observable parameters to places without effect, from which a fit hardly returns."""
ALONG = ((1.0,), (0.4, 0.15))
"""Lengths tried along each of these steps; the shorter ones only if the full step gains nothing."""
PROBED = 0.1
"""Length along each step at which the second derivative is estimated."""
SETTLED = 3
"""Number of successive steps without a gain that ends a fit. After each, the differences become `WIDE` times
as long, because short ones mislead if a motor sticks (implicit filtering; Kelley, SIAM 2011)."""
WORTH = 1.0
"""Minimum drop of half the sum of squares that counts as a gain."""
SOFT = 4.0
"""Residual, in scales, above which it counts less: a motor that slips elsewhere is not evidence."""

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fit of some parameters."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    place: FloatArray
    """Coordinates of the parameters, shape (p,)."""
    covariance: FloatArray
    """Covariance of the coordinates, shape (p, p)."""
    scales: Scales
    """Scales of the residuals."""
    residuals: dict[str, FloatArray]
    rows: NDArray[np.bool_]
    """Mask of the fitted rows, one channel after the other."""
    vector: FloatArray
    """Softened scaled residuals of the fitted rows, shape (n,)."""
    jacobian: FloatArray
    """Derivatives of `vector` with respect to the coordinates, shape (n, p)."""

    @property
    def cost(self) -> float:
        """Half the sum of squares of the softened scaled residuals."""
        return 0.5 * float(self.vector @ self.vector)

    @property
    def inflation(self) -> float:
        """Mean square of the scaled residuals, at least 1."""
        return max(1.0, float(self.vector @ self.vector) / max(len(self.vector), 1))

    @property
    def loss(self) -> float:
        """Negative log likelihood of the fitted readings by the fit's own scales, which must have steps.

        The likelihood ratio of two fits of the same readings is the exponential of the difference.
        """
        half, stray = (each[self.rows] for each in self.scales.halves(len(self.rows) // len(CHANNELS)))
        size = np.abs(self.scales.scaled(self.residuals)[self.rows])
        wide = np.maximum(half, FINE)
        return float(np.sum(surprise(size, wide, stray) - np.log(half / wide)))

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Returns 95 % intervals by parameter name."""
        spread = NORMAL_95 * np.sqrt(np.diag(self.covariance))
        return {
            each.name: (each.value(float(x - s)), each.value(float(x + s)))
            for each, x, s in zip(self.parameters, self.place, spread, strict=True)
        }


def solve(
    replays: Replays,
    start: Truth,
    parameters: tuple[Parameter, ...],
    prior: FloatArray,
    steps: int,
    progress: Progress = lambda _: None,
    known: Scales | None = None,
    everything: bool = False,
    most: Scales | None = None,
    near: Fitted | None = None,
    loops: Loops | None = None,
    tempered: bool = False,
    wide: bool = False,
) -> Fitted:
    """Fits parameters by least squares in at most ``steps`` steps; with none, only linearises at the start.

    ``prior`` is the prior's mean, shape (p,). ``known`` are the channels' scales; by default they are
    estimated from the residuals after each step, at most ``most``, so that a worse channel does not lose
    weight. ``tempered``: known scales grow with the residuals on the way to the minimum.
    Held-out legs count only with ``everything``. ``near`` is a fit of the same parameters that gives the
    directions of the first differences, ``loops`` the deviation of a drive's quantised loops from smooth
    ones. ``wide``: the covariance uses wide differences.
    """
    data = replays.data
    rows = fitted_rows(data, everything=everything)
    spread = np.array([each.spread for each in parameters])
    low, high = np.array([each.bounds for each in parameters]).T
    place = np.clip(coordinates(start, parameters), low, high)

    def led(places: Sequence[FloatArray]) -> list[dict[str, FloatArray]]:
        return replays([at_coordinates(start, parameters, each.tolist()) for each in places])

    (found,) = led([place])
    scale = known if known is not None else _capped(scales(data, found, loops), most)

    def seen(places: Sequence[FloatArray]) -> list[FloatArray]:
        return [scale.scaled(each)[rows] for each in led(places)]

    def cost(place: FloatArray, found: dict[str, FloatArray]) -> float:
        """Returns half the sum of squares of the softened residuals and the prior."""
        left, off = told(found, scale, rows), (place - prior) / spread
        return 0.5 * float(left @ left + off @ off)

    along = None if near is None else near.jacobian
    idle = done = 0
    while True:
        last = done == steps or idle == SETTLED
        longer = 1.0 if last else WIDE**idle
        moves = np.diag(STEP * spread) if along is None else _moves(along, spread, longer)
        if known is not None and tempered:
            scale = known if last else _tempered(known, found, rows)
        now = scale.scaled(found)[rows]
        slopes = slopes_at(seen, now, place, moves, (low, high), wide=wide and last)
        left, weights = counting(now, scale, rows)
        slopes *= weights[:, None]
        if last:
            break
        damped = _damped_steps(slopes, left, place, prior, spread, (low, high))
        probes = led([np.clip(place + PROBED * each.step, low, high) for each in damped])
        paths = []
        for each, probe in zip(damped, probes, strict=True):
            bent = (told(probe, scale, rows) - left) / PROBED - slopes @ each.step
            paths.append((each.step, each.turn(slopes.T @ bent / PROBED)))
        before = after = cost(place, found)
        for shares in ALONG:
            tried = [
                np.clip(place + far * step + far**2 * turn, low, high)
                for step, turn in paths
                for far in shares
            ]
            reached = led(tried)
            costs = [cost(*each) for each in zip(tried, reached, strict=True)]
            best = int(np.argmin(costs))
            if costs[best] < after:
                place, found, after = tried[best], reached[best], costs[best]
            if before - after >= WORTH:
                break
        idle, along = idle + 1 if before - after < WORTH else 0, slopes
        done += 1
        if known is None:
            scale = _capped(scales(data, found, loops), most)
        progress(done / steps)
    truth = at_coordinates(start, parameters, place.tolist())
    covariance = sandwich(slopes, left, legs_of_rows(data, rows), spread)
    return Fitted(truth, parameters, place, covariance, scale, found, rows, left, slopes)


def fitted_rows(data: Data, *, everything: bool = False) -> NDArray[np.bool_]:
    """Returns the mask of the rows that a fit sees, one channel after the other."""
    out = 0.0 if everything else data.out
    return np.concatenate([each * (1.0 - out) > 0.0 for each in counted(data).values()])


def legs_of_rows(data: Data, rows: NDArray[np.bool_]) -> FloatArray:
    """Returns the leg number of each fitted row."""
    return np.concatenate([data.leg] * len(CHANNELS))[rows]


def told(found: dict[str, FloatArray], scale: Scales, rows: NDArray[np.bool_]) -> FloatArray:
    """Returns the residuals of some rows, transformed by their likelihood and softened."""
    return counting(scale.scaled(found)[rows], scale, rows)[0]


def counting(off: FloatArray, scale: Scales, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Transforms scaled residuals by their likelihood and softens them; returns also the derivative."""
    half, stray = (each[rows] for each in scale.halves(len(rows) // len(CHANNELS)))
    root, slope = rooted(off, half, stray)
    return softened(root), slope * _softening(root)


def _capped(found: Scales, most: Scales | None) -> Scales:
    if most is None:
        return found
    return replace(found, deviation={n: min(s, most.deviation[n]) for n, s in found.deviation.items()})


def _tempered(known: Scales, found: dict[str, FloatArray], rows: NDArray[np.bool_]) -> Scales:
    """Returns scales enlarged by the overall rms of the scaled residuals, if that exceeds one.

    Far from the minimum, residuals are much larger than the noise, and the prior would have no weight. All
    channels share one factor, so the worst channel still dominates.
    """
    left = told(found, known, rows)
    factor = max(1.0, float(np.sqrt(np.mean(np.square(left)))))
    return replace(known, deviation={name: factor * each for name, each in known.deviation.items()})


@dataclass(frozen=True, eq=False)
class _Damped:
    """A damped Gauss-Newton step."""

    step: FloatArray
    root: FloatArray
    """Triangular root R of the damped information R'R."""

    def turn(self, bent: FloatArray) -> FloatArray:
        """Returns the second-order correction of the step that follows a curved valley.

        ``bent`` is the slopes' product with half the second derivative of the residuals along the step
        (geodesic acceleration; Transtrum and Sethna, arXiv:1201.5885).
        """
        return np.asarray(-np.linalg.solve(self.root, np.linalg.solve(self.root.T, bent)), dtype=np.float64)


def _damped_steps(
    slopes: FloatArray,
    left: FloatArray,
    place: FloatArray,
    prior: FloatArray,
    spread: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> list[_Damped]:
    """Returns damped Gauss-Newton steps within the bounds, the longest first (Levenberg, Marquardt).

    The caller tries all of them, because on a rough misfit one bad step says little about the others. They
    are computed by orthogonal factors: near unstable loops the slopes are so large that the prior would be
    lost to rounding in a sum of squares.
    """
    seen = root_of(slopes, np.diag(1.0 / spread))
    gradient = slopes.T @ left + (place - prior) / spread**2
    low, high = bounds
    room = (np.minimum(low - place, -1e-12), np.maximum(high - place, 1e-12))
    found = []
    for damping, longest in zip(DAMPINGS, LONGEST, strict=True):
        root = root_of(seen, np.sqrt(damping) * np.diag(np.linalg.norm(seen, axis=0)))
        held = _held(root, gradient, spread, longest)
        root = root_of(root, np.diag(np.sqrt(held) / spread))
        # Least squares of which these are the normal equations.
        target = -np.linalg.solve(root.T, gradient)
        found.append(_Damped(lsq_linear(root, target, room).x, root))
    return found


def _held(root: FloatArray, gradient: FloatArray, spread: FloatArray, longest: float) -> float:
    """Returns the damping, in units of the prior's information, that limits the step to this length."""
    _, size, directions = np.linalg.svd(root * spread)
    along = directions @ (gradient * spread)

    def beyond(more: float) -> float:
        return float(np.linalg.norm(along / (size**2 + more))) - longest

    return float(brentq(beyond, 0.0, np.linalg.norm(along) / longest)) if beyond(0.0) > 0.0 else 0.0


def slopes_at(
    seen: Callable[[Sequence[FloatArray]], list[FloatArray]],
    now: FloatArray,
    place: FloatArray,
    moves: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    *,
    wide: bool,
) -> FloatArray:
    """Returns finite-difference derivatives of the scaled residuals at ``place``, shape (n, p).

    ``seen`` evaluates residuals at places, ``now`` are those at ``place``. Differences go along the moves, in
    the direction with more space to the bounds; ``wide`` ones, for intervals, are `WIDE` times as long and
    two-sided.
    """
    both = [
        [np.clip(place + way * move, *bounds) for way in (1.0, -1.0)]
        for move in moves * (WIDE if wide else 1.0)
    ]
    if wide:
        ends = [end for pair in both for end in pair]
    else:
        ends = [max(pair, key=lambda each: float(np.linalg.norm(each - place))) for pair in both]
    changes = np.stack(seen(ends)) - now
    far = np.flatnonzero(np.mean(np.square(changes), axis=1) > TOO_FAR**2)
    if wide and len(far):
        for each in far:
            ends[each] = place + NEARER * (ends[each] - place)
        changes[far] = np.stack(seen([ends[each] for each in far])) - now
    return np.asarray((np.linalg.pinv(np.stack(ends) - place) @ changes).T, dtype=np.float64)


def _moves(slopes: FloatArray, spread: FloatArray, times: float = 1.0) -> FloatArray:
    """Returns difference steps along the principal directions that change the residuals by `RESPONSE`.

    ``times`` multiplies their length.
    """
    worth, directions = eigen(slopes, spread)
    far = np.minimum(times * RESPONSE / np.sqrt(worth), FARTHEST)
    moves: FloatArray = (directions * far).T * spread
    return moves


def softened(values: FloatArray) -> FloatArray:
    """Softens residuals: their squares grow linearly beyond `SOFT` (Huber loss)."""
    size = np.abs(values) / SOFT
    bent = np.where(size > 1.0, np.sqrt(np.maximum(2.0 * size - 1.0, 1.0)), size)
    return np.sign(values) * SOFT * bent


def _softening(values: FloatArray) -> FloatArray:
    """Returns the derivative of `softened`."""
    size = np.maximum(np.abs(values) / SOFT, 1.0)
    return np.where(size > 1.0, 1.0 / np.sqrt(2.0 * size - 1.0), 1.0)
