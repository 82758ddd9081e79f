"""Foreign axes drawn by a seed, and their sealed truth.

A draw is rejected only if its servo is unstable by its own criterion, see `commissioned`. The truth has the
number of rejected draws.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from foreign.machine import Encoders, ForeignMachine
from foreign.mechanics import ARCSEC, BoucWen, MaxwellSlip, Mechanics, Order
from foreign.servos import STRUCTURES, Law, Observed, PiNotch, Piv, Servo, StateFeedback

PERIOD_MS = {"pi_notch": 0.25, "piv": 0.1, "observed": 0.5, "state_feedback": 0.2}
INTERPOLATION = {
    "pi_notch": ("linear", "linear", "cubic"),
    "piv": ("linear", "cubic"),
    "observed": ("hold", "linear"),
    "state_feedback": ("hold", "linear", "cubic"),
}
MOVES_DEG = (43.56, 87.12, 82.12, 43.56, 0.0)
"""Motor angles to which the axis moves in turn. It has to settle at each."""
WAIT_S, WATCH_S = 0.15, 0.2
JERKS_DEG_S3 = tuple(12_000.0 / 2**step for step in range(6))
"""Jerk limits tried in turn, at the load. The acceleration is at most a quarter of the jerk, per s2."""
REST_DEG = 0.03
"""Maximum error of the settled motor; one count if a count is larger."""


@dataclass(frozen=True)
class Truth:
    """Sealed truth of a foreign axis, for the evaluation only."""

    seed: int
    structure: str
    rejected: int
    """Draws with an unstable servo before this one."""
    mechanics: Mechanics
    servo: Servo
    encoders: Encoders
    cycle_ms: float
    velocity_deg_s: float
    """Speed limit of the axis file, at the load."""
    acceleration_deg_s2: float
    jerk_deg_s3: float
    following_error_deg: float
    """Window of the axis file, at the motor."""

    def machine(self) -> ForeignMachine:
        """The axis at rest at zero, with the noise of its seed."""
        return ForeignMachine(self.mechanics, self.servo, self.encoders, self.seed)

    def by_place(self) -> dict[str, float]:
        """Returns true values by their path in a truth file, if a key there has the same meaning."""
        m, law, hysteresis = self.mechanics, self.servo.law, self.mechanics.hysteresis
        values = {
            "motor.inertia_kg_m2": m.motor_inertia_kg_m2,
            "motor.coulomb_nm": m.coulomb_nm,
            "motor.viscous_nm_s_per_rad": m.viscous_nm_s_per_rad,
            "motor.stribeck.rise": m.stribeck_rise,
            "motor.stribeck.speed_rad_s": m.stribeck_speed_rad_s,
            "gear.stiffness_nm_per_rad": m.stiffness_nm_per_rad,
            "gear.damping_nm_s_per_rad": m.damping_nm_s_per_rad,
            "load.inertia_kg_m2": m.load_inertia_kg_m2,
            "gear.hysteresis_reaction": 1.0,
            "load.viscous_nm_s_per_rad": m.load_viscous_nm_s_per_rad,
            "load.encoder.noise_arcsec": self.encoders.load_noise_arcsec,
            "servo.dead_time_ms": self.servo.dead_time_ms,
            "servo.torque_limit_percent": self.servo.torque_limit_percent,
            "servo.velocity_feedforward": getattr(law, "velocity_feedforward", 0.0),
            "servo.inertia_feedforward_kg_m2": getattr(law, "inertia_feedforward_kg_m2", 0.0),
        }
        for name in ("position_gain_per_s", "velocity_gain_nm_s_per_rad", "integral_time_ms"):
            if hasattr(law, name):
                values[f"servo.{name}"] = getattr(law, name)
        for at, order in enumerate(m.motor_orders):
            values[f"gear.motor_orders[{at}].amplitude_arcsec"] = order.amplitude_arcsec
            values[f"gear.motor_orders[{at}].phase_deg"] = order.phase_deg
        if isinstance(hysteresis, BoucWen):
            values |= {f"gear.hysteresis.{name}": value for name, value in vars(hysteresis).items()}
        else:
            for at, (limit, travel) in enumerate(hysteresis.elements):
                values[f"gear.hysteresis.elements[{at}].limit_arcsec"] = limit
                values[f"gear.hysteresis.elements[{at}].yield_deg"] = travel
        return values


class _Lot:
    """Random draws of a seed: uniform, log-uniform, one of several."""

    def __init__(self, *seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def even(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return math.exp(self.even(math.log(low), math.log(high)))

    def one(self, *of):
        return of[self._rng.integers(len(of))]


@cache
def draw(seed: int, structure: str, cycle_ms: float | None = None) -> Truth:
    """Foreign axis of a seed. The same seed, structure and cycle give the same axis."""
    for rejected, truth in enumerate(candidates(seed, structure, cycle_ms)):
        if (axis := commissioned(truth)) is not None:
            return replace(axis, rejected=rejected)
    raise AssertionError("unreachable")


def candidates(seed: int, structure: str, cycle_ms: float | None = None) -> Iterator[Truth]:
    """Candidate axes of a seed without end, stable or not."""
    lot = _Lot(seed, list(STRUCTURES).index(structure))
    while True:
        size, cycle = lot.log(0.7, 4.0), lot.one(4.0, 4.0, 2.0)
        mechanics, encoders = _mechanics(lot, size), _encoders(lot)
        law = _LAWS[structure](lot, mechanics)
        servo = Servo(
            law=law,
            period_ms=PERIOD_MS[structure],
            interpolation=lot.one(*INTERPOLATION[structure]),
            dead_time_ms=round(lot.even(0.0, 3.0) / PERIOD_MS[structure]) * PERIOD_MS[structure],
            current_lag_ms=lot.even(0.1, 0.5),
            rated_torque_nm=round(0.32 * size, 3),
            torque_limit_percent=lot.one(200.0, 300.0),
            speed_limit_rad_s=628.0,
            rest_window_deg=max(1.5 / encoders.motor_interpolation, 3.0 * encoders.motor_flicker_counts)
            * (360.0 / encoders.motor_counts_per_turn),
        )
        cycle = cycle if cycle_ms is None else cycle_ms
        limits = _speed_deg_s(mechanics, servo), _acceleration_deg_s2(mechanics, servo)
        yield Truth(seed, structure, 0, mechanics, servo, encoders, cycle, *limits, JERKS_DEG_S3[0], 360.0)


def commissioned(truth: Truth) -> Truth | None:
    """The axis with the highest jerk limit at which it settles, and with a following error window.

    None if it does not settle at any jerk limit: the criterion of instability. Without friction the servo has
    to be stable; with friction it must neither hunt nor stick next to the target.
    """
    fine = replace(
        truth.encoders, motor_counts_per_turn=1 << 20, motor_interpolation=16, motor_flicker_counts=0.0
    )
    slippery = replace(truth.mechanics, coulomb_nm=0.0)
    if not _settles(truth, slippery, fine, 0.5):
        return None
    for jerk in JERKS_DEG_S3:
        slower = replace(
            truth, acceleration_deg_s2=min(truth.acceleration_deg_s2, 0.25 * jerk), jerk_deg_s3=jerk
        )
        if _settles(slower, truth.mechanics, truth.encoders, WAIT_S):
            return _within_following_error(slower)
    return None


def _settles(truth: Truth, mechanics: Mechanics, encoders: Encoders, wait_s: float) -> bool:
    """True if the motor is at rest at each target of `MOVES_DEG` from ``wait_s`` after the move."""
    machine = ForeignMachine(mechanics, truth.servo, encoders, truth.seed)
    count_deg = 360.0 / encoders.motor_counts_per_turn
    cycle_s, before, from_deg = truth.cycle_ms / 1000.0, 0, 0.0
    for to_deg in MOVES_DEG:
        far_deg = abs(to_deg - from_deg) / mechanics.ratio
        move_s = max(
            (math.tau**2 * far_deg / truth.jerk_deg_s3) ** (1.0 / 3.0),
            math.sqrt(math.tau * far_deg / truth.acceleration_deg_s2),
        )
        for at in range(1, round((move_s + wait_s + WATCH_S) / cycle_s)):
            share = min(1.0, at * cycle_s / move_s)
            way = share - math.sin(math.tau * share) / math.tau
            target = round((from_deg + (to_deg - from_deg) * way) / count_deg)
            machine.follow(before, target, round(cycle_s / machine.dt_s))
            before = target
            off_deg = abs(machine.true_motor_deg - target * count_deg)
            if not off_deg < (max(REST_DEG, count_deg) if at * cycle_s > move_s + wait_s else 90.0):
                return False
        from_deg = to_deg
    return True


def _mechanics(lot: _Lot, size: float) -> Mechanics:
    motor, ratio, held = 3e-5 * size, lot.one(50.0, 80.0, 100.0, 120.0), math.tau * lot.log(15.0, 80.0)
    load = 3.0 * lot.log(0.3, 3.0) * motor * ratio**2
    stiffness = load * held**2
    friction = lot.even(0.05, 0.12) * 0.32 * size
    orders = {1: (2.0, 8.0), 2: (5.0, 18.0), 3: (0.5, 3.0), 4: (2.0, 13.0), 6: (1.0, 4.5), 8: (0.5, 2.5)}
    offset = lot.even(10.0, 40.0) * lot.one(1.0, 1.0, 1.0, -1.0)
    if lot.one(True, False):
        hysteresis = BoucWen(offset, lot.even(3.0, 12.0), lot.even(1.0, 2.0), lot.even(0.5, 0.8))
    else:
        shares = [lot.even(0.5, 1.5) for _ in range(5)]
        hysteresis = MaxwellSlip(tuple((offset * each / sum(shares), lot.log(1.0, 25.0)) for each in shares))
    wind_up = lot.one(0.0, lot.even(1.0, 10.0)) * ARCSEC  # at 100 deg/s
    return Mechanics(
        motor_inertia_kg_m2=motor,
        coulomb_nm=friction,
        viscous_nm_s_per_rad=lot.even(0.03, 0.12) * 0.32 * size / (math.tau * 50.0),
        stribeck_rise=lot.one(0.0, lot.even(0.05, 0.4)),
        stribeck_speed_rad_s=lot.even(2.0, 15.0),
        ratio=ratio,
        stiffness_nm_per_rad=stiffness,
        damping_nm_s_per_rad=2.0 * lot.even(0.03, 0.2) * load * held,
        load_inertia_kg_m2=load,
        load_viscous_nm_s_per_rad=wind_up * stiffness / math.radians(100.0),
        motor_orders=tuple(
            Order(order, lot.even(*span), lot.even(-180.0, 180.0)) for order, span in orders.items()
        ),
        hysteresis=hysteresis,
        brake_nm=3.0 * size,
    )


def _encoders(lot: _Lot) -> Encoders:
    counts, interpolation, flicker = lot.one(
        (8000, 64, 0.03), (1 << 14, 16, 0.05), (1 << 17, 1, 0.5), (1 << 20, 1, 0.5)
    )
    return Encoders(
        motor_counts_per_turn=counts,
        motor_interpolation=interpolation,
        motor_flicker_counts=lot.even(0.0, flicker),
        load_counts_per_turn=lot.one(1 << 20, 2_880_000, 1 << 22, 1 << 23),
        load_noise_arcsec=lot.even(0.0, 0.5),
        torque_noise_permille=lot.even(0.5, 4.0),
    )


def _pi_notch(lot: _Lot, mechanics: Mechanics) -> Law:
    rate = math.tau * lot.even(12.0, 30.0)
    return PiNotch(
        position_gain_per_s=rate / lot.even(3.0, 5.0),
        velocity_gain_nm_s_per_rad=rate * mechanics.inertia_kg_m2,
        integral_time_ms=1000.0 * lot.even(2.0, 4.0) / rate,
        velocity_feedforward=0.9,
        moving_average_ms=round(lot.even(0.0, 5.0) / 0.25) * 0.25,
        speed_filter_ms=lot.even(0.3, 1.5),
        notch_hz=min(600.0, mechanics.free_hz * lot.even(0.9, 1.1)),
        notch_depth=lot.even(0.05, 0.4),
        notch_width=lot.even(0.3, 1.0),
        torque_filter_ms=lot.even(0.2, 1.0),
    )


def _velocity_gain(lot: _Lot, mechanics: Mechanics, rate: float) -> float:
    """Torque per speed for a velocity loop of ``rate``, as far as motor inertia and lags allow."""
    return min(rate * mechanics.inertia_kg_m2, lot.even(500.0, 1000.0) * mechanics.motor_inertia_kg_m2)


def _piv(lot: _Lot, mechanics: Mechanics) -> Law:
    gain, forward = lot.log(50.0, 300.0), lot.one(0.0, 0.9, 1.0)
    return Piv(
        position_gain_per_s=gain,
        velocity_gain_nm_s_per_rad=_velocity_gain(lot, mechanics, gain * lot.even(2.5, 5.0)),
        integral_gain_per_s2=gain**2 * lot.even(0.2, 0.5),
        velocity_feedforward=forward,
        inertia_feedforward_kg_m2=lot.even(0.7, 1.05) * mechanics.inertia_kg_m2 if forward else 0.0,
        speed_filter_ms=lot.even(0.1, 0.4),
    )


def _observed(lot: _Lot, mechanics: Mechanics) -> Law:
    gain = lot.log(50.0, 150.0)
    rate = gain * lot.even(2.5, 5.0)
    return Observed(
        position_gain_per_s=gain,
        velocity_gain_nm_s_per_rad=_velocity_gain(lot, mechanics, rate),
        integral_time_ms=1000.0 * lot.even(3.0, 8.0) / rate,
        first_filter_ms=lot.even(0.3, 5.0),
        second_filter_ms=lot.even(0.3, 5.0),
        speed_filter_ms=lot.even(0.3, 1.0),
        observer_hz=lot.even(3.0, 15.0),
        observer_gain=lot.even(0.3, 0.8),
        nominal_inertia_kg_m2=lot.even(0.4, 1.0) * mechanics.inertia_kg_m2,
        tracking_time_ms=lot.even(5.0, 30.0),
    )


def _state_feedback(lot: _Lot, mechanics: Mechanics) -> Law:
    feedback = lot.log(10.0, 30.0)
    return StateFeedback(
        reference_hz=lot.even(10.0, 60.0),
        reference_damping=lot.even(0.8, 1.1),
        acceleration_feedforward=lot.even(0.7, 1.0),
        feedback_hz=feedback,
        feedback_damping=lot.even(0.8, 1.2),
        observer_hz=feedback * lot.even(3.0, 7.0),
        nominal_inertia_kg_m2=lot.even(0.4, 1.0) * mechanics.inertia_kg_m2,
    )


_LAWS = {"pi_notch": _pi_notch, "piv": _piv, "observed": _observed, "state_feedback": _state_feedback}


def _speed_deg_s(mechanics: Mechanics, servo: Servo) -> float:
    """Highest speed of the load."""
    return float(math.floor(min(130.0, 0.7 * math.degrees(servo.speed_limit_rad_s) / mechanics.ratio)))


def _acceleration_deg_s2(mechanics: Mechanics, servo: Servo) -> float:
    """Highest acceleration of the load: half of the torque limit goes into it."""
    spare_nm = 0.5 * servo.torque_limit_percent / 100.0 * servo.rated_torque_nm
    return float(min(600.0, math.floor(math.degrees(spare_nm / mechanics.inertia_kg_m2 / mechanics.ratio))))


def _within_following_error(truth: Truth) -> Truth:
    """Returns the axis with a following error window for its fastest move, which may reduce its speed."""
    while (worst_deg := _following_error_deg(truth)) > 260.0:
        truth = replace(truth, velocity_deg_s=float(math.floor(0.8 * truth.velocity_deg_s)))
    return replace(truth, following_error_deg=float(math.ceil(1.3 * worst_deg + 10.0)))


def _following_error_deg(truth: Truth) -> float:
    """Largest following error, motor degrees, of a trapezoidal move at full speed and acceleration."""
    machine, counts = truth.machine(), truth.encoders.motor_counts_per_turn
    scale, cycle_s = truth.mechanics.ratio / 360.0 * counts, truth.cycle_ms / 1000.0
    ramp_s, start, worst = truth.velocity_deg_s / truth.acceleration_deg_s2, 0, 0.0
    for at in range(1, round((2.0 * ramp_s + 1.0) / cycle_s)):
        up_s = min(at * cycle_s, ramp_s)
        down_s = max(0.0, min(at * cycle_s - 0.5 - ramp_s, ramp_s))
        even_s = max(0.0, min(at * cycle_s - ramp_s, 0.5))
        way = 0.5 * up_s**2 + ramp_s * (even_s + down_s) - 0.5 * down_s**2
        target = round(truth.acceleration_deg_s2 * way * scale)
        machine.follow(start, target, round(cycle_s / machine.dt_s))
        start, worst = target, max(worst, abs(target - machine.motor_counts) / counts * 360.0)
    return worst
