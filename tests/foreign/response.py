"""Linear response of a foreign axis from its set-points to its motor angle, in closed form.

Independent of the compiled servo: each structure is written down once more in z, the mechanics in s, and the
sampled mechanics are summed over aliases. Coulomb friction, quantisation and limits are left out.
"""

from __future__ import annotations

import math

import numpy as np
from foreign.mechanics import Mechanics
from foreign.servos import Observed, PiNotch, Piv, Servo, StateFeedback

ALIASES = np.arange(-200, 201)[:, None]


def motor_response(
    mechanics: Mechanics, servo: Servo, frequency_hz: np.ndarray, cycle_s: float
) -> np.ndarray:
    """Motor angle per set-point, complex, shape of ``frequency_hz``. A set-point is due at its cycle's end.

    The motor's spectrum over that of the set-points, at any frequency: above half the cycle rate it is the
    response to the images of the set-points.
    """
    omega = math.tau * np.asarray(frequency_hz, dtype=float)
    forward, feedback = _servo(servo, omega, cycle_s)
    return (
        _held_motor(mechanics, servo, omega)
        * forward
        / (1.0 + feedback * _sampled_motor(mechanics, servo, omega))
    )


def tooth_response(
    mechanics: Mechanics, servo: Servo, frequency_hz: np.ndarray, cycle_s: float
) -> np.ndarray:
    """Load angle per tooth error at even speed, complex, shape of ``frequency_hz``: the load's ripple.

    The tooth error shakes load and motor, and the servo holds the motor.
    """
    omega = math.tau * np.asarray(frequency_hz, dtype=float)
    load, spring = _load_and_spring(mechanics, 1j * omega)
    _, feedback = _servo(servo, omega, cycle_s)
    push = spring * load / (spring + load) / mechanics.ratio * _motor(mechanics, 1j * omega)
    held = _held_motor(mechanics, servo, omega) * feedback
    motor = push * (held / (1.0 + feedback * _sampled_motor(mechanics, servo, omega)) - 1.0)
    return spring / (spring + load) * (1.0 + motor / mechanics.ratio)


def _servo(servo: Servo, omega: np.ndarray, cycle_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Torque samples per set-point, and per motor reading with the sign turned."""
    period, law = servo.period_s, servo.law
    back = np.exp(-1j * omega * period)  # z^-1
    difference = (1.0 - back) / period
    late = back ** round(servo.dead_time_ms / servo.period_ms)
    position, speed, acceleration = (
        late * each for each in _demand(servo.interpolation, omega, cycle_s, period)
    )
    total = back / (1.0 - back)  # sum of all samples before

    def lag(time_ms: float) -> np.ndarray:
        keep = math.exp(-1000.0 * period / time_ms) if time_ms > 0.0 else 0.0
        return (1.0 - keep) / (1.0 - keep * back)

    if isinstance(law, StateFeedback):
        return _state_feedback(law, position, back, period)
    gain = law.velocity_gain_nm_s_per_rad
    measured = lag(law.speed_filter_ms) * difference
    if isinstance(law, PiNotch):
        length = max(1, round(law.moving_average_ms / servo.period_ms))
        command = position * sum(back**i for i in range(length)) / length
        warped = 1j * np.tan(0.5 * omega * period) / math.tan(math.pi * law.notch_hz * period)
        notch = (warped**2 + law.notch_depth * law.notch_width * warped + 1.0) / (
            warped**2 + law.notch_width * warped + 1.0
        )
        loop = (
            gain * (1.0 + 1000.0 * period / law.integral_time_ms * total) * notch * lag(law.torque_filter_ms)
        )
        forward = loop * (law.position_gain_per_s + law.velocity_feedforward * difference) * command
        feedback = loop * (law.position_gain_per_s + measured)
    elif isinstance(law, Piv):
        error = gain * (law.position_gain_per_s + period * law.integral_gain_per_s2 * total)
        forward = error * position + gain * law.velocity_feedforward * speed
        forward = forward + law.inertia_feedforward_kg_m2 * acceleration
        feedback = error + gain * measured
    else:
        assert isinstance(law, Observed)
        command = position * lag(law.first_filter_ms) * lag(law.second_filter_ms)
        rate = math.tau * law.observer_hz
        estimate = lag(1000.0 / rate) * back
        supplied = 1.0 - law.observer_gain * estimate
        loop = gain * (1.0 + 1000.0 * period / law.integral_time_ms * total) / supplied
        forward = loop * law.position_gain_per_s * command
        momentum = law.observer_gain * rate * law.nominal_inertia_kg_m2 * (1.0 - estimate) / supplied
        feedback = loop * (law.position_gain_per_s + measured) + momentum * measured
    return forward, feedback


def _load_and_spring(mechanics: Mechanics, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque per angle of the load, and of the spring."""
    load = mechanics.load_inertia_kg_m2 * s**2 + mechanics.load_viscous_nm_s_per_rad * s
    return load, mechanics.stiffness_nm_per_rad + mechanics.damping_nm_s_per_rad * s


def _motor(mechanics: Mechanics, s: np.ndarray) -> np.ndarray:
    """Motor angle per torque, the load on its spring."""
    load, spring = _load_and_spring(mechanics, s)
    motor = mechanics.motor_inertia_kg_m2 * s**2 + mechanics.viscous_nm_s_per_rad * s
    return 1.0 / (motor + spring * load / (spring + load) / mechanics.ratio**2)


def _held_motor(mechanics: Mechanics, servo: Servo, omega: np.ndarray) -> np.ndarray:
    """Motor angle per torque sample that is held for one period, through the lag of the current loop."""
    s = 1j * omega
    held = -np.expm1(-s * servo.period_s) / (s * servo.period_s)
    return held / (1.0 + s * servo.current_lag_ms / 1000.0) * _motor(mechanics, s)


def _sampled_motor(mechanics: Mechanics, servo: Servo, omega: np.ndarray) -> np.ndarray:
    """Motor reading per torque sample."""
    return _held_motor(mechanics, servo, omega + math.tau / servo.period_s * ALIASES).sum(axis=0)


def _demand(
    interpolation: str, omega: np.ndarray, cycle_s: float, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Demanded position, speed and acceleration at the servo's samples, per set-point."""
    share = (np.arange(round(cycle_s / period)) * period / cycle_s)[:, None]
    a, b, c, d = (np.exp(1j * omega * cycle_s * age) for age in (-3.0, -2.0, -1.0, 0.0))
    slope, before = d - c, c - b
    if interpolation == "hold":
        values = [d + 0.0 * share, slope + 0.0 * share, slope - before + 0.0 * share]
    elif interpolation == "linear":
        values = [c + slope * share, slope + 0.0 * share, slope - before + 0.0 * share]
    else:  # Hermite between b and c with the central differences as slopes
        m0, m1 = 0.5 * (c - a), 0.5 * (d - b)
        values = [
            b * (2 * share**3 - 3 * share**2 + 1)
            + m0 * (share**3 - 2 * share**2 + share)
            + c * (3 * share**2 - 2 * share**3)
            + m1 * (share**3 - share**2),
            b * (6 * share**2 - 6 * share)
            + m0 * (3 * share**2 - 4 * share + 1)
            + c * (6 * share - 6 * share**2)
            + m1 * (3 * share**2 - 2 * share),
            b * (12 * share - 6) + m0 * (6 * share - 4) + c * (6 - 12 * share) + m1 * (6 * share - 2),
        ]
    turned = np.exp(-1j * omega * cycle_s * (share - 1.0))
    position, speed, acceleration = ((value * turned).mean(axis=0) for value in values)
    return position, speed / cycle_s, acceleration / cycle_s**2


def _state_feedback(
    law: StateFeedback, position: np.ndarray, back: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Torque per set-point, and torque per motor angle with the sign turned, the observer's loop closed."""
    rate, inertia = math.tau * law.reference_hz, law.nominal_inertia_kg_m2
    k1 = inertia * (math.tau * law.feedback_hz) ** 2
    k2 = 2.0 * law.feedback_damping * math.tau * law.feedback_hz * inertia
    move = period / (1.0 - back)  # reference position per reference speed
    speed = period * rate**2 * position
    speed = speed / (1.0 - back + period * back * (2.0 * law.reference_damping * rate + rate**2 * move))
    reference = inertia * law.acceleration_feedforward * (1.0 - back) / period * speed
    reference = reference + (k1 * move + k2) * speed

    w = math.tau * law.observer_hz
    gains = period * np.array([3.0 * w, 3.0 * w**2, w**3 * inertia])
    step = np.array([[1.0, period, 0.0], [0.0, 1.0, period / inertia], [0.0, 0.0, 1.0]])
    step[:, 0] -= gains
    push, row = np.array([0.0, period / inertia, 0.0]), np.array([k1, k2, 1.0])
    matrix = np.eye(3) / back[:, None, None] - step
    by_motor = np.linalg.solve(matrix, np.broadcast_to(gains, (back.size, 3))[..., None])[..., 0] @ row
    by_torque = np.linalg.solve(matrix, np.broadcast_to(push, (back.size, 3))[..., None])[..., 0] @ row
    return reference / (1.0 + by_torque), by_motor / (1.0 + by_torque)
