"""Response of the load to a correction of its target, from runs at constant speed, and the filter that
compensates this response.

A correction u of the load target moves the load by G u. The transmission error moves it by E, with or without
correction. With a correction c and the filter F (1 without a filter), the remaining error is E - G F c. Runs
without and with correction give, for each order and speed, the filter that cancels the error: ``W = F E / (E
- remainder)``. The model's amplitudes cancel out. W depends only on frequency, so one filter has the right
gain and phase at every speed.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects.orders import MotorOrder, compensated_orders
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.errors import InputError
from hdbridge.motion.procedures.even_speed import EvenRun
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN, rounded

ComplexArray = NDArray[np.complex128]
FloatArray = NDArray[np.float64]

LEAST_ARCSEC = 0.2
"""Minimum amplitude of an order that is evaluated."""
HIGHEST = 0.36
"""Highest fully corrected frequency, relative to the SYNC rate."""
STOP = 0.46
"""Lowest uncorrected frequency, relative to the SYNC rate."""
MIN_Z_SCORE = 4.0
"""Minimum ratio of an order's amplitude to its standard deviation for determining the response."""
MIN_DEVIATION = 0.01
"""Minimum relative standard deviation of a measured response, because it is not exactly linear."""
MIN_APPLIED = 0.05
"""Minimum gain of a filter at the frequencies at which its trial is evaluated."""
MAX_UNCERTAINTY = 0.5
"""Maximum 95 % half width of a known response, relative to its gain. Above it, the correction might leave
more than half of the order."""
BIN_HZ = 0.5
"""Frequency difference within which points are merged; at least the fraction `BIN_SHARE` of the frequency."""
BIN_SHARE = 0.01
MAX_GAP = 0.12
"""Maximum gap between two points of the known range, relative to the SYNC rate."""
LEAD_CYCLES = 8
LAG_CYCLES = 16
"""Number of past cycles in the filter, in addition to the following lag."""
POLES = 2
"""Number of poles of the filter, because the ringing of a resonance or servo notch outlasts the filter's
length."""
REFINEMENTS = 5
"""Number of iterations for the poles (Sanathanan and Koerner, 1963)."""
FADE = 0.12
"""Frequency range over which the filter falls to zero beyond its edge, relative to the SYNC rate."""
UNKNOWN = 0.5
"""Assumed response, relative to the transmission error, at frequencies without data."""
DIFFERENT = 0.1
"""Minimum relative rms difference between responses that count as different. It is also the fraction of the
error that the correction additionally leaves."""
DIFFERENT_LAG = 0.15
"""Minimum relative difference between following lags that count as different."""
LAG_NOISE_MS = 0.5
REFINED = 0.05
"""Minimum fraction of the ripple that a refinement must remove, as the root of the difference of squares:
half of `DIFFERENT`."""
SHARE_NOISE = 0.02
ERROR_CHANGE = 0.5
"""Standard deviations of the remainder (`SHARE_NOISE`) and of the change of the uncorrected error due to
different servo settings (`ERROR_CHANGE`), relative to the uncorrected error."""
FIRST_STEP = 0.5
"""Fraction of a filter's change that is applied in the first step."""
MAX_RUNS = 12
"""Maximum number of recent runs that are evaluated together, per order and frequency."""
REGULARISATION = 1e-3
FADE_SHARE = 0.3
SUM_WEIGHT = 1e3
"""Weight of the condition that the filter's gain at 0 Hz is one."""


class Limits(NamedTuple):
    """Limits of the axis for a correction, and the orders to correct."""

    orders: tuple[tuple[float, float], ...]
    """Highest frequency, Hz (at the speed limit), and amplitude, arcsec, of each order."""
    maximum_arcsec: float
    slew_arcsec_s: float
    acceleration_deg_s2: float

    @classmethod
    def of(cls, axis: AxisConfig, model: TransmissionModel) -> Self:
        """Returns the limits of the axis file for a correction of the model's motor orders."""
        speed = axis.limits.velocity_deg_s
        return cls(
            tuple(
                (float(order_hz(each.order, speed, model.ratio)), each.amplitude_arcsec)
                for each in motor_orders(model)
            ),
            axis.compensation.maximum_arcsec,
            axis.compensation.slew_arcsec_s,
            axis.limits.acceleration_deg_s2,
        )

    def excess(self, gain: float, frequency_hz: float) -> float:
        """Returns the factor by which the largest order's correction exceeds half of a limit; at least 1.

        The limits are those of the correction's size and slew rate. Orders that reach ``frequency_hz`` count.
        """
        largest_arcsec = max((size for top_hz, size in self.orders if top_hz >= frequency_hz), default=0.0)
        reach_arcsec = gain * largest_arcsec
        slew_arcsec_s = math.tau * frequency_hz * reach_arcsec
        return max(1.0, 2.0 * reach_arcsec / self.maximum_arcsec, 2.0 * slew_arcsec_s / self.slew_arcsec_s)

    def full_speed_deg_s(self, hertz: FloatArray, gains: FloatArray) -> float:
        """Returns the load speed, deg/s, from which a filter with these gains has its full effect.

        While the correction fades out at the end of a stop, it may contribute up to the fraction `FADE_SHARE`
        of the load's speed.
        """
        reach_arcsec = max(size * np.max(gains[hertz <= top_hz], initial=0.0) for top_hz, size in self.orders)
        return math.sqrt(2.0 * self.acceleration_deg_s2 * reach_arcsec / ARCSEC_PER_DEG / FADE_SHARE)


class Harmonics(NamedTuple):
    """Orders of the load error (load minus target) in one run; arcsec."""

    speed_deg_s: float
    amplitudes: ComplexArray
    """Complex amplitude of each order k, shape (orders,). The error is the real part of the sum of amplitudes
    times exp(i k motor angle)."""
    deviations: FloatArray
    """Standard deviation of the real or imaginary part of each amplitude."""
    mean_arcsec: float
    """Mean load error in the run."""
    ripple_arcsec: float
    """Rms of the load error about a straight line."""

    @property
    def over_time(self) -> ComplexArray:
        """Amplitudes as factors of exp(i w t); conjugated in backward motion, when the angle decreases."""
        return self.amplitudes if self.speed_deg_s > 0.0 else self.amplitudes.conj()


def _over_time(orders: Iterable[MotorOrder], speed_deg_s: float) -> ComplexArray:
    """Returns the model's complex amplitudes in the convention of `Harmonics.over_time`."""
    turned = math.copysign(math.pi / 180.0, speed_deg_s)
    return np.array([cmath.rect(each.amplitude_arcsec, turned * each.phase_deg) for each in orders])


def order_hz(order: ArrayLike, speed_deg_s: float, ratio: float) -> FloatArray:
    """Returns the frequency of a motor order at a load speed, Hz, shape of ``order``."""
    return np.asarray(order) * (abs(speed_deg_s) * ratio / DEG_PER_TURN)


def harmonics(run: EvenRun, orders: Sequence[int], ratio: float) -> Harmonics:
    """Fits orders of the uncompensated motor target to the load error of a run.

    Raises InputError if the run is too short.
    """
    if len(run.samples) < samples_needed(len(orders)):
        raise InputError(
            f"a run at {run.speed_deg_s:g} deg/s has only {len(run.samples)} samples at constant speed: "
            "allow more travel in the axis file"
        )
    target = np.array([each.load_target_deg for each in run.samples])
    error = ARCSEC_PER_DEG * (np.array([each.load_position_deg for each in run.samples]) - target)
    return harmonics_of(run.speed_deg_s, target, error, orders, ratio)


def samples_needed(orders: int) -> int:
    """Returns the minimum number of samples of a run to which this number of orders can be fitted."""
    return 4 * (2 * orders + 2)


def harmonics_of(
    speed_deg_s: float, target: FloatArray, error: FloatArray, orders: Sequence[int], ratio: float
) -> Harmonics:
    """Fits motor orders to a load error (n,), arcsec; ``target`` (n,) is the load target, degrees."""
    line = np.linspace(-1.0, 1.0, len(target))
    angle = np.radians(ratio * target)[:, None] * np.array(orders, dtype=float)
    design = np.column_stack([np.ones_like(line), line, np.cos(angle), -np.sin(angle)])
    solution, *_ = np.linalg.lstsq(design, error, rcond=None)
    rest = error - design @ solution
    variance = float(rest @ rest) / (len(error) - design.shape[1])
    spread = np.sqrt(variance * np.diag(np.linalg.pinv(design.T @ design)))
    count = len(orders)
    straight = error - np.polyval(np.polyfit(line, error, 1), line)
    return Harmonics(
        speed_deg_s,
        solution[2 : 2 + count] + 1j * solution[2 + count :],
        np.hypot(spread[2 : 2 + count], spread[2 + count :]) / math.sqrt(2.0),
        float(solution[0]),
        float(straight.std()),
    )


def motor_orders(model: TransmissionModel) -> list[MotorOrder]:
    """Returns the compensated motor orders of at least `LEAST_ARCSEC`."""
    return [each for each in compensated_orders(model.effects) if each.amplitude_arcsec >= LEAST_ARCSEC]


@dataclass(frozen=True, slots=True)
class Trial:
    """Runs with correction by one filter, in the same sequence as the runs without correction."""

    runs: tuple[Harmonics, ...]
    filter: LeadFilter | None = None


def following_lag_s(runs: Iterable[Harmonics]) -> float:
    """Fits the time lag of the load behind its target, together with the hysteresis offset."""
    given = list(runs)
    speed = np.array([each.speed_deg_s for each in given])
    mean = np.array([each.mean_arcsec for each in given]) / ARCSEC_PER_DEG
    design = np.column_stack([-speed, np.sign(speed), np.ones_like(speed)])
    return float(np.linalg.lstsq(design, mean, rcond=None)[0][0])


class Found(NamedTuple):
    """Measured response at one frequency."""

    frequency_hz: float
    response: complex
    """Load motion per unit of correction (G), relative to load motion per unit of transmission error."""
    deviation: float
    """Standard deviation of the response."""
    load: complex = 1.0
    """Load motion per unit of transmission error without correction; the following lag is excluded."""

    @property
    def uncertainty(self) -> float:
        """Half width of the 95 % interval of the response, relative to its gain."""
        return 2.0 * self.deviation / abs(self.response)


def response_of(
    none: Sequence[Harmonics],
    trials: Sequence[Trial],
    orders: Sequence[MotorOrder],
    ratio: float,
    cycle_s: float,
    limits: Limits,
    *,
    highest_hz: float = math.inf,
    explore: bool = False,
) -> Response | None:
    """Computes response and filter from runs without and with correction.

    Returns None if the response is known at no frequency. Above ``highest_hz``, the correction is partial.
    With ``explore``, the filter continues beyond the known range with its last gain, so that a run with the
    filter shows the response there.
    """
    lag_s = following_lag_s(none)
    points = _merged(_found(none, trials, orders, ratio, cycle_s, lag_s))
    highest_hz = min(highest_hz, HIGHEST / cycle_s)
    kept = _known(points, highest_hz, MAX_GAP / cycle_s, limits)
    if not kept:
        return None
    known_hz = min(kept[-1].frequency_hz, highest_hz)
    edge_hz = highest_hz if explore else known_hz
    fastest = order_hz(max(each.order for each in orders), max(abs(each.speed_deg_s) for each in none), ratio)
    per_cycle = min(max(2, math.ceil((float(fastest) + edge_hz) * cycle_s)), 4)
    return Response(
        cycle_ms=1000.0 * cycle_s,
        following_lag_ms=round(1000.0 * lag_s, 3),
        known_to_hz=round(known_hz, 2),
        frequency_hz=tuple(round(each.frequency_hz, 3) for each in points),
        uncertainty=tuple(rounded(each.uncertainty, 3) for each in points),
        filter=_filter(kept, edge_hz, lag_s, cycle_s, per_cycle, limits),
        **_columns("", [each.response for each in points]),
        **_columns("load_", [each.load for each in points]),
    )


def _columns(name: str, values: Iterable[complex]) -> dict[str, tuple[float, ...]]:
    """Returns the gain and phase fields of a `Response`, with the prefix ``name``."""
    values = list(values)
    return {
        f"{name}gain": tuple(rounded(abs(each)) for each in values),
        f"{name}phase_deg": tuple(round(math.degrees(cmath.phase(each)), 2) for each in values),
    }


def _found(
    none: Sequence[Harmonics],
    trials: Sequence[Trial],
    orders: Sequence[MotorOrder],
    ratio: float,
    cycle_s: float,
    lag_s: float,
) -> list[Found]:
    """Returns the responses from all trials, orders and speeds with a clear signal, sorted by frequency."""
    found: list[Found] = []
    for trial in trials:
        for before, after in zip(none, trial.runs, strict=True):
            hertz = order_hz([each.order for each in orders], before.speed_deg_s, ratio)
            lag = np.exp(-2j * math.pi * hertz * lag_s)
            applied = np.ones(len(orders)) if trial.filter is None else gain(trial.filter, hertz, cycle_s)
            error, effect = before.over_time, before.over_time - after.over_time
            clear = abs(error) > MIN_Z_SCORE * before.deviations
            clear &= (hertz < STOP / cycle_s) & (abs(applied) > MIN_APPLIED)
            with np.errstate(divide="ignore", invalid="ignore"):
                answer = effect / (applied * error) * lag
                share = np.hypot(before.deviations, after.deviations) / abs(applied * error)
                deviation = np.hypot(share, abs(answer) * before.deviations / abs(error))
            deviation = np.maximum(deviation, MIN_DEVIATION * abs(answer))
            load = error / (lag * _over_time(orders, before.speed_deg_s))
            columns = (each[clear].tolist() for each in (hertz, answer, deviation, load))
            found += [Found(*each) for each in zip(*columns, strict=True)]
    return sorted(found, key=lambda each: each.frequency_hz)


def _merged(found: Sequence[Found]) -> list[Found]:
    """Merges points of neighbouring frequencies; scatter beyond the noise increases their deviation."""
    groups: list[list[Found]] = []
    for each in found:
        first_hz = groups[-1][0].frequency_hz if groups else -math.inf
        if each.frequency_hz > first_hz + max(BIN_HZ, BIN_SHARE * first_hz):
            groups.append([])
        groups[-1].append(each)
    return [_mean(group) for group in groups]


def _mean(group: Sequence[Found]) -> Found:
    hertz, values, deviations, loads = (np.array([each[at] for each in group]) for at in range(4))
    weight = deviations**-2.0
    total = float(weight.sum())
    mean = complex(weight @ values) / total
    scatter = float(weight @ abs(values - mean) ** 2) / total / max(len(group) - 1, 1)
    spread = math.sqrt(max(1.0 / total, scatter))
    return Found(float(weight @ hertz) / total, mean, spread, complex(weight @ loads) / total)


def _known(points: Sequence[Found], highest_hz: float, max_gap_hz: float, limits: Limits) -> list[Found]:
    """Returns the points up to the first gap in frequency; the last point may lie above ``highest_hz``.

    Uncertain points are skipped. If the inverse of a response would exceed the limits, the response is
    increased, so that the order is corrected in part.
    """
    kept: list[Found] = []
    before_hz = 0.0
    for each in points:
        hertz = each.frequency_hz
        if before_hz > highest_hz or hertz - before_hz > max_gap_hz:
            break
        if each.uncertainty > MAX_UNCERTAINTY:
            continue
        kept.append(each._replace(response=each.response * limits.excess(1.0 / abs(each.response), hertz)))
        before_hz = hertz
    return kept


class Left(NamedTuple):
    """Remainder of an order of the load error in a run with the filtered correction."""

    frequency_hz: float
    share: complex
    """Remainder relative to the error without correction."""
    size_arcsec: float
    """Amplitude of the error without correction."""


class Answers:
    """Collects the responses of motor and load in runs with the filtered correction at constant speed.

    They are relative to the stored response. They are stored by order and nearest frequency of that response,
    so that many slow runs do not displace a few fast runs.
    """

    def __init__(
        self,
        response: Response,
        orders: Sequence[MotorOrder],
        ratio: float,
        earlier: Answers | None = None,
    ) -> None:
        """``earlier`` contains runs with a different filter and the same servo settings."""
        self.lags_ms: deque[float] = deque(maxlen=MAX_RUNS)
        """Time lag of the motor behind its set-points in each of the last runs."""
        self._response, self._orders, self._ratio = response, orders, ratio
        self._motor: dict[tuple[int, int], deque[Found]] = {}
        self._left: dict[tuple[int, int], deque[Left]] = {}
        self._earlier = {} if earlier is None else earlier._by_order()

    def take(
        self,
        speed_deg_s: float,
        target_deg: FloatArray,
        issued_deg: FloatArray,
        motor_deg: FloatArray,
        load_deg: FloatArray,
        correction_arcsec: FloatArray | None = None,
    ) -> None:
        """Adds a run: load target, motor set-points, both encoders, filtered correction; shape (n,) each.

        The load angle is NaN if the load encoder is not trusted. Without ``correction_arcsec``, the effect of
        the set-points' rounding is not subtracted from the remainder.
        """
        ratio, stored, place_of = self._ratio, self._response, self._place
        lag_s = float(np.mean(issued_deg - motor_deg)) / (ratio * speed_deg_s)
        self.lags_ms.append(1000.0 * lag_s)
        numbers = [each.order for each in self._orders]
        run = (stored, speed_deg_s, lag_s, target_deg)
        for order, found in answers(*run, issued_deg, motor_deg, numbers, ratio):
            self._motor.setdefault(place_of(order, found), deque(maxlen=MAX_RUNS)).append(found)
        if stored.load_gain and np.isfinite(load_deg).all():
            rounding_arcsec = np.zeros(len(target_deg))
            if correction_arcsec is not None:
                rounding_arcsec = ARCSEC_PER_DEG * (issued_deg / ratio - target_deg) + correction_arcsec
            for order, left in _left(*run, load_deg, rounding_arcsec, self._orders, ratio):
                self._left.setdefault(place_of(order, left), deque(maxlen=MAX_RUNS)).append(left)

    def _place(self, order: int, found: Found | Left) -> tuple[int, int]:
        known = np.array(self._response.frequency_hz)
        return order, int(np.argmin(np.abs(known - found.frequency_hz)))

    @property
    def difference(self) -> float:
        """Rms difference between the motor's response and the stored response, relative to the ripple.

        The contribution of noise is subtracted. The result is limited to the relative error that remains at
        the load encoder, so neither a change of the gear nor a fault of a single encoder counts as a
        difference.
        """
        if not self._motor:
            return 0.0
        means = [_mean(each) for each in self._motor.values()]
        hertz, values, deviations = (np.array([each[at] for each in means]) for at in range(3))
        spread = 0.5 * np.interp(hertz.real, self._response.frequency_hz, self._response.uncertainty)
        variance = deviations**2 + spread**2
        sizes = np.array([self._orders[order].amplitude_arcsec for order, _ in self._motor])
        weight = sizes**2 / (DIFFERENT**2 + variance)
        square = abs(values - 1.0) ** 2 - variance
        apart = math.sqrt(max(0.0, float(np.sum(weight * square) / weight.sum())))
        seen = self.by_frequency().values()
        whole = sum(each.size_arcsec**2 for each in seen)
        left = sum(abs(each.size_arcsec * each.share) ** 2 for each in seen)
        return min(apart, math.sqrt(left / whole)) if whole else apart

    def forget_load(self) -> None:
        """Discards the remainders that were measured by the load encoder."""
        self._left.clear()

    def left_arcsec2(self) -> dict[tuple[int, int], float]:
        """Returns the mean square of the remaining load error, by order and frequency."""
        return {
            place: sum(abs(each.share * each.size_arcsec) ** 2 for each in group) / len(group)
            for place, group in self._left.items()
        }

    def by_frequency(self) -> dict[int, _Seen]:
        """Returns the mean remainder over all orders, by frequency."""
        groups: dict[int, list[_Seen]] = {}
        for (_, place), seen in self._by_order().items():
            groups.setdefault(place, []).append(seen)
        return {place: _merged_seen(group) for place, group in groups.items()}

    def _by_order(self) -> dict[tuple[int, int], _Seen]:
        """Returns the mean remainder over the runs, by order and frequency."""
        found = {}
        for key, group in self._left.items():
            hertz, shares, sizes = (np.array(each) for each in zip(*group, strict=True))
            at_hz = np.mean(hertz, keepdims=True)
            at = gain(self._response.filter, at_hz, self._response.cycle_ms / 1000.0)[0]
            size = math.sqrt(np.mean(sizes**2))
            seen = _Seen(float(at_hz[0]), complex(np.mean(shares)), size, complex(at))
            earlier = self._earlier.get(key)
            found[key] = seen if earlier is None else seen._replace(error=_error(seen, earlier), certain=1.0)
        return found

    def refined(
        self, committed: Response, limits: Limits, bound: float, *, retuned: bool = False
    ) -> Response | None:
        """Returns the response whose filter removes the remaining load error; None without an improvement.

        The remainder E - G F c is linear in the filter's gain F, which must be multiplied by E / (E -
        remainder). This factor is interpolated between the frequencies. E with the current servo settings is
        known only after runs with a different filter. Until then, E is that of the calibration, and the step
        is shorter. Unless the servo is known to have been ``retuned``, the factor at each frequency must be
        predictable from the others, because with an unchanged servo the remainder varies irregularly with
        frequency. ``bound`` limits the relative deviation from the committed response.
        """
        seen = self.by_frequency()
        if len(seen) < 2:
            return None
        places = sorted(seen)
        hertz, shares, sizes, _, error, certain = (
            np.array(each) for each in zip(*(seen[at] for at in places), strict=True)
        )
        factors = 1.0 + certain * _bounded(error / (error - shares) - 1.0, bound)
        stored = self._response
        points_hz, lag_s = np.array(stored.frequency_hz), median(self.lags_ms) / 1000.0
        first, now = (_points(each) for each in (committed, stored))
        new = first / (1.0 + _bounded(first / now * _between(points_hz, hertz, factors) - 1.0, bound))
        others = [np.delete(np.arange(len(hertz)), at) for at in range(len(hertz))]
        predicted = [_between(at, hertz[each], factors[each]) for at, each in zip(hertz, others, strict=True)]
        for applied in (_between(hertz, points_hz, now / new), *([] if retuned else [np.array(predicted)])):
            less = abs(shares) ** 2 - abs(error - (error - shares) * applied) ** 2
            if sizes**2 @ less < REFINED**2 * np.sum(sizes**2):
                return None
        values = new * np.exp(-2j * math.pi * points_hz * lag_s)
        deviations = 0.5 * np.array(stored.uncertainty) * abs(values)
        points = [Found(*each) for each in zip(points_hz, values, deviations, strict=True)]
        cycle_s, edge_hz = stored.cycle_ms / 1000.0, stored.known_to_hz
        kept = _known(points, edge_hz, MAX_GAP / cycle_s, limits)
        lead = _filter(kept, edge_hz, lag_s, cycle_s, stored.filter.per_cycle, limits)
        lag_ms = round(1000.0 * lag_s, 3)
        return stored.model_copy(update={"following_lag_ms": lag_ms, "filter": lead, **_columns("", values)})


class _Seen(NamedTuple):
    """Mean remainder at one frequency, and the filter's gain at that frequency."""

    frequency_hz: float
    share: complex
    size_arcsec: float
    gain: complex
    error: complex = 1.0
    """Error without correction, relative to that in the calibration."""
    certain: float = FIRST_STEP
    """Fraction of the filter's change that is applied."""


def _merged_seen(group: Sequence[_Seen]) -> _Seen:
    """Returns the mean over several orders at one frequency, weighted by their mean squares."""
    columns = np.array(group)
    weight = columns[:, 2].real ** 2
    hertz, share, _, at, error, certain = weight / weight.sum() @ columns
    return _Seen(hertz.real, share, math.sqrt(np.mean(weight)), at, error, certain.real)


def _error(now: _Seen, earlier: _Seen) -> complex:
    """Returns an order's error without correction, relative to that in the calibration, at one frequency.

    The remainder is linear in the gain of the filter, and the remainders with two filters determine the line.
    The fit weighs them against the calibration, by the noise of a remainder and the change of the error due
    to different servo settings. Both remainders belong to one order, because the difference between two
    orders at the same frequency is larger than that between two filters.
    """
    rows = np.array([[1.0, now.gain], [1.0, earlier.gain], [SHARE_NOISE / ERROR_CHANGE, 0.0]])
    wanted = np.array([now.share, earlier.share, SHARE_NOISE / ERROR_CHANGE])
    return complex(np.linalg.lstsq(rows, wanted, rcond=None)[0][0])


def _bounded(change: ComplexArray, bound: float) -> ComplexArray:
    """Limits the magnitude of each complex change to ``bound``."""
    return change * np.minimum(1.0, bound / np.maximum(abs(change), 1e-9))


def lags_agree(one_ms: float, other_ms: float) -> bool:
    """Returns True unless two following lags differ by more than their noise."""
    return abs(one_ms - other_ms) <= max(DIFFERENT_LAG * max(abs(one_ms), abs(other_ms)), LAG_NOISE_MS)


def answers(
    stored: Response,
    speed_deg_s: float,
    lag_s: float,
    target_deg: FloatArray,
    issued_deg: FloatArray,
    motor_deg: FloatArray,
    orders: Sequence[int],
    ratio: float,
) -> Iterator[tuple[int, Found]]:
    """Yields the index of each order with the motor's response to its set-points, relative to the stored one.

    All angles have the shape (n,); ``issued_deg`` contains the motor's set-points. Errors of the gear and the
    model have no influence. A mere change of the following lag ``lag_s`` has no influence either, because it
    delays the transmission error and the correction alike. Orders beyond the known range and uncertain orders
    are omitted.
    """
    issued, motor = (
        harmonics_of(speed_deg_s, target_deg, ARCSEC_PER_DEG * (each / ratio - target_deg), orders, ratio)
        for each in (issued_deg, motor_deg)
    )
    hertz = order_hz(orders, speed_deg_s, ratio)
    with np.errstate(divide="ignore", invalid="ignore"):
        answer = motor.over_time / issued.over_time * np.exp(2j * math.pi * hertz * lag_s)
        relative = answer / _between(hertz, stored.frequency_hz, _points(stored))
        noise = abs(relative) * math.sqrt(2.0) * motor.deviations / abs(motor.amplitudes)
    deviation = np.hypot(noise, MIN_DEVIATION * abs(relative))
    clear = (hertz <= stored.known_to_hz) & (2.0 * deviation < MAX_UNCERTAINTY * abs(relative))
    for place in np.flatnonzero(clear).tolist():
        yield place, Found(float(hertz[place]), complex(relative[place]), float(deviation[place]))


def _left(
    stored: Response,
    speed_deg_s: float,
    lag_s: float,
    target_deg: FloatArray,
    load_deg: FloatArray,
    rounding_arcsec: FloatArray,
    orders: Sequence[MotorOrder],
    ratio: float,
) -> Iterator[tuple[int, Left]]:
    """Yields the index and the remaining load error of each order within the known frequency range.

    The load's response to the rounding of the set-points, ``rounding_arcsec`` (n,), is subtracted. If the
    motor moves by a simple fraction of a turn per cycle, the rounding repeats with the orders and does not
    average out.
    """
    numbers = [each.order for each in orders]
    error = ARCSEC_PER_DEG * (load_deg - target_deg)
    rest, rounding = (
        harmonics_of(speed_deg_s, target_deg, each, numbers, ratio).over_time
        for each in (error, rounding_arcsec)
    )
    hertz = order_hz(numbers, speed_deg_s, ratio)
    load = np.array(stored.load_gain) * np.exp(1j * np.radians(stored.load_phase_deg))
    load = _between(hertz, stored.frequency_hz, load) * np.exp(-2j * math.pi * hertz * lag_s)
    expected = load * _over_time(orders, speed_deg_s)
    rest = rest - load * _between(hertz, stored.frequency_hz, _points(stored)) * rounding
    for place in np.flatnonzero(hertz <= stored.known_to_hz).tolist():
        share = complex(rest[place] / expected[place])
        yield place, Left(float(hertz[place]), share, float(abs(expected[place])))


def _points(response: Response) -> ComplexArray:
    """Returns the complex response at its frequencies, without the following lag."""
    turned = np.radians(response.phase_deg) + 0.002 * math.pi * response.following_lag_ms * np.array(
        response.frequency_hz
    )
    points: ComplexArray = np.array(response.gain) * np.exp(1j * turned)
    return points


def change_between(before: Response, after: Response) -> FloatArray:
    """Returns the relative change of the response at each frequency, lags excluded, shape (f,)."""
    return np.asarray(abs(_points(after) / _points(before) - 1.0))


def _between(
    hertz: ArrayLike, points_hz: ArrayLike, values: ComplexArray, at_rest: float = 1.0
) -> ComplexArray:
    """Interpolates a complex function of frequency that is real at 0 Hz: its log magnitude and its phase."""
    at, known = np.asarray(hertz, dtype=float), np.append(0.0, points_hz)
    size = np.interp(at, known, np.log([at_rest, *abs(values)]))
    between: ComplexArray = np.exp(size + 1j * np.interp(at, known, np.unwrap([0.0, *np.angle(values)])))
    return between


def gain(lead: LeadFilter, frequency_hz: FloatArray, cycle_s: float) -> ComplexArray:
    """Returns the complex gain of a filter, shape of ``frequency_hz``."""
    hertz = np.asarray(frequency_hz, dtype=float)
    ahead_s = (lead.lead_cycles - np.arange(len(lead.weights)) / lead.per_cycle) * cycle_s
    total: ComplexArray = _turned(hertz, ahead_s) @ np.array(lead.weights)
    return total / _denominator(hertz, np.array(lead.feedback), cycle_s)


def _turned(hertz: FloatArray, ahead_s: NDArray[np.floating]) -> ComplexArray:
    turned: ComplexArray = np.exp(2j * math.pi * np.multiply.outer(hertz, ahead_s))
    return turned


def _denominator(hertz: FloatArray, feedback: FloatArray, cycle_s: float) -> ComplexArray:
    late: ComplexArray = _turned(hertz, -cycle_s * np.arange(1, len(feedback) + 1)) @ feedback
    return 1.0 + late


def _filter(
    kept: Sequence[Found], edge_hz: float, lag_s: float, cycle_s: float, per_cycle: int, limits: Limits
) -> LeadFilter:
    """Fits a filter to the inverse response up to ``edge_hz`` and to zero gain beyond, by least squares.

    The errors are relative. Between the points the inverse response is interpolated after removal of its
    poles, because the rest has no peak narrower than the spacing of the points.
    """
    lag_cycles = math.ceil(max(0.0, lag_s) / cycle_s) + LAG_CYCLES
    count = (LEAD_CYCLES + lag_cycles) * per_cycle + 1
    ahead_s = (LEAD_CYCLES - np.arange(count) / per_cycle) * cycle_s
    points_hz = np.array([each.frequency_hz for each in kept])
    inverse = _turned(points_hz, np.array(-lag_s)) / np.array([each.response for each in kept])
    trust = np.array([each.uncertainty / 2.0 for each in kept])
    hertz, beyond = np.linspace(0.0, edge_hz, 160), np.linspace(edge_hz, 0.5 * per_cycle / cycle_s, 200)[1:]
    weight = 1.0 / (1.0 + 3.0 * np.interp(hertz, points_hz, trust))
    # Beyond the edge the response is unknown, so the filter falls steeply to zero and stays there.
    fade = np.clip((beyond - edge_hz) / (FADE / cycle_s), 0.0, 1.0)
    inside, outside = _turned(hertz, ahead_s), _turned(beyond, ahead_s)
    late = _turned(hertz, -cycle_s * np.arange(1, POLES + 1))
    feedback = np.zeros(POLES)
    for refined in range(REFINEMENTS + 1):
        # The poles are fitted to a direct interpolation, and removed before the final interpolation.
        smooth = feedback if refined == REFINEMENTS else np.zeros(POLES)
        flat, rest = inverse * _denominator(points_hz, smooth, cycle_s), 1.0 + float(smooth.sum())
        wanted = _between(hertz, points_hz, flat, rest) / _denominator(hertz, smooth, cycle_s)
        below = _denominator(hertz, feedback, cycle_s)
        dread = (0.05 + 0.95 * fade**2) * np.maximum(1.0 / abs(wanted[-1]), np.minimum(fade, UNKNOWN))
        within = (weight / wanted / below)[:, None] * inside
        without = (dread / _denominator(beyond, feedback, cycle_s))[:, None] * outside
        if refined == REFINEMENTS:
            break
        goal = weight / below
        within = np.hstack([within, -goal[:, None] * late])
        without = np.hstack([without, np.zeros((len(beyond), POLES))])
        feedback = _stable(_least_squares(within, without, goal)[count:], points_hz, cycle_s)
    constant = SUM_WEIGHT / rest * np.ones((1, count))
    weights = _least_squares(np.vstack([within, constant]), without, np.append(weight, SUM_WEIGHT))
    weights *= rest / weights.sum()
    return LeadFilter(
        lead_cycles=LEAD_CYCLES,
        per_cycle=per_cycle,
        full_speed_deg_s=limits.full_speed_deg_s(hertz, np.abs(wanted)),
        weights=tuple(rounded(each, 9) for each in weights),
        feedback=tuple(rounded(each, 9) for each in feedback),
    )


def _least_squares(within: ComplexArray, without: ComplexArray, goal: ComplexArray) -> FloatArray:
    """Returns real coefficients c with ``within @ c`` near ``goal`` and ``without @ c`` near zero.

    Both matrices have one row per frequency.
    """
    count = within.shape[1]
    rows = np.vstack([within.real, within.imag, without.real, without.imag, REGULARISATION * np.eye(count)])
    wanted = np.concatenate([goal.real, goal.imag, np.zeros(2 * len(without) + count)])
    solution: FloatArray = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return solution


def _stable(feedback: FloatArray, points_hz: FloatArray, cycle_s: float) -> FloatArray:
    """Returns the feedback with its poles made stable, and no peak narrower than the local spacing of points.

    A pole outside the unit circle is reflected into it. Poles beyond the last point are removed.
    """
    poles = np.roots(np.array([1.0, *feedback]))
    hertz = np.abs(np.angle(poles)) / (2.0 * math.pi * cycle_s)
    gap_hz = np.diff([0.0, *points_hz, math.inf])[np.searchsorted(points_hz, hertz)]
    size = np.maximum(np.abs(poles), 1e-9)
    inside = np.minimum(np.minimum(size, 1.0 / size), np.exp(-math.pi * cycle_s * gap_hz))
    stable: FloatArray = np.real(np.poly(poles / size * inside))[1:]
    return stable
