"""Least squares over replays: the plant's parameters from a start to a minimum of the misfit.

The residuals of following error, torque and load angle are scaled by what each channel is left with; a weak
prior about the start holds what the motion does not show. The misfit has long, narrow and curved valleys, for
filter, dead time and feed-forwards make up for each other: steps of several dampings are tried, each some way
along a path that turns with the valley. The covariance allows for residuals that go together within a leg (a
sandwich of the Jacobian and the legs' own gradients), because what a replay cannot follow is no white noise.
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
# How sure a fit is of its coordinates: information by slopes, and a jackknife by legs.

LEAST = 1e-9
"""Of the information of all legs, a share that none of them has alone."""


def information_of(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """What residuals of unit variance and the prior say of the coordinates, shape (p, p)."""
    return np.asarray(slopes.T @ slopes + np.diag(spread**-2.0), dtype=np.float64)


def over_legs(rows: FloatArray, legs: FloatArray) -> FloatArray:
    """Sums of rows (n, p) over each leg, shape (legs, p); their squares make up for few legs."""
    by_leg = sums(rows, numbered(legs.astype(np.intp)))
    return np.asarray(by_leg * np.sqrt(len(by_leg) / max(len(by_leg) - 1, 1)), dtype=np.float64)


def principal(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Directions of the coordinates, one a column, shape (p, p), in each of which the information is one.

    A long valley is one of them. Each may be known worse by a factor of its own; were each *coordinate*, what
    two of them have in common, which is known best of all, would be lost.
    """
    worth, directions = eigen(slopes, spread)
    return np.asarray(spread[:, None] * directions / np.sqrt(worth), dtype=np.float64)


def sandwich(slopes: FloatArray, left: FloatArray, legs: FloatArray, spread: FloatArray) -> FloatArray:
    """Covariance of the coordinates where residuals of one leg go together and legs are independent.

    By how far each leg alone has drawn the fit: without it, that would have ended elsewhere (jackknife by
    legs; Bell and McCaffrey, Survey Methodology 28, 2002). One leg that a replay cannot follow draws a fit
    by all that the others leave open, and has little left itself.

    By principal directions: of a few legs no more can be said. None is better known than independent
    residuals of the present size would have it, nor worse than before the fit. What the slopes would still
    take of the residuals is no scatter of the legs.
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
    """Information and principal directions of the coordinates in units of their spreads."""
    _, size, directions = np.linalg.svd(root_of(slopes * spread, np.eye(len(spread))))
    return size**2, np.asarray(directions.T, dtype=np.float64)


def root_of(*tables: FloatArray) -> FloatArray:
    """Upper triangle whose transpose times it is the sum of these tables' own."""
    return np.asarray(np.linalg.qr(np.concatenate(tables), mode="r"), dtype=np.float64)


# ----------------------------------------------------------------

STEP = 0.01
"""Step of the first Jacobian's differences, in a parameter's spread."""
RESPONSE = 1.0
"""Norm of the scaled residuals' change that the later differences are made for: a standard deviation, for no
motion shows less."""
FARTHEST = 0.1
"""The longest of these steps, in parameters' spreads: the slopes are those of a curved valley."""
WIDE = 3.0
"""So much longer, and in both senses, are the differences that intervals are made of. A motor that sticks
breaks away elsewhere in each replay: short differences are steep by that alone, and intervals too narrow."""
TOO_FAR = 1.0
"""Change of scaled residuals (rms) beyond which a difference ends where the loops are unstable;"""
NEARER = 0.1
"""... so much shorter it is made anew."""
DAMPINGS = (0.0, 0.001, 0.01, 0.1)
"""Shares of the information's diagonal that are added to it (Marquardt)."""
LONGEST = (4.0, 1.5, 0.6, 0.2)
"""How long each of these steps is at most, in spreads of the parameters. Far from the minimum the linear
reckoning would take what the motion shows least to where it shows nothing any more, and hardly comes back."""
ALONG = ((1.0,), (0.4, 0.15))
"""How far along each of these steps to go; less far only where that brings nothing."""
PROBED = 0.1
"""How far along each of them its second derivative is taken."""
SETTLED = 3
"""So many steps in a row that bring no more end a fit. Each time the differences are made `WIDE` times as
long: where a motor sticks, short ones are no guide (implicit filtering; Kelley, SIAM 2011)."""
WORTH = 1.0
"""A drop of half the squares by less is no evidence of anything."""
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
    scales: Scales
    """Of the residuals."""
    residuals: dict[str, FloatArray]
    rows: NDArray[np.bool_]
    """Those that were fitted, one channel after the other."""
    vector: FloatArray
    """The scaled residuals of the fitted rows, softened."""
    jacobian: FloatArray
    """Of these, by coordinate."""

    @property
    def cost(self) -> float:
        """Half the sum of the squares of the scaled residuals, softened."""
        return 0.5 * float(self.vector @ self.vector)

    @property
    def inflation(self) -> float:
        """Mean square of the scaled residuals, 1 at least: what one of them is worth."""
        return max(1.0, float(self.vector @ self.vector) / max(len(self.vector), 1))

    @property
    def loss(self) -> float:
        """Minus the log likelihood of the fitted readings, by the fit's own scales, which need to have steps.

        Of two fits of the same readings the one with less is likelier, by the exponential of the difference.
        """
        half, stray = (each[self.rows] for each in self.scales.halves(len(self.rows) // len(CHANNELS)))
        size = np.abs(self.scales.scaled(self.residuals)[self.rows])
        wide = np.maximum(half, FINE)
        return float(np.sum(surprise(size, wide, stray) - np.log(half / wide)))

    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by the parameters' names."""
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
    """Least squares from a truth, in so many steps at most; with none, the slopes where it stands.

    ``prior`` are the coordinates that the prior is about; ``known`` the channels' scales, by default those of
    what each step leaves, ``most`` at most: a channel that has become worse does not count for less.
    ``tempered``: known scales grow with what a place leaves on the way to the minimum.
    Held-out legs count only where ``everything`` is to count. ``near`` is a fit of the same parameters whose
    directions the first differences are made along, ``loops`` what a drive's loops do otherwise. ``wide``:
    the last differences, of which the covariance is made, are wide ones.
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
        """Half the squares of the residuals as they count, and the prior's."""
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
    """For each row of each channel, one channel after the other, whether a fit sees it."""
    out = 0.0 if everything else data.out
    return np.concatenate([each * (1.0 - out) > 0.0 for each in counted(data).values()])


def legs_of_rows(data: Data, rows: NDArray[np.bool_]) -> FloatArray:
    """The number of the leg of each of the fitted rows."""
    return np.concatenate([data.leg] * len(CHANNELS))[rows]


def told(found: dict[str, FloatArray], scale: Scales, rows: NDArray[np.bool_]) -> FloatArray:
    """The residuals of some rows as they count: by likelihood, softened."""
    return counting(scale.scaled(found)[rows], scale, rows)[0]


def counting(off: FloatArray, scale: Scales, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Scaled residuals of some rows as they count, and the derivative of that."""
    half, stray = (each[rows] for each in scale.halves(len(rows) // len(CHANNELS)))
    root, slope = rooted(off, half, stray)
    return softened(root), slope * _softening(root)


def _capped(found: Scales, most: Scales | None) -> Scales:
    if most is None:
        return found
    return replace(found, deviation={n: min(s, most.deviation[n]) for n, s in found.deviation.items()})


def _tempered(known: Scales, found: dict[str, FloatArray], rows: NDArray[np.bool_]) -> Scales:
    """Scales that are larger by what a simulation leaves of the residuals as a whole, where that is more.

    Far from the minimum no residual is worth what the noise makes it worth, and the prior would have no say.
    One factor for all channels: the one that is furthest off still leads the way.
    """
    left = told(found, known, rows)
    factor = max(1.0, float(np.sqrt(np.mean(np.square(left)))))
    return replace(known, deviation={name: factor * each for name, each in known.deviation.items()})


@dataclass(frozen=True, eq=False)
class _Damped:
    """A step by the linear reckoning."""

    step: FloatArray
    root: FloatArray
    """Of the information with its damping: that is its transpose times it."""

    def turn(self, bent: FloatArray) -> FloatArray:
        """By how much a path along the step has to turn, at its end, to follow a curved valley.

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
    """Steps by the linear reckoning, within the bounds, the boldest first (Levenberg, Marquardt).

    All of them are tried: where the misfit is rough, one that comes out worse says little of the others.
    By orthogonal factors: next to where its loops are unstable a simulation changes by so much that of the
    prior nothing would be left in a sum of squares.
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
    """What is to be added to the information, in units of the prior's, for a step no longer than this."""
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
    """Derivatives, by coordinate, of the scaled residuals that are ``seen`` at places, ``now`` where we are.

    By differences along the moves, each in the sense in which the bounds leave more room; ``wide`` ones,
    which intervals are made of, are `WIDE` times as long and go both ways.
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
    """Along the principal directions of the information, as far as residuals change by `RESPONSE`.

    ``times``: so many times as far.
    """
    worth, directions = eigen(slopes, spread)
    far = np.minimum(times * RESPONSE / np.sqrt(worth), FARTHEST)
    moves: FloatArray = (directions * far).T * spread
    return moves


def softened(values: FloatArray) -> FloatArray:
    """Residuals whose squares grow evenly beyond `SOFT`."""
    size = np.abs(values) / SOFT
    bent = np.where(size > 1.0, np.sqrt(np.maximum(2.0 * size - 1.0, 1.0)), size)
    return np.sign(values) * SOFT * bent


def _softening(values: FloatArray) -> FloatArray:
    """Derivative of `softened`."""
    size = np.maximum(np.abs(values) / SOFT, 1.0)
    return np.where(size > 1.0, 1.0 / np.sqrt(2.0 * size - 1.0), 1.0)
