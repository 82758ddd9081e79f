"""Four servo structures between a position demand and the motor's torque.

| structure | loops | command | feed-forward |
|---|---|---|---|
| `PiNotch` | position P, velocity PI on filtered speed, notch, torque low-pass | moving average | velocity |
| `Piv` | torque = Kv (Kp e + Ki integral of e - speed) | as it is | velocity, acceleration |
| `Observed` | position P, velocity PI, disturbance observer, anti-windup | two lags | none |
| `StateFeedback` | position and speed of an extended state observer | reference model | acceleration |

A servo samples the demand and the motor encoder once per period and holds its torque until the next sample.
Parameters that docs/ci.md has keep its names and units. Gains refer to motor radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from foreign.mechanics import DT_S
from numba import njit


@dataclass(frozen=True)
class PiNotch:
    """Velocity loop of an industrial drive, soft, with a notch on the torque."""

    position_gain_per_s: float
    velocity_gain_nm_s_per_rad: float
    integral_time_ms: float
    velocity_feedforward: float
    moving_average_ms: float
    speed_filter_ms: float
    notch_hz: float
    notch_depth: float
    """Gain at the notch frequency."""
    notch_width: float
    """Bandwidth over frequency."""
    torque_filter_ms: float


@dataclass(frozen=True)
class Piv:
    """Stiff loops on the raw command."""

    position_gain_per_s: float
    velocity_gain_nm_s_per_rad: float
    integral_gain_per_s2: float
    velocity_feedforward: float
    inertia_feedforward_kg_m2: float
    speed_filter_ms: float


@dataclass(frozen=True)
class Observed:
    """Cascade whose disturbance observer supplies friction and load torque."""

    position_gain_per_s: float
    velocity_gain_nm_s_per_rad: float
    integral_time_ms: float
    first_filter_ms: float
    second_filter_ms: float
    speed_filter_ms: float
    observer_hz: float
    observer_gain: float
    """Supplied fraction of the estimated disturbance. Below 1 the observer does not integrate at rest."""
    nominal_inertia_kg_m2: float
    tracking_time_ms: float
    """Time constant of the back-calculation at the torque limit."""
    velocity_feedforward: float = 0.0


@dataclass(frozen=True)
class StateFeedback:
    """torque = ff J a_ref + J (w^2 (x_ref - x) + 2 d w (v_ref - v)) - disturbance, states by the observer."""

    reference_hz: float
    reference_damping: float
    acceleration_feedforward: float
    """Share of the nominal inertia."""
    feedback_hz: float
    feedback_damping: float
    observer_hz: float
    nominal_inertia_kg_m2: float


Law = PiNotch | Piv | Observed | StateFeedback
STRUCTURES = {"pi_notch": PiNotch, "piv": Piv, "observed": Observed, "state_feedback": StateFeedback}
INTERPOLATIONS = ("hold", "linear", "cubic")
AT_REST = 1e-6
"""Speed of a resting demand, rad/s: the rounding error of a cubic."""


@dataclass(frozen=True)
class Servo:
    """A servo: its structure, and the parameters that all structures have."""

    law: Law
    period_ms: float
    """Sampling period; a multiple of the plant's substep."""
    interpolation: str
    """Between set-points: the new one at once (hold), a straight line (linear), or a Catmull-Rom spline
    through the last four, one cycle late (cubic)."""
    dead_time_ms: float
    """Age of the demand; a multiple of the period."""
    current_lag_ms: float
    """Time constant of the current loop."""
    rated_torque_nm: float
    torque_limit_percent: float
    speed_limit_rad_s: float
    rest_window_deg: float
    """Motor error within which integrals and observers pause at rest, so that nothing hunts."""

    @property
    def period_s(self) -> float:
        return self.period_ms / 1000.0


# fmt: off
_PARAMETERS = [
    "period_s", "gain", "speed_gain", "integral_rate", "velocity_ff", "inertia_ff", "speed_share",
    "first_share", "second_share", "b0", "b1", "b2", "a1", "a2", "torque_share", "observer_share",
    "observer_gain", "observer_rad_s", "inertia", "tracking_rate", "reference_rad_s", "reference_damping",
    "l1", "l2", "l3", "k1", "k2", "current_share", "current_mean", "speed_limit", "torque_limit",
    "rest_window",
]
_STATE = [
    "before", "speed", "active", "integral", "first", "second", "command", "n1", "n2", "filtered", "q",
    "estimate", "estimated_speed", "estimated_disturbance", "reference", "reference_speed", "torque_nm",
    "actual_nm", "velocity_offset", "torque_offset",
]
# fmt: on
PARAMETERS = np.dtype(
    [(name, "f8") for name in _PARAMETERS]
    + [(name, "i8") for name in ("structure", "interpolation", "substeps")]
)
LOOPS = np.dtype([(name, "f8") for name in _STATE] + [(name, "i8") for name in ("delay_at", "average_at")])


class Loops(NamedTuple):
    """Parameters and state of a servo, in the form that `torque` requires."""

    parameters: np.ndarray
    """Record `PARAMETERS`."""
    state: np.ndarray
    """Record `LOOPS`."""
    delay: np.ndarray
    """Ring of demands (position, speed, acceleration) for the dead time."""
    average: np.ndarray
    """Ring of the moving average."""
    knots: np.ndarray
    """The last four set-points, oldest first, and the mean speed of the last cycle."""


def loops_of(servo: Servo) -> Loops:
    """Parameters and state of a servo. Call `settle` before use."""
    record, law = np.zeros(1, PARAMETERS), servo.law
    p, period = record[0], servo.period_s

    def share(time_ms: float) -> float:
        """Gain per sample of a first-order lag."""
        return -math.expm1(-1000.0 * period / time_ms) if time_ms > 0.0 else 1.0

    p["structure"] = list(STRUCTURES.values()).index(type(law))
    p["interpolation"] = INTERPOLATIONS.index(servo.interpolation)
    p["substeps"], p["period_s"] = round(period / DT_S), period
    p["torque_limit"] = servo.torque_limit_percent / 100.0 * servo.rated_torque_nm
    p["speed_limit"], p["rest_window"] = servo.speed_limit_rad_s, math.radians(servo.rest_window_deg)
    p["current_share"] = 1.0
    if servo.current_lag_ms > 0.0:
        ratio = 1000.0 * DT_S / servo.current_lag_ms
        p["current_share"] = -math.expm1(-ratio)
        p["current_mean"] = -math.expm1(-ratio) / ratio  # mean of the lag's remaining error over a substep
    average = 1
    if isinstance(law, StateFeedback):
        inertia, feedback = law.nominal_inertia_kg_m2, math.tau * law.feedback_hz
        observer = math.tau * law.observer_hz
        p["reference_rad_s"], p["reference_damping"] = math.tau * law.reference_hz, law.reference_damping
        p["inertia"], p["inertia_ff"] = inertia, law.acceleration_feedforward * inertia
        p["k1"], p["k2"] = inertia * feedback**2, 2.0 * law.feedback_damping * feedback * inertia
        p["l1"], p["l2"], p["l3"] = 3.0 * observer, 3.0 * observer**2, observer**3
    else:
        p["gain"], p["speed_gain"] = law.position_gain_per_s, law.velocity_gain_nm_s_per_rad
        p["speed_share"] = share(law.speed_filter_ms)
    if isinstance(law, PiNotch):
        p["integral_rate"], p["velocity_ff"] = 1000.0 / law.integral_time_ms, law.velocity_feedforward
        p["torque_share"] = share(law.torque_filter_ms)
        average = max(1, round(law.moving_average_ms / servo.period_ms))
        half = math.tan(math.pi * law.notch_hz * period)  # bilinear, exact at the notch frequency
        scale = 1.0 + law.notch_width * half + half * half
        p["b0"] = (1.0 + law.notch_depth * law.notch_width * half + half * half) / scale
        p["b1"] = p["a1"] = 2.0 * (half * half - 1.0) / scale
        p["b2"] = (1.0 - law.notch_depth * law.notch_width * half + half * half) / scale
        p["a2"] = (1.0 - law.notch_width * half + half * half) / scale
    elif isinstance(law, Piv):
        p["integral_rate"], p["velocity_ff"] = law.integral_gain_per_s2, law.velocity_feedforward
        p["inertia_ff"] = law.inertia_feedforward_kg_m2
    elif isinstance(law, Observed):
        p["integral_rate"], p["inertia"] = 1000.0 / law.integral_time_ms, law.nominal_inertia_kg_m2
        p["first_share"], p["second_share"] = share(law.first_filter_ms), share(law.second_filter_ms)
        p["observer_gain"] = law.observer_gain
        p["observer_rad_s"] = math.tau * law.observer_hz
        p["observer_share"] = -math.expm1(-math.tau * law.observer_hz * period)
        p["tracking_rate"] = 1000.0 / law.tracking_time_ms
        p["velocity_ff"] = law.velocity_feedforward
    delay = np.zeros((max(1, round(servo.dead_time_ms / servo.period_ms)), 3))
    delay = delay if servo.dead_time_ms > 0.0 else np.zeros((0, 3))
    return Loops(record, np.zeros(1, LOOPS), delay, np.zeros(average), np.zeros(5))


def settle(loops: Loops, position: float) -> None:
    """Puts the loops to rest at a position in radians, without torque, as at power-on."""
    loops.state[:] = 0
    for name in ("before", "first", "second", "command", "estimate", "reference"):
        loops.state[0][name] = position
    loops.delay[:] = position, 0.0, 0.0
    loops.average[:] = position
    loops.knots[:] = position
    loops.knots[4] = 0.0


@njit(cache=True)
def demand(kind, knots, share, cycle_s):
    """Position, speed and acceleration demanded at ``share`` of the cycle between the last two knots."""
    a, b, c, d = knots[0], knots[1], knots[2], knots[3]
    speed = (d - c) / cycle_s
    acceleration = (speed - knots[4]) / cycle_s
    if kind == 0:
        return d, speed, acceleration
    if kind == 1:
        return c + (d - c) * share, speed, acceleration
    p1, p2, p3 = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
    return (
        b + share * (p1 + share * (p2 + share * p3)),
        (p1 + share * (2.0 * p2 + 3.0 * share * p3)) / cycle_s,
        (2.0 * p2 + 6.0 * share * p3) / (cycle_s * cycle_s),
    )


@njit(cache=True)
def torque(loops, position, target, target_speed, target_acceleration, limit_nm):
    """Takes one sample of motor position and demand (radians). Returns the torque until the next one."""
    p, s = loops.parameters[0], loops.state[0]
    if loops.delay.shape[0] > 0:
        row = loops.delay[s.delay_at]
        late, late_speed, late_acceleration = row[0], row[1], row[2]
        row[0], row[1], row[2] = target, target_speed, target_acceleration
        target, target_speed, target_acceleration = late, late_speed, late_acceleration
        s.delay_at = (s.delay_at + 1) % loops.delay.shape[0]
    s.speed += p.speed_share * ((position - s.before) / p.period_s - s.speed)
    s.before = position
    s.active = 0.0 if abs(target_speed) < AT_REST and abs(target - position) <= p.rest_window else 1.0
    if p.structure == 0:
        wanted = _pi_notch(loops, position, target, limit_nm)
    elif p.structure == 1:
        wanted = _piv(p, s, position, target, target_speed, target_acceleration, limit_nm)
    elif p.structure == 2:
        wanted = _observed(p, s, position, target, limit_nm)
    else:
        wanted = _state_feedback(p, s, position, target, limit_nm)
    s.torque_nm = min(limit_nm, max(-limit_nm, wanted))
    return s.torque_nm


@njit(cache=True)
def _pi_notch(loops, position, target, limit_nm):
    p, s, ring = loops.parameters[0], loops.state[0], loops.average
    ring[s.average_at] = target
    s.average_at = (s.average_at + 1) % ring.shape[0]
    command = ring.mean()
    forward = p.velocity_ff * (command - s.command) / p.period_s
    s.command = command
    wanted_speed = p.gain * (command - position) + forward + s.velocity_offset
    error = min(p.speed_limit, max(-p.speed_limit, wanted_speed)) - s.speed
    raw = p.speed_gain * (error + s.integral)
    if abs(s.filtered) < limit_nm or error * s.filtered < 0.0:
        s.integral += s.active * p.period_s * p.integral_rate * error
    notched = p.b0 * raw + s.n1  # transposed direct form
    s.n1 = p.b1 * raw - p.a1 * notched + s.n2
    s.n2 = p.b2 * raw - p.a2 * notched
    s.filtered += p.torque_share * (notched - s.filtered)
    return s.filtered + s.torque_offset


@njit(cache=True)
def _piv(p, s, position, target, target_speed, target_acceleration, limit_nm):
    error = target - position
    wanted_speed = p.gain * error + s.integral + p.velocity_ff * target_speed + s.velocity_offset
    wanted_speed = min(p.speed_limit, max(-p.speed_limit, wanted_speed))
    wanted = p.speed_gain * (wanted_speed - s.speed) + p.inertia_ff * target_acceleration + s.torque_offset
    if abs(wanted) < limit_nm or error * wanted < 0.0:
        s.integral += s.active * p.period_s * p.integral_rate * error
    return wanted


@njit(cache=True)
def _observed(p, s, position, target, limit_nm):
    s.first += p.first_share * (target - s.first)
    before = s.second
    s.second += p.second_share * (s.first - s.second)
    forward = p.velocity_ff * (s.second - before) / p.period_s
    wanted_speed = p.gain * (s.second - position) + forward + s.velocity_offset
    error = min(p.speed_limit, max(-p.speed_limit, wanted_speed)) - s.speed
    momentum = p.observer_rad_s * p.inertia * s.speed
    wanted = p.speed_gain * (error + s.integral) + p.observer_gain * (s.q - momentum) + s.torque_offset
    given = min(limit_nm, max(-limit_nm, wanted))
    give_way = p.tracking_rate * (given - wanted) / p.speed_gain
    s.integral += s.active * p.period_s * (p.integral_rate * error + give_way)
    s.q += s.active * p.observer_share * (given + momentum - s.q)
    return given


@njit(cache=True)
def _state_feedback(p, s, position, target, limit_nm):
    rate, period = p.reference_rad_s, p.period_s
    acceleration = rate * (rate * (target - s.reference) - 2.0 * p.reference_damping * s.reference_speed)
    before = s.reference_speed
    s.reference_speed = min(p.speed_limit, max(-p.speed_limit, before + period * acceleration))
    s.reference += period * s.reference_speed
    wanted = p.inertia_ff * (s.reference_speed - before) / period - s.estimated_disturbance + s.torque_offset
    wanted += p.k1 * (s.reference - s.estimate)
    wanted += p.k2 * (s.reference_speed + s.velocity_offset - s.estimated_speed)
    given = min(limit_nm, max(-limit_nm, wanted))
    miss, estimated_speed = position - s.estimate, s.estimated_speed
    s.estimate += period * (estimated_speed + p.l1 * miss)
    s.estimated_speed += period * ((given + s.estimated_disturbance) / p.inertia + p.l2 * miss)
    s.estimated_disturbance += s.active * period * p.l3 * p.inertia * miss
    return given
