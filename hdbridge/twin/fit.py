"""Fits the plant's parameters to recordings: regressions first, then least squares over replays.

The residuals of following error, torque and load angle are scaled by each channel's own deviation. A weak
prior about the start values determines the parameters that the motion does not show. The misfit has several
minima, so a fit has several starts. The covariance allows for residuals correlated within a leg, because
model errors are not white noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.optimize import brentq, least_squares

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.linear import Linearised, on_one_thread, steps_without
from hdbridge.analysis.linear import counted as numbered
from hdbridge.analysis.noise import White
from hdbridge.axis.effects import FloatArray
from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.hysteresis import Hysteresis, MaxwellSlip
from hdbridge.sim.truth.motor import TrueObserver
from hdbridge.twin.mechanics import HELD, Estimate, measured_mechanics
from hdbridge.twin.misfit import (
    CHANNELS,
    FINE,
    ChannelResidual,
    Data,
    Mask,
    Replays,
    Scales,
    Values,
    channel_residuals,
    deviance_residuals,
    expected,
    least_deviation,
    misfit,
    noise_in_motion,
    rounding,
    scales,
    surprisal,
    units,
    values_of,
)
from hdbridge.twin.parameters import (
    BY_NAME,
    ELASTIC,
    FOLLOWING,
    LOAD,
    PARAMETERS,
    TORQUE,
    VELOCITY_BANDWIDTH_RAD_S,
    Parameter,
    at_coordinates,
    coordinates,
    free_value,
    named,
    value_in,
    with_sections,
    with_values,
)
from hdbridge.twin.replay import MOVING_DEG_S, demand_deg

# ----------------------------------------------------------------
# Start values estimated from the recordings without replays.

FILTER, DEAD_TIME = BY_NAME["command filter"], BY_NAME["servo dead time"]
LIMIT: Final = BY_NAME["current limit"]
HELD_ROWS = 3
"""Minimum number of rows at the highest torque for it to count as a limit; a mere peak lasts one or two
rows."""
LATEST_S = 0.1
"""Maximum lag of the motor behind the demand, s."""


def start_of(truth: Truth, data: Data, measured: Mapping[str, Estimate]) -> Truth:
    """Returns the truth with the ``measured`` mechanics, and with command filter and dead time from the lag
    behind the demand.

    If the recording holds its highest torque for some rows, this torque becomes the drive's torque limit.
    """
    servo, values = truth.servo, {name: each.value for name, each in measured.items()}
    held_percent = 100.0 * _held_nm(data) / truth.motor.rated_torque_nm
    if held_percent < min(servo.torque_limit_percent, data.axis.limits.torque_percent):
        values[LIMIT.name] = held_percent
    lag_ms = 1e3 * lag_s(data)
    if lag_ms > 0.0:
        filter_ms = min(servo.command_filter_ms, max(0.5 * lag_ms, FILTER.least))
        values |= {FILTER.name: filter_ms, DEAD_TIME.name: max(lag_ms - 2.0 * filter_ms, 0.0)}
    return with_values(truth, values)


def _held_nm(data: Data) -> float:
    """Returns the highest torque outside standstill, Nm, if it lasts for `HELD_ROWS` rows, else infinity."""
    torque_nm = [np.abs(piece.measured[TORQUE]) * piece.counts[TORQUE] for piece in data.pieces]
    highest = max(float(np.max(each)) for each in torque_nm)
    for each in torque_nm:
        there = np.concatenate([[0.0], each > highest - 0.5 * rounding(data.axis)[TORQUE], [0.0]])
        first, end = np.flatnonzero(np.diff(there) > 0.0), np.flatnonzero(np.diff(there) < 0.0)
        if highest > 0.0 and np.any(end - first >= HELD_ROWS):
            return highest
    return math.inf


def lag_s(data: Data) -> float:
    """Estimates the motor's lag behind the demand, s: following error divided by speed (least squares)."""
    lag = 0.0
    for _ in range(2):  # the second iteration delays the command by the lag
        products = squares = 0.0
        for piece in data.pieces:
            commands = piece.commands
            demand, late = demand_deg(commands, data.axis), commands.row_cycles - lag / commands.cycle_s
            speed = np.gradient(np.interp(late, commands.row_cycles, demand), commands.cycle_s)
            speed = np.where(np.abs(speed) > MOVING_DEG_S, speed, 0.0)
            products, squares = (
                products + float(speed @ piece.measured[FOLLOWING]),
                squares + float(speed @ speed),
            )
        lag = min(max(products / squares, 0.0), LATEST_S) if squares else 0.0
    return lag


# ----------------------------------------------------------------
# Conversion of the gear's elastic loop between the plant's hysteresis laws: a calibration's model has only
# one law, and the shape of its loop may differ from the gear's.

LOOP: Final = ("loop offset", "loop width", "loop yield", "loop exponent")
"""Parameters of all hysteresis laws; each law has only some of them."""
LAWS: Final[Mapping[str, dict[str, float]]] = {
    "rolling_friction": {"offset_arcsec": 1.0, "width_deg": 1.0, "exponent": 1.6},
    "bouc_wen": {"offset_arcsec": 1.0, "yield_deg": 1.0},
    "dahl": {"offset_arcsec": 1.0, "yield_deg": 1.0},
}
"""Unit loops of the hysteresis laws with few parameters; the first exponent is that of a published gear."""
LONG = 20.0
"""Travel after which each loop is saturated, in loop widths."""
_TRUE: Final[TypeAdapter[Hysteresis]] = TypeAdapter(Hysteresis)


def loop_parameters(truth: Truth) -> tuple[Parameter, ...]:
    """Returns the parameters of the hysteresis law of this truth."""
    return tuple(each for each in named(*LOOP) if value_in(truth, each) is not None)


def by_each_law(truth: Truth) -> list[Truth]:
    """Returns the truth, and its variants with every other hysteresis law; an empty list for a gear without a
    loop.
    """
    own = truth.gear.hysteresis
    if own is None:
        return []
    if own.law == "rolling_friction":
        # A fit may make the loop smaller than its initial state, which has no effect after some travel
        # anyway.
        truth = _with_loop(truth, own.model_copy(update={"start_arcsec": 0.0}))
    return [truth, *(_with_loop(truth, _like(own, law)) for law in LAWS if law != own.law)]


def by_law_of(truth: Truth, other: Truth) -> Truth:
    """Returns the truth with its loop converted to the hysteresis law of the truth ``other``."""
    own, law = truth.gear.hysteresis, other.gear.hysteresis
    if own is None or law is None or own.law == law.law:
        return truth
    return _with_loop(truth, _like(own, law.law))


def _like(own: Hysteresis, law: str) -> Hysteresis:
    """Returns a loop of the hysteresis law ``law`` with the same height and the same travel to half
    crossing.
    """
    unit: dict[str, Any] = {"law": law, **LAWS[law]}
    travel_deg = _half_crossed_deg(own) / _half_crossed_deg(_TRUE.validate_python(unit))
    size = "width_deg" if "width_deg" in unit else "yield_deg"
    offset_arcsec = (
        sum(each.limit_arcsec for each in own.elements) if isinstance(own, MaxwellSlip) else own.offset_arcsec
    )
    return _TRUE.validate_python(unit | {"offset_arcsec": offset_arcsec, size: travel_deg})


def _half_crossed_deg(loop: Hysteresis) -> float:
    """Returns the motor travel after a reversal at which the error crosses zero; degrees."""
    far_deg = LONG * _width_deg(loop)

    def left(travel_deg: float) -> float:
        law = law_of(loop, 0.0)
        assert law is not None
        law.advance(far_deg)
        return law.advance(far_deg - travel_deg)

    return float(brentq(left, 0.0, far_deg))


def _width_deg(loop: Hysteresis) -> float:
    if isinstance(loop, MaxwellSlip):
        return 2.0 * max(each.yield_deg for each in loop.elements)
    return loop.width_deg if loop.law == "rolling_friction" else loop.yield_deg


def _with_loop(truth: Truth, loop: Hysteresis) -> Truth:
    return truth.model_copy(update={"gear": truth.gear.model_copy(update={"hysteresis": loop})})


# ----------------------------------------------------------------
# Uncertainty of the coordinates: information from the slopes, and a jackknife over legs.

DETERMINED = 10.0
"""Minimum information about a principal direction, relative to the prior's, for it to count as determined."""


def principal(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Returns the principal directions of the coordinates as columns, shape (p, p), scaled to unit
    information.

    A long valley of the misfit is one of these directions. The covariance may inflate each direction
    separately; inflating each *coordinate* would lose the well-known combinations of two coordinates.
    """
    information, directions = eigen(slopes, spread)
    return np.asarray(spread[:, None] * directions / np.sqrt(information), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Jackknife:
    """Jackknife over legs: the shift of the fit when one leg is left out.

    A leg that a replay cannot follow shifts the fit in every direction that the other legs leave
    undetermined, although its own residuals stay small (Bell and McCaffrey, Survey Methodology 28, 2002).

    Only one variance per principal direction is estimated, because a few legs do not determine the full
    covariance.
    """

    along: FloatArray
    """Principal directions as columns, shape (p, p)."""
    between: FloatArray
    """Variance between legs of each principal direction, shape (p,)."""
    independent: float
    """Variance of each principal direction if the residuals were independent."""
    information: FloatArray
    """Information about each principal direction, relative to the prior's, shape (p,)."""

    @classmethod
    def over(
        cls, legs: NDArray[np.intp], slopes: FloatArray, left: FloatArray, spread: FloatArray
    ) -> Jackknife:
        """Estimates the variances from the residuals ``left`` (n,), with the number of the leg of each.

        The part of the residuals that the slopes (n, p) can still explain is removed first, because it is not
        scatter between legs.
        """
        along = principal(slopes, spread)
        known = np.sum(np.square(along / spread[:, None]), axis=0)
        left = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
        linear = Linearised(slopes @ along, left, np.stack([known, np.zeros_like(known)], axis=1))
        drawn = steps_without(linear, numbered(legs), lambda rows: White(np.ones(np.count_nonzero(rows))))
        between = np.sum(np.square(drawn), axis=0) * (1.0 - 1.0 / len(drawn))
        independent = max(1.0, float(left @ left) / max(len(left) - len(spread), 1))
        return cls(along, between, independent, 1.0 / known)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the coordinates, shape (p, p).

        Each variance is at least that of independent residuals of the same size, and at most that of the
        prior.
        """
        times = np.minimum(np.maximum(self.between, self.independent), self.information)
        return np.asarray(self.along * times @ self.along.T, dtype=np.float64)

    @property
    def scatter(self) -> float:
        """Variance between legs relative to that of independent residuals; NaN if nothing is determined.

        It is the mean over the determined principal directions, and about 1 if the simulated drive can
        represent the axis. If it cannot, the parameters differ between legs, however small the residuals are
        (information matrix test, White, Econometrica 50, 1982).
        """
        shown = self.between[self.information > DETERMINED]
        return float(np.mean(shown)) / self.independent if len(shown) else math.nan


def eigen(slopes: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns information and principal directions of the coordinates, in units of their spreads."""
    root = np.linalg.qr(np.concatenate([slopes * spread, np.eye(len(spread))]), mode="r")
    _, size, directions = np.linalg.svd(root)
    return size**2, np.asarray(directions.T, dtype=np.float64)


# ----------------------------------------------------------------

STEP = 0.01
"""Finite-difference step of the first Jacobian, in units of a parameter's spread."""
RESIDUAL_CHANGE = 1.0
"""Norm of the change of the scaled residuals at which the later difference steps aim: one standard deviation,
the smallest visible change."""
MAX_DIFFERENCE = 0.1
"""Maximum length of a difference step, in spreads; longer steps leave the curved valley of the misfit."""
WIDE_FACTOR = 3.0
"""Factor for the (two-sided) difference steps from which intervals are computed. A sticking motor breaks away
differently in each replay, so slopes over short differences are too steep and intervals too narrow."""
MAX_RESIDUAL_CHANGE = 1.0
"""Rms change of the scaled residuals above which the servo loops count as unstable at the end of a difference
step."""
SHORTENING = 0.1
"""Factor by which a difference step is shortened if the residuals change by more than
`MAX_RESIDUAL_CHANGE`."""
STEPS_PER_ROUND = 4
"""Number of steps between two estimates of the residuals' scales."""
STEPS_PER_RIVAL_ROUND = 2
"""The same for a fit that is compared with a rival after each round."""
BOUND_MARGIN = 1e-6
"""Minimum distance to the bounds, in spreads, as required by `scipy.optimize.least_squares`."""
MIN_COST_DECREASE = 1.0
"""Decrease of half the sum of squares in a round below which a fit ends. A round ends at a step with less
than its share of this decrease."""
MIN_RELATIVE_DECREASE = 0.01
"""The same, relative to the sum of squares, for a fit whose scales are not those of its residuals."""
HUBER_THRESHOLD = 4.0
"""Residuals above this multiple of their scale are down-weighted, because a motor that breaks away at a
different position is not evidence."""

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fit of some parameters."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    prior: FloatArray
    """Prior mean of the parameters' coordinates, shape (p,)."""
    place: FloatArray
    """Fitted point: coordinates of the parameters, shape (p,)."""
    covariance: FloatArray
    """Covariance of the coordinates, shape (p, p)."""
    scales: Scales
    residuals: dict[str, FloatArray]
    rows: Mask
    """Mask of the fitted rows, one channel after the other."""
    vector: FloatArray
    """Softened scaled residuals of the fitted rows, shape (n,)."""
    jacobian: FloatArray
    """Derivatives of `vector` with respect to the coordinates, shape (n, p)."""
    scatter: float = math.nan
    """Variance between legs relative to that of independent residuals (`Jackknife.scatter`)."""
    interrupted: bool = False
    """True if the fit was ended before it reached a minimum."""
    rough: bool = False
    """True if the fit minimises `misfit`, so that its values are not the most likely ones."""
    visited: tuple[tuple[FloatArray, float], ...] = ()
    """Other places to which a fit of the same parameters has led, which are not better, with their losses."""

    @property
    def cost(self) -> float:
        """Half the sum of squares of the softened scaled residuals."""
        return 0.5 * float(self.vector @ self.vector)

    @property
    def loss(self) -> float:
        """Negative log likelihood of the fitted readings, computed with the fit's own scales, which must
        include resolutions.

        The likelihood ratio of two fits to the same readings is the exponential of the difference between
        their losses.
        """
        return loss_of(self.residuals, self.scales, self.rows)

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Returns 95 % intervals by parameter name."""
        return intervals_of(self.parameters, self.place, self.covariance)


def intervals_of(
    parameters: Sequence[Parameter], place: FloatArray, covariance: FloatArray
) -> dict[str, tuple[float, float]]:
    """Returns 95 % intervals by parameter name, from coordinates and their covariance."""
    reach = NORMAL_95 * np.sqrt(np.diag(covariance))
    return {
        each.name: (each.value(float(x - r)), each.value(float(x + r)))
        for each, x, r in zip(parameters, place, reach, strict=True)
    }


@dataclass(eq=False)
class _Problem:
    """Residuals and slopes as functions of the coordinates, for one estimate of the scales."""

    replays: Replays
    start: Truth
    parameters: tuple[Parameter, ...]
    prior: FloatArray
    rows: Mask
    along: FloatArray | None
    """Latest slopes, shape (n, p), which determine the directions of the next differences."""
    scale: Scales

    def __post_init__(self) -> None:
        self.spread = np.array([each.spread for each in self.parameters])
        self.low, self.high = np.array([each.bounds for each in self.parameters]).T
        self._found: dict[bytes, dict[str, FloatArray]] = {}

    def found(self, place: FloatArray) -> dict[str, FloatArray]:
        """Returns the residuals by channel; does not replay the last point again."""
        key = place.tobytes()
        if key not in self._found:
            self._found = {key: self._replayed([place])[0]}
        return self._found[key]

    def residuals(self, place: FloatArray) -> FloatArray:
        """Returns the softened scaled residuals, followed by the distances from the prior."""
        left = softened(self.found(place), self.scale, self.rows)
        return np.concatenate([left, (place - self.prior) / self.spread])

    def cost(self, place: FloatArray) -> float:
        """Returns half the sum of squares of `residuals`."""
        left = self.residuals(place)
        return 0.5 * float(left @ left)

    def slopes(self, place: FloatArray, *, wide: bool = False) -> FloatArray:
        """Returns the derivatives of the softened residuals with respect to the coordinates, shape (n, p)."""
        moves = np.diag(STEP * self.spread) if self.along is None else _moves(self.along, self.spread)
        now = self.scale.scaled(self.found(place))[self.rows]
        slopes = slopes_at(self._scaled, now, place, moves, (self.low, self.high), wide=wide)
        self.along = slopes * robust_residuals(now, self.scale, self.rows)[1][:, None]
        return self.along

    def stepped(self, place: FloatArray, steps: int, relevant: float) -> FloatArray:
        """Returns the best point after up to ``steps`` trust-region steps, the first of which has the length
        of a spread; ends at a step with a smaller decrease of the cost, relative to the cost, than
        ``relevant``.
        """
        left, prior = 1 + steps, np.eye(len(place))

        def at(move: FloatArray) -> FloatArray:
            there: FloatArray = np.clip(place + move * self.spread, self.low, self.high)
            return there

        def residuals(move: FloatArray) -> FloatArray:
            nonlocal left
            left -= 1
            return self.residuals(at(move))

        def slopes(move: FloatArray) -> FloatArray:
            # `least_squares` also requests slopes after the last step, but does not use them.
            latest = self.slopes(at(move)) if left or self.along is None else self.along
            return np.concatenate([latest * self.spread, prior])

        end = least_squares(
            residuals,
            np.zeros(len(place)),
            slopes,
            (
                (self.low - place) / self.spread - BOUND_MARGIN,
                (self.high - place) / self.spread + BOUND_MARGIN,
            ),
            max_nfev=1 + steps,
            ftol=relevant,
            gtol=None,
        )
        return at(np.asarray(end.x, dtype=np.float64))

    def _scaled(self, places: Sequence[FloatArray]) -> list[FloatArray]:
        return [self.scale.scaled(each)[self.rows] for each in self._replayed(places)]

    def _replayed(self, places: Sequence[FloatArray]) -> list[dict[str, FloatArray]]:
        return self.replays([at_coordinates(self.start, self.parameters, each.tolist()) for each in places])


def solve(
    replays: Replays,
    start: Truth,
    parameters: tuple[Parameter, ...],
    steps: int,
    prior: FloatArray | None = None,
    known: Scales | None = None,
    everything: bool = False,
    near: Fitted | None = None,
    wide: bool = False,
    linear: bool = True,
    rival: float | None = None,
    share: float = 0.0,
) -> Fitted:
    """Fits parameters by `scipy.optimize.least_squares` in up to ``steps`` steps; with 0 steps, linearises.

    ``prior`` is the prior's mean, shape (p,), by default the start. ``known`` are the channels' scales, which
    grow with the residuals on the way to the minimum; by default they are estimated from the residuals before
    each round. Held-out legs count only with ``everything``. ``near`` is a fit of the same parameters that
    provides the directions of the first differences. With ``wide``, the covariance uses wide differences.
    Without ``linear``, the covariance is that of the prior, and the Jacobian that of the point before the
    last step. With a ``rival``, the loss of a fit to the same readings, the fit is given up before a round if
    the decrease of the last round, once more, would not reach the rival. ``share`` is the smallest relevant
    decrease of the cost in a round, relative to the cost, if that is more than `MIN_COST_DECREASE`.
    """
    data = replays.data
    rows = fitted_rows(data, everything=everything)
    place = np.array(coordinates(start, parameters))
    prior = place if prior is None else prior
    along = None if near is None else near.jacobian
    problem = _Problem(replays, start, parameters, prior, rows, along, Scales({}))
    done, loss = 0, math.inf
    while done < steps:
        found = problem.found(place)
        problem.scale = scales(data, found) if known is None else _tempered(known, found, rows)
        if rival is not None:
            last, loss = loss, loss_of(found, problem.scale, rows)
            if loss - rival > last - loss:
                break
        before = problem.cost(place)
        relevant = max(MIN_COST_DECREASE, share * before)
        taken = min(STEPS_PER_ROUND if rival is None else STEPS_PER_RIVAL_ROUND, steps - done)
        place = problem.stepped(place, taken, relevant / STEPS_PER_ROUND / before)
        done = done + taken if before - problem.cost(place) >= relevant else steps
    found = problem.found(place)
    problem.scale = known or scales(data, found)
    left = softened(found, problem.scale, rows)
    slopes, covariance, scatter = problem.along, np.diag(problem.spread**2), math.nan
    if linear or slopes is None:
        slopes = problem.slopes(place, wide=wide)
        jackknife = Jackknife.over(legs_of_rows(data, rows), slopes, left, problem.spread)
        covariance, scatter = jackknife.covariance, jackknife.scatter
    truth = at_coordinates(start, parameters, place.tolist())
    return Fitted(
        truth, parameters, prior, place, covariance, problem.scale, found, rows, left, slopes, scatter
    )


def continued(
    replays: Replays,
    best: Fitted,
    steps: int,
    truth: Truth | None = None,
    **options: Any,
) -> Fitted:
    """Continues a fit, at ``truth`` if given; ``options`` are those of `solve`."""
    return solve(replays, truth or best.truth, best.parameters, steps, best.prior, **options)


def with_parameters(fitted: Fitted, more: Sequence[Parameter], usual: Truth) -> Fitted:
    """Returns a fit to be continued with more parameters, whose prior is about their values in ``usual``."""
    unknown = np.zeros((len(fitted.jacobian), len(more)))
    return replace(
        fitted,
        parameters=(*fitted.parameters, *more),
        prior=np.append(fitted.prior, coordinates(usual, more)),
        jacobian=np.concatenate([fitted.jacobian, unknown], axis=1),
    )


def fitted_rows(data: Data, *, everything: bool = False) -> Mask:
    """Returns the mask of the rows used in a fit, one channel after the other."""
    return np.concatenate([each if everything else each & ~data.out for each in data.counts.values()])


def legs_of_rows(data: Data, rows: Mask) -> NDArray[np.intp]:
    """Returns the leg number of each fitted row."""
    return np.concatenate([data.leg] * len(CHANNELS))[rows]


def loss_of(found: dict[str, FloatArray], scale: Scales, rows: Mask) -> float:
    """Returns the negative log likelihood of the readings of some rows; the scales must include
    resolutions.
    """
    half, outlier_probability = (each[rows] for each in scale.halves(len(rows) // len(CHANNELS)))
    size, wide = np.abs(scale.scaled(found)[rows]), np.maximum(half, FINE)
    return float(np.sum(surprisal(size, wide, outlier_probability) - np.log(half / wide)))


def softened(found: dict[str, FloatArray], scale: Scales, rows: Mask) -> FloatArray:
    """Returns the residuals of some rows, transformed by their likelihood and softened."""
    return robust_residuals(scale.scaled(found)[rows], scale, rows)[0]


def robust_residuals(off: FloatArray, scale: Scales, rows: Mask) -> tuple[FloatArray, FloatArray]:
    """Transforms scaled residuals by their likelihood and softens them; also returns the derivative."""
    half, outlier_probability = (each[rows] for each in scale.halves(len(rows) // len(CHANNELS)))
    root, slope = deviance_residuals(off, half, outlier_probability)
    # Beyond `HUBER_THRESHOLD`, squares grow linearly (Huber loss).
    size = np.maximum(np.abs(root) / HUBER_THRESHOLD, 1.0)
    soft = np.sqrt(2.0 * size - 1.0)
    return np.where(size > 1.0, np.sign(root) * HUBER_THRESHOLD * soft, root), slope / soft


def _tempered(known: Scales, found: dict[str, FloatArray], rows: Mask) -> Scales:
    """Returns scales enlarged by the overall rms of the scaled residuals, if that exceeds one.

    Far from the minimum, residuals are much larger than the noise, and the prior would have no weight. All
    channels share one factor, so that the worst channel still dominates.
    """
    left = softened(found, known, rows)
    factor = max(1.0, float(np.sqrt(np.mean(np.square(left)))))
    return replace(known, deviation={name: factor * each for name, each in known.deviation.items()})


def slopes_at(
    seen: Callable[[Sequence[FloatArray]], list[FloatArray]],
    now: FloatArray,
    place: FloatArray,
    moves: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    *,
    wide: bool,
) -> FloatArray:
    """Returns finite-difference derivatives of the scaled residuals at the point ``place``, shape (n, p).

    ``seen`` evaluates the residuals at several points, ``now`` are the residuals at ``place``. Differences
    are taken along the moves, in the direction with more distance to the bounds; ``wide`` differences, for
    intervals, are `WIDE_FACTOR` times as long and two-sided.
    """
    both = [
        [np.clip(place + way * move, *bounds) for way in (1.0, -1.0)]
        for move in moves * (WIDE_FACTOR if wide else 1.0)
    ]
    if wide:
        ends = [end for pair in both for end in pair]
    else:
        ends = [max(pair, key=lambda each: float(np.linalg.norm(each - place))) for pair in both]
    changes = np.stack(seen(ends)) - now
    far = np.flatnonzero(np.mean(np.square(changes), axis=1) > MAX_RESIDUAL_CHANGE**2)
    if wide and len(far):
        for each in far:
            ends[each] = place + SHORTENING * (ends[each] - place)
        changes[far] = np.stack(seen([ends[each] for each in far])) - now
    return np.asarray((np.linalg.pinv(np.stack(ends) - place) @ changes).T, dtype=np.float64)


def _moves(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Returns difference steps along the principal directions; each changes the residuals by
    `RESIDUAL_CHANGE`.
    """
    information, directions = eigen(slopes, spread)
    far = np.minimum(RESIDUAL_CHANGE / np.sqrt(information), MAX_DIFFERENCE)
    moves: FloatArray = (directions * far).T * spread
    return moves


# ----------------------------------------------------------------
# Servo structures: the simulated servo consists of blocks (`hdbridge.sim.servo`). A structure far from the
# start has its own minimum. Blocks are added one at a time, and kept if they reduce the residuals on held-out
# legs.

BANDWIDTHS: Final = ((25.0, 100.0), (80.0, 300.0), (200.0, 800.0))
"""Position gain, 1/s, and ratio of velocity gain to total inertia, rad/s, for a geared axis with a soft load,
with an ordinary load and with a stiff load."""
REJECTIONS: Final = ("speed", "position", "observer")
"""Alternatives for the block that compensates friction and load torque: the integral of the speed error (PI
velocity loop) or of the position error (PIV), or a disturbance observer."""
INTEGRAL: Final = 3.0
"""Product of integral time and velocity-loop bandwidth (symmetric optimum: 2 to 4)."""
SLOW_INTEGRAL: Final = 30.0
"""Product of integral time and velocity-loop bandwidth if there is an observer, because the observer leaves
little for the integral term to correct."""
OBSERVED: Final = 0.9
"""Start value of the fraction of the disturbance that the observer compensates: nearly all."""
FILTER_MS: Final = 0.5
"""Start value of the time constant of the speed and torque filters: half to twice the period of common
velocity loops."""
SHORT_MS: Final = 0.1
"""Time constant of a negligible command filter: a fifth of a substep."""
VELOCITY_FEEDFORWARD: Final = 0.9
"""Start value of the speed feed-forward, between none (rare) and the full speed."""
FEW_STEPS = 2
"""Maximum number of steps for each start between two halvings. On a servo of a different structure, the eight
best of 27 starts after three steps were among the better ten after two, but not after one."""
USUAL_STEPS = 3
"""The same for the usual servo, which must come near the noise on few starts."""
MAX_COST_RATIO: Final = 3.0
"""Ratio of a start's cost to the lowest cost, after the same number of steps, above which a start is dropped
even if it is in the better half. On three servos of a different structure, the winning starts had ratios of
at most 1.8."""
HOPELESS_RATIO: Final = 30.0
"""Ratio of the mean square of the residuals after a halving to the largest near the noise, above which no
spring and no lag is fitted any further, because the servo has a different structure."""
MOST_RELATIVE_ERROR: Final = 0.1
"""Maximum relative standard error of load inertia and spring from regressions for holding them."""
MOST_OFF: Final = 0.25
"""Maximum difference of a fit near the noise from held values, as logarithm. Such values were at most 0.2 off
on 22 axes (`hdbridge.twin.mechanics`)."""
MAX_MISFIT_RATIO: Final = 0.97
"""Maximum ratio of the misfits with and without a block or a measured response for keeping it; a superfluous
one gains less."""
MECHANICS: Final = (
    "motor inertia", "Coulomb friction", "viscous friction", "friction's rise at rest", "Stribeck speed",
    "load inertia", "gear stiffness", "gear damping",
)  # fmt: skip
SERVOS: Final = (
    "position gain", "velocity gain", "integral time", "command filter", "velocity feed-forward",
    "servo dead time", "speed filter", "torque filter", "load encoder delay",
)  # fmt: skip
NOTCH: Final = ("notch frequency", "notch depth", "notch width")
AVERAGE: Final = "moving average"
FRICTION: Final = "friction feed-forward"
REACTION: Final = "loop reaction"
OBSERVER: Final = ("observer frequency", "observer share", "observer inertia")
MOST_DEAD_CYCLES: Final = 2.0
"""Maximum dead time in SYNC cycles: one to accept the demand, one to execute it (CiA 402)."""
PLACES: Final = (0.7, 1.0, 1.4)
"""Start values of the notch frequency, relative to the resonance of motor and load."""


Start = tuple[Truth, tuple[Parameter, ...]]
"""Start of the fit of a servo structure: the truth, and the parameters to fit."""


def in_best_structure(
    few: Replays, begun: Iterable[Start], keep: Callable[[Fitted], None] = lambda _: None
) -> Fitted:
    """Fits the servo structure that explains a few legs best, and adds blocks that held-out legs confirm."""
    scale = Scales(units(few.data))
    best = by_halving(few, begun, scale)
    keep(best)
    while more := list(more_blocks(best)):
        found = by_halving(few, more, scale)
        if misfit(few.data, found.residuals) > MAX_MISFIT_RATIO * misfit(few.data, best.residuals):
            break
        best = found
        keep(best)
    return best


def by_halving(
    few: Replays,
    begun: Iterable[Start],
    known: Scales,
    keep: Callable[[Fitted], None] = lambda _: None,
    suffices: Callable[[Fitted], bool] = lambda _: False,
    hopeless: Callable[[Fitted], bool] = lambda _: False,
    few_steps: int = FEW_STEPS,
) -> Fitted:
    """Fits from each start for ``few_steps`` steps, continues with the better half, and repeats until one is
    left, which is fitted to the neighbourhood of its minimum.

    Successive halving (Jamieson and Talwalkar, AISTATS 2016) does not drop a start that is far from a better
    minimum in favour of one that is already near its own minimum. All legs count, because a few held-out legs
    do not decide between servos with equally many parameters. Of starts that have come together, only the
    best is continued. No other start is tried after one that ``suffices``, and none is continued if the best
    is ``hopeless``.
    """

    def led(start: Start, steps: int = few_steps) -> Fitted:
        return solve(few, *start, steps, known=known, linear=False, share=MIN_RELATIVE_DECREASE)

    tried: list[Fitted] = []
    for start in begun:
        tried.append(led(start))
        if suffices(tried[-1]):
            tried = tried[-1:]
            break
    while True:
        best, *others = sorted(tried, key=lambda each: each.cost)[: (len(tried) + 1) // 2]
        tried = [best]
        for each in others:
            apart = each.cost - tried[-1].cost > MIN_LOG_LIKELIHOOD_RATIO
            if apart and each.cost <= MAX_COST_RATIO * best.cost:
                tried.append(each)
        keep(best)
        if hopeless(best):
            return best
        if len(tried) == 1:
            return led((best.truth, best.parameters), MORE_STEPS)
        tried = [led((each.truth, each.parameters)) for each in tried]


def starts(truth: Truth, cycle_ms: float) -> Iterator[Start]:
    """Yields the servo structures from which fits start.

    An acceleration feed-forward uses the filtered demand, or differences over whole SYNC cycles, which
    corresponds to a moving average over one cycle. A lag beyond the longest possible dead time is attributed
    to the command filter.
    """
    longest_ms = min(MOST_DEAD_CYCLES * cycle_ms, DEAD_TIME.most)
    reaction = (REACTION,) if truth.gear.hysteresis else ()
    known = {each: BY_NAME[each] for each in (*MECHANICS, *SERVOS, *reaction)}
    known[DEAD_TIME.name] = replace(DEAD_TIME, most=longest_ms)
    averaged_ms = min(cycle_ms, BY_NAME[AVERAGE].most)
    late_ms = max(_lag_ms(truth) - 0.5 * averaged_ms, 2.0 * SHORT_MS)
    plain = _divided(_lag_ms(truth), min(truth.servo.dead_time_ms, longest_ms))
    averaged = {AVERAGE: averaged_ms, **_divided(late_ms, min(late_ms - 2.0 * SHORT_MS, longest_ms))}
    whole = truth.motor.inertia_kg_m2 + truth.load_.whole_inertia_kg_m2 / truth.gear.ratio**2
    fastest = VELOCITY_BANDWIDTH_RAD_S * truth.motor.inertia_kg_m2
    commands = (
        (plain, 0.0, ()),
        (plain, whole, ("inertia feed-forward",)),
        (averaged, whole, ("inertia feed-forward", AVERAGE)),
    )
    for gain, rate in BANDWIDTHS:
        for (command, forward, more), rejection in product(commands, REJECTIONS):
            observed = rejection == "observer"
            if observed:
                more = (*more, *OBSERVER)  # noqa: PLW2901
            observer = TrueObserver(frequency_hz=rate / math.tau, share=OBSERVED, inertia_kg_m2=whole)
            servo = truth.servo.model_copy(
                update={
                    "position_gain_per_s": gain,
                    "velocity_gain_nm_s_per_rad": min(rate * whole, fastest),
                    "integral_of": "speed" if observed else rejection,
                    "integral_time_ms": 1e3 * (SLOW_INTEGRAL if observed else INTEGRAL) / rate,
                    "observer": observer if observed else None,
                    "velocity_feedforward": VELOCITY_FEEDFORWARD,
                    "speed_filter_ms": FILTER_MS,
                    "torque_filter_ms": FILTER_MS,
                    "inertia_feedforward_kg_m2": forward,
                    "load_feedforward": None,
                    "viscous_feedforward_nm_s_per_rad": 0.0,
                    "friction_feedforward_nm": 0.0,
                }
            )
            parameters = (*known.values(), *named(*more))
            begun = with_values(truth.model_copy(update={"servo": servo}), command)
            yield with_sections(begun, parameters), parameters


def more_blocks(best: Fitted) -> Iterator[Start]:
    """Yields variants of the servo with one block added or replaced."""
    truth, servo = best.truth, best.truth.servo
    if servo.notch is None:
        load = truth.load_.whole_inertia_kg_m2
        motor = truth.motor.inertia_kg_m2 * truth.gear.ratio**2
        free_hz = math.sqrt(truth.gear.stiffness_nm_per_rad * (1.0 / load + 1.0 / motor)) / math.tau
        for place in PLACES:
            notch = dict(zip(NOTCH, (min(place * free_hz, 600.0), 0.5, 0.7), strict=True))
            yield with_values(truth, notch), (*best.parameters, *named(*NOTCH))
    if BY_NAME[AVERAGE] not in best.parameters:
        lag_ms = min(max(2.0 * servo.command_filter_ms, 0.5), 3.0)
        averaged = with_values(truth, {AVERAGE: 2.0 * lag_ms, FILTER.name: SHORT_MS})
        yield averaged, (*best.parameters, BY_NAME[AVERAGE])
    filters = named("speed filter", "torque filter")
    if not {*filters} & {*best.parameters}:
        yield with_sections(truth, filters), (*best.parameters, *filters)
    if truth.gear.hysteresis and BY_NAME[REACTION] not in best.parameters:
        yield with_values(truth, {REACTION: 0.5}), (*best.parameters, BY_NAME[REACTION])
    if BY_NAME[FRICTION] not in best.parameters:
        fed_forward = with_values(truth, {FRICTION: 0.3 * truth.motor.coulomb_nm})
        yield fed_forward, (*best.parameters, BY_NAME[FRICTION])


# ----------------------------------------------------------------
# Alternative start values, near which the misfit may have other minima.

FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Start values of the frequency of the load feed-forward; a fit finds only the nearest minimum."""
VALLEY_STEPS = (-0.3, 0.3)
"""Changes of the dead time along the valley of the misfit, in substeps. On random axes (852 to 860,
tools/twin_random_axes.py), neighbouring minima were 0.1 to 0.35 substeps apart."""
FILTER_SHARES = (0.25, 0.5, 0.75, 0.9)
"""Start values of the fraction of the lag that is due to the command filter."""


def lags(truth: Truth) -> list[Truth]:
    """Returns variants of the truth with the lag divided differently between command filter and dead time."""
    return [_with_dead_time(truth, (1.0 - share) * _lag_ms(truth)) for share in FILTER_SHARES]


def delays(truth: Truth, most_ms: float = DEAD_TIME.most) -> list[Truth]:
    """Returns variants of the truth with the same lag and the dead time in each of the other substeps up to
    ``most_ms``.

    The demand changes slope at the start of a cycle, and a torque lasts for a substep. A change within a
    substep is spread over two substeps, as by a filter, so the misfit over the dead time has a minimum in
    every substep.
    """
    step_ms, now = truth.substep_ms, _substep(truth)
    most_ms = min(_lag_ms(truth) - 2.0 * FILTER.least, most_ms)
    places = range(int(most_ms / step_ms + 0.5))
    return [_with_dead_time(truth, (each + 0.5) * step_ms) for each in places if each != now]


def along_valley(best: Fitted) -> list[Truth]:
    """Returns variants of a fit with a longer or shorter dead time, in which the other parameters compensate
    the change as far as the slopes show.
    """
    if DEAD_TIME.name not in (names := [each.name for each in best.parameters]):
        return []
    number = names.index(DEAD_TIME.name)
    spread = np.array([each.spread for each in best.parameters])
    slopes = np.concatenate([best.jacobian * spread, np.eye(len(spread))])
    others = np.delete(slopes, number, axis=1)
    moved = np.insert(np.linalg.lstsq(others, -slopes[:, number], rcond=None)[0], number, 1.0)
    per_ms, step_ms = moved * spread / spread[number], best.truth.substep_ms
    places = [best.place + step * step_ms * per_ms for step in VALLEY_STEPS]
    low, high = best.parameters[number].bounds
    return [
        at_coordinates(best.truth, best.parameters, each.tolist())
        for each in places
        if low <= each[number] <= high
    ]


def _most_ms(best: Fitted) -> float:
    """Returns the upper bound of the dead time in a fit; beyond it, all starts would be the same."""
    return next((each.most for each in best.parameters if each.name == DEAD_TIME.name), DEAD_TIME.most)


def _substep(truth: Truth) -> int:
    """Returns the number of the substep in which a delayed demand takes effect."""
    return int(truth.servo.dead_time_ms / truth.substep_ms)


def _lag_ms(truth: Truth) -> float:
    """Returns the total delay of filter and dead time at constant speed; ms."""
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def _with_dead_time(truth: Truth, dead_time_ms: float) -> Truth:
    """Returns the truth with the given dead time and the same lag."""
    return with_values(truth, _divided(_lag_ms(truth), dead_time_ms))


def _divided(lag_ms: float, dead_time_ms: float) -> dict[str, float]:
    """Returns dead time and command filter by parameter name; within their bounds, they cause this lag."""
    dead_time_ms = min(dead_time_ms, DEAD_TIME.most)
    return {FILTER.name: min(0.5 * (lag_ms - dead_time_ms), FILTER.most), DEAD_TIME.name: dead_time_ms}


def feedforwards(truth: Truth, usual: Truth) -> list[Truth]:
    """Returns variants of the truth with different load feed-forward frequencies.

    The feed-forward inertias of motor and load keep their sum and are divided as in ``usual``.
    """
    servo, load, there = truth.servo, truth.servo.load_feedforward, usual.servo.load_feedforward
    if load is None or there is None:
        return []
    both = servo.inertia_feedforward_kg_m2 + load.inertia_kg_m2
    share = there.inertia_kg_m2 / (usual.servo.inertia_feedforward_kg_m2 + there.inertia_kg_m2)
    inertias = {"inertia feed-forward": (1.0 - share) * both, "load feed-forward": share * both}
    return [with_values(truth, {**inertias, "load feed-forward frequency": hz}) for hz in FREQUENCIES_HZ]


def exchanged(truth: Truth) -> Truth:
    """Returns the truth with position gain and inverse integral time exchanged, within their bounds.

    In motion both truths have the same loop, because its response depends only on the sum and the product of
    the two. The misfit therefore has two minima.
    """
    gain, time = BY_NAME["position gain"], BY_NAME["integral time"]
    servo = truth.servo
    swapped = {gain.name: 1e3 / servo.integral_time_ms, time.name: 1e3 / servo.position_gain_per_s}
    within = {each.name: min(max(swapped[each.name], each.least), each.most) for each in (gain, time)}
    return with_values(truth, within)


# ----------------------------------------------------------------
# Optional parameters, which a fit adds at the end if the recording shows them.

GROWTH: Final = "friction growth"
OPTIONAL_GROUPS: Final = (
    ("velocity feed-forward",),
    ("encoder coupling",),
    (GROWTH,),
    ("friction's rise at rest", "Stribeck speed"),
)
"""Groups of optional parameters; each group is added as a whole or not at all."""
MIN_LOG_LIKELIHOOD_RATIO = 8.0
"""Minimum log likelihood ratio for adding parameters or leaving the start's minimum: exp(8) to one."""
MIN_Z_SCORE = 4.0
"""Minimum change of the first parameter of a group of `OPTIONAL_GROUPS`, standard deviations."""
TRIAL_STEPS = 6
"""Steps of a trial fit with added parameters; one step is not enough, because the Stribeck speed is visible
only once the rise of the friction is not zero."""
LOOP_STEPS = 10
"""Steps of the trial fit of each hysteresis law on a few legs, with all other parameters fixed."""


def with_optional_groups(replays: Replays, best: Fitted) -> Fitted:
    """Adds the significant groups of `OPTIONAL_GROUPS`; the returned fit is not yet at its minimum."""
    for names in OPTIONAL_GROUPS:
        extra = [each for each in named(*names) if each not in best.parameters]
        if not extra or (GROWTH in names and not _warms(replays.data)):
            continue
        there = with_sections(best.truth, extra)
        wider = with_parameters(best, extra, there)
        tried = continued(replays, wider, TRIAL_STEPS, there, known=best.scales, linear=False)
        if best.cost - tried.cost <= MIN_LOG_LIKELIHOOD_RATIO:
            continue
        tried = continued(replays, tried, 0, known=best.scales, near=tried)
        new = len(best.parameters)
        off = abs(float(tried.place[new] - wider.prior[new]))
        if off > MIN_Z_SCORE * math.sqrt(float(tried.covariance[new, new])):
            best = tried
    return best


def _warms(data: Data) -> bool:
    """Returns True if the initial temperatures of the pieces differ by a relevant amount."""
    begun = [each.commands.start_c for each in data.pieces]
    known_c = [each for each in begun if each is not None]
    return len(known_c) == len(begun) and max(known_c) - min(known_c) > BY_NAME["temperature"].least_change


def with_loop(replays: Replays, best: Fitted) -> Fitted | None:
    """Returns the fit with a better hysteresis law of the gear, or None.

    None means that the load's residuals are already as small as those of the true axis, or that no law
    reduces them significantly. Each law is fitted to a few legs, with all other parameters fixed. Must be
    called again after a new fit, because a different law may then be the best.
    """
    noise, few = expected(replays.data), replays.rough
    if best.scales.deviation[LOAD] <= noise.deviation[LOAD]:
        return None
    fitted = any(each.cause == ELASTIC for each in best.parameters)
    laws = [(there, loop_parameters(there)) for there in by_each_law(best.truth)[fitted:]]
    led = [solve(few, there, own, LOOP_STEPS, known=noise, linear=False) for there, own in laws if own]
    nearest = min(led, key=lambda each: each.cost, default=None)
    if nearest is None or best.cost - _cost(replays, nearest.truth, best) < MIN_LOG_LIKELIHOOD_RATIO:
        return None
    rest = [number for number, each in enumerate(best.parameters) if each.cause != ELASTIC]
    parameters = (*(best.parameters[number] for number in rest), *nearest.parameters)
    prior = np.append(best.prior[rest], nearest.prior)
    return solve(replays, nearest.truth, parameters, STEPS, prior, linear=False)


def with_limit(replays: Replays, best: Fitted, usual: Truth) -> Fitted:
    """Fits the drive's torque limit if the recording shows it, else sets the usual limit.

    Before this step, the fit uses the highest recorded torque as the limit if the recording holds it
    (`start_of`). This torque is the drive's limit, rather than merely the torque that the motion requires, if
    a replay without the limit has significantly larger residuals.
    """
    highest = free_value(usual, LIMIT)
    if free_value(best.truth, LIMIT) >= highest or LIMIT in best.parameters:
        return best
    without = with_values(best.truth, {LIMIT.name: highest})
    if _cost(replays, without, best) - best.cost <= MIN_LOG_LIKELIHOOD_RATIO:
        return replace(best, truth=without)
    return continued(replays, with_parameters(best, [LIMIT], usual), STEPS)


def _cost(replays: Replays, truth: Truth, best: Fitted) -> float:
    """Returns half the sum of squares of a truth's residuals, with the scales of a fit."""
    (found,) = replays([truth])
    left = softened(found, best.scales, fitted_rows(replays.data))
    return 0.5 * float(left @ left)


# ----------------------------------------------------------------

FIT_S = 60.0
"""Total duration of the pieces of a longer recording that are fitted, with all kinds of motion if possible; a
thousand replays of a quarter of an hour would take hours."""
MORE_STEPS = 10
"""Maximum number of steps from an alternative start, over the whole recording."""
STEPS = 30
"""Maximum number of steps over the whole recording."""
EXCESS_RATIO = 1.1
"""Ratio to the true axis's residuals above which a fit has excess residuals; the scales themselves are not
known more accurately."""
OPTIONAL = (
    "velocity feed-forward", "load friction", "temperature", "current limit", "motor encoder delay",
    "encoder coupling", "friction growth", "moving average", REACTION, *LOOP,
)  # fmt: skip
"""Parameters fitted only on request or if significant, because ordinary motion does not show them, other
parameters have the same effect, or a calibration has determined them."""


def free_parameters(truth: Truth, more: Sequence[str] = ()) -> tuple[Parameter, ...]:
    """Returns the parameters of the truth to fit, without `OPTIONAL` ones that are not in ``more``."""
    free = []
    for each in PARAMETERS:
        value = value_in(truth, each)
        absent = value is None or (value <= each.least and not each.linear)
        if not absent and (each.name not in OPTIONAL or each.name in more):
            free.append(each)
    return tuple(free)


@on_one_thread
def fit(replays: Replays, progress: Progress = lambda _: None) -> Fitted:
    """Fits the parameters, starting from the truth with which the recordings were prepared.

    If the residuals with this truth's servo are many times the noise, other servo structures are tried as
    well. If a channel remains unexplained afterwards, or the legs disagree about the parameters, blocks are
    added. Ctrl-C ends the fit at the best point so far, if there is one.
    """
    reached: list[Fitted] = []
    try:
        best = _fit(replays, progress, reached.append)
    except KeyboardInterrupt:
        if not reached:
            raise
        last = reached[-1]
        best = replace(_linearised(replays, last), interrupted=True)
    return best


def _fit(replays: Replays, progress: Progress, keep: Callable[[Fitted], None]) -> Fitted:
    data, few = replays.data, replays.rough
    measured, noise = measured_mechanics(data), expected(few.data)
    held = tuple(
        each
        for each in named(*HELD)
        if each.name in measured and measured[each.name].relative <= MOST_RELATIVE_ERROR
    )
    begun = start_of(data.base, data, measured)
    parameters = free_parameters(begun)
    progress(0.05)
    rows = fitted_rows(few.data)

    def squares(fitted: Fitted) -> float:
        return float(np.mean(np.square(softened(fitted.residuals, noise, rows)))) / HUBER_THRESHOLD**2

    def near(fitted: Fitted) -> bool:
        off = [math.log(free_value(fitted.truth, each) / measured[each.name].value) for each in held]
        return squares(fitted) < 1.0 and max(map(abs, off), default=0.0) < MOST_OFF

    def hopeless(fitted: Fitted) -> bool:
        return squares(fitted) > HOPELESS_RATIO

    usual = [(each, parameters) for each in (begun, *lags(begun))]
    # Near the noise, `_polished` compares minima.
    best = by_halving(few, usual, noise, keep, near, hopeless, USUAL_STEPS)
    best = replace(best, prior=np.array(coordinates(begun, parameters)))
    progress(0.2)
    if not near(best):
        # With free mechanics, a wrong servo may distort them and win.
        others = [(begun, parameters), *starts(begun, 1e3 * data.pieces[0].commands.cycle_s)]
        without = [(there, tuple(each for each in own if each not in held)) for there, own in others]
        best = in_best_structure(few, without, keep)
        best = with_parameters(best, held, best.truth)
    progress(0.5)
    polished, in_motion = None, noise_in_motion(data)
    while near(best):
        # The expected scales are used, because the residuals of a wrong simulation do not estimate the noise
        # and would reduce the weight of the very channel that shows the error.
        whole = continued(replays, best, STEPS, known=expected(data), near=best, linear=False)
        whole = _ended(replays, whole)
        if polished is not None and misfit(data, polished.residuals) <= misfit(data, whole.residuals):
            break
        keep(whole)
        polished, before = _polished(replays, whole, begun, keep), polished
        if values_in(polished, channel_residuals(data, polished.residuals, in_motion)) is Values.AXIS:
            return polished
        if before is not None and misfit(data, before.residuals) <= misfit(data, polished.residuals):
            polished = before
            break
        best = in_best_structure(few, [(polished.truth, polished.parameters)])
        if len(best.parameters) == len(polished.parameters):
            break
    progress(0.8)
    scale = Scales(units(data))
    whole = solve(
        replays, best.truth, best.parameters, STEPS, known=scale, linear=False, share=MIN_RELATIVE_DECREASE
    )
    if polished is not None and misfit(data, polished.residuals) <= misfit(data, whole.residuals):
        return polished
    rough = replace(_linearised(replays, whole), rough=True)
    return rough if polished is None else replace(rough, scatter=polished.scatter)


def values_in(fitted: Fitted, left: Sequence[ChannelResidual]) -> Values:
    """Returns the origin of the values of a fit from its residuals and the scatter of its legs."""
    return Values.REPLAY if fitted.interrupted or fitted.rough else values_of(left, fitted.scatter)


def _polished(replays: Replays, best: Fitted, begun: Truth, keep: Callable[[Fitted], None]) -> Fitted:
    """Moves a fit of all legs to its best minimum, and adds the parts that the recording shows."""
    laws = len(LAWS)  # maximum number of changes of the law
    best = _in_best_minimum(replays, best, begun)
    while True:
        wider = with_optional_groups(replays, best)
        if wider is not best:
            best = _in_nearby_minimum(replays, _ended(replays, wider))
            continue
        keep(best)
        # The loop comes last, because a wrong spring also leaves residuals of the load angle.
        other = with_loop(replays, best) if laws else None
        if other is None:
            break
        laws, best = laws - 1, _in_nearby_minimum(replays, other)
    limited = with_limit(replays, best, replays.data.base)
    best = best if limited is best else _ended(replays, limited)
    keep(best)
    # Wide differences are used for the covariance only, because the servo loops may be unstable near a
    # minimum.
    wide = continued(replays, best, 0, near=best, wide=True)
    return replace(wide, covariance=widened(wide, best.visited))


def _linearised(replays: Replays, found: Fitted) -> Fitted:
    """Returns a fit at the same point, with the scales of its residuals on these recordings."""
    return solve(replays, found.truth, found.parameters, 0)


def _in_best_minimum(replays: Replays, best: Fitted, begun: Truth) -> Fitted:
    """Moves the fit to significantly better minima until none is found: nearby, or with another dead time or
    frequency of the load feed-forward.

    The fit must be near a minimum, because the alternatives are equally good until the other parameters are
    known.
    """
    few, noise = replays.rough, expected(replays.rough.data)
    least = least_deviation(replays.data) | {LOAD: noise.deviation[LOAD]}
    while True:
        best = _in_nearby_minimum(replays, best)
        if all(best.scales.deviation[name] <= EXCESS_RATIO * least[name] for name in CHANNELS):
            return best
        others = [*delays(best.truth, _most_ms(best)), *feedforwards(best.truth, begun)]
        if not others:
            return best
        reached = best.place
        nearest = by_halving(few, [(each, best.parameters) for each in others], noise)
        best = _moved(replays, best, nearest.truth)
        if best.place is reached:
            return best


def _in_nearby_minimum(replays: Replays, best: Fitted) -> Fitted:
    """Moves the fit to the minima with exchanged gains, or with another dead time.

    They are always tried: exchanged gains differ only at rest, and another dead time increases the residuals
    too little for any channel to show it.
    """
    while True:
        reached = best.place
        for place in (exchanged(best.truth), *along_valley(best)):
            best = _moved(replays, best, place)
        if best.place is reached:
            return best


def _moved(replays: Replays, best: Fitted, place: Truth) -> Fitted:
    """Returns the fit from ``place`` if it is significantly better, else ``best``."""
    other = continued(replays, best, MORE_STEPS, place, rival=best.loss, linear=False)
    if other.loss + MIN_LOG_LIKELIHOOD_RATIO < best.loss:
        return _ended(replays, other)
    return replace(best, visited=(*best.visited, (other.place, other.loss)))


def widened(fitted: Fitted, visited: Sequence[tuple[FloatArray, float]]) -> FloatArray:
    """Returns the covariance of a fit, widened to the places that are nearly as likely.

    A motor that breaks away differently in each replay makes the slopes too steep in a flat valley. The
    square of the distance to a place, in standard deviations, is therefore at most one more than twice the
    difference between the losses.
    """
    covariance = fitted.covariance
    for place, loss in visited:
        off = place - fitted.place
        square = float(off @ np.linalg.solve(covariance, off))
        most = 1.0 + 2.0 * max(loss - fitted.loss, 0.0)
        if square > most:
            covariance = covariance + (1.0 / most - 1.0 / square) * np.outer(off, off)
    return covariance


def _ended(replays: Replays, near: Fitted) -> Fitted:
    """Continues a fit to its minimum."""
    return continued(replays, near, STEPS, near=near, linear=False)
