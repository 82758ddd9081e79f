"""Servo loops of the drive: demand filters, position and velocity cascade with feed-forward, torque filters.

The blocks in order: moving average and two lags of the demand, position P, velocity PI on the filtered speed
(whose integral may sum the position error instead: PIV), feed-forwards, disturbance observer, notch, torque
filter, limit.

Like a real drive of this class, the simulated drive closes its loops on an interpolated encoder, so the motor
settles in the middle of the commanded count rather than anywhere within it.
"""

import math

from hdbridge.sim.encoder import Late
from hdbridge.sim.oscillator import Transition, transition
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.motor import TrueNotch

RAD_PER_DEG = math.pi / 180.0
HIGHEST_NOTCH = 0.45
"""Maximum notch frequency as a fraction of the substep rate; the bilinear transform ends at half the rate."""
AT_REST_DEG_S = 0.05
"""Speed below which the demand counts as at rest: friction feed-forward keeps its direction, and the
integral may rest."""


@state
class MovingAverage:
    """Moving average of the demand, from its integral now and one averaging time ago."""

    def __init__(self, duration_s: float, dt_s: float) -> None:
        self._duration_s = max(duration_s, dt_s)
        self._late_integral = Late(self._duration_s, dt_s, 0.0)
        self.start_at(0.0)

    def start_at(self, demand_deg: float) -> None:
        """Resets the average to a demand that has always been constant."""
        self._start_deg, self._integral = demand_deg, 0.0
        self._late_integral.begin(0.0)

    def mean_deg(self) -> float:
        """Returns the current mean of the demand."""
        return self._start_deg + (self._integral - self._late_integral.deg) / self._duration_s

    def add_up(self, demand_deg: float, duration_s: float) -> None:
        """Advances by ``duration_s`` with this mean demand."""
        self._integral += (demand_deg - self._start_deg) * duration_s
        self._late_integral.feed(self._integral)


@state
class Notch:
    """Second-order notch, transposed direct form."""

    def __init__(self, truth: TrueNotch | None, dt_s: float) -> None:
        half = math.tan(math.pi * min(truth.frequency_hz * dt_s, HIGHEST_NOTCH)) if truth else 0.0
        depth, width = (truth.depth, truth.width) if truth else (1.0, 1.0)
        scale = 1.0 + width * half + half * half
        self._b0 = (1.0 + depth * width * half + half * half) / scale
        self._a1 = 2.0 * (half * half - 1.0) / scale
        self._b2 = (1.0 - depth * width * half + half * half) / scale
        self._a2 = (1.0 - width * half + half * half) / scale
        self.rest_at(0.0)

    def rest_at(self, torque_nm: float) -> None:
        """Resets to a constant torque at input and output."""
        self._first = (1.0 - self._b0) * torque_nm
        self._second = (self._b2 - self._a2) * torque_nm

    def notched_nm(self, torque_nm: float) -> float:
        """Filters one sample of the torque."""
        notched = self._b0 * torque_nm + self._first
        self._first = self._a1 * (torque_nm - notched) + self._second
        self._second = self._b2 * torque_nm - self._a2 * notched
        return notched


@state
class Servo:
    """State of the loops. Demand and motor angle are in motor degrees."""

    limit_nm: float
    """Torque limit in either direction."""

    def __init__(self, truth: Truth) -> None:
        servo, encoder = truth.servo, truth.motor.encoder
        dt = truth.substep_s
        self._dt = dt
        self._filter = 1000.0 / servo.command_filter_ms
        self._with_average: bool = servo.moving_average_ms > 0.0
        self._average = MovingAverage(servo.moving_average_ms / 1000.0, dt)
        self._with_filters = bool(servo.notch or servo.speed_filter_ms or servo.torque_filter_ms)
        self._speed_share = _share(servo.speed_filter_ms / 1000.0, dt)
        self._torque_share = _share(servo.torque_filter_ms / 1000.0, dt)
        self._notch = Notch(servo.notch, dt)
        self._filtered_nm = 0.0
        observer = servo.observer
        rate = math.tau * observer.frequency_hz if observer else 0.0
        self._observer_share = -math.expm1(-rate * dt)
        self._observed_share = observer.share if observer else 0.0
        self._momentum = rate * observer.inertia_kg_m2 * RAD_PER_DEG if observer else 0.0
        self._sums_position: bool = servo.integral_of == "position"
        self._decay = math.exp(-self._filter * dt)
        self._position_gain = servo.position_gain_per_s
        self._velocity_gain = servo.velocity_gain_nm_s_per_rad * RAD_PER_DEG
        self._integral_rate = self._velocity_gain * dt / (servo.integral_time_ms / 1000.0)
        self._velocity_feedforward = servo.velocity_feedforward
        self._acceleration_gain = servo.inertia_feedforward_kg_m2 * RAD_PER_DEG / dt
        load = servo.load_feedforward
        self._load_known: bool = load is not None
        self._load_model: Transition = transition(load, dt)
        self._load_gain = load.inertia_kg_m2 * RAD_PER_DEG / dt if load else 0.0
        self._viscous = servo.viscous_feedforward_nm_s_per_rad * RAD_PER_DEG
        self._friction = servo.friction_feedforward_nm
        self._steps_per_deg = encoder.counts_per_turn * encoder.interpolation / 360.0
        self._step_deg = 1.0 / self._steps_per_deg
        self._dead_band = (servo.integral_dead_band + 0.5) * self._step_deg
        self._hunting_band = (servo.hunting_band + 0.5) * self._step_deg
        self.limit_nm = truth.motor.rated_torque_nm * servo.torque_limit_percent / 100.0
        self.engage(0.0, 0.0)

    def engage(self, motor_deg: float, motor_deg_s: float) -> float:
        """Starts the loops at a motor angle, without torque or error; returns the angle that they measure."""
        self._measured = self._interpolated(motor_deg)
        self._reference = self._last_reference = self._measured
        self._reference_speed = self.measured_deg_s = motor_deg_s
        self._load_ahead = 0.0
        self._load_speed = motor_deg_s
        self._integral = 0.0
        self._observed_nm = self._momentum * motor_deg_s
        self._direction = 0.0
        self._average.start_at(self._measured)
        self._filtered_speed = motor_deg_s
        self._notch.rest_at(0.0)
        self._filtered_nm = 0.0
        return self._measured

    def shift(self, torque_nm: float) -> None:
        """Changes the integral and the observer as for an additional constant disturbance ``torque_nm``."""
        self._integral += (1.0 - self._observed_share) * torque_nm
        self._observed_nm += torque_nm
        if self._with_filters:
            self._filtered_nm += torque_nm
            self._notch.rest_at(self._filtered_nm)

    def answer_nm(self, demand_deg: float, demand_deg_s: float, motor_deg: float) -> float:
        """Returns the torque for one substep, in which the demand moves linearly from ``demand_deg``."""
        dt = self._dt
        measured = math.floor(motor_deg * self._steps_per_deg + 0.5) * self._step_deg
        measured_speed = (measured - self._measured) / dt
        self._measured = measured
        self.measured_deg_s = measured_speed
        if self._with_filters:
            self._filtered_speed += self._speed_share * (measured_speed - self._filtered_speed)
            measured_speed = self._filtered_speed
        if self._with_average:
            average = self._average
            before_deg = average.mean_deg()
            average.add_up(demand_deg + 0.5 * dt * demand_deg_s, dt)
            demand_deg, demand_deg_s = before_deg, (average.mean_deg() - before_deg) / dt

        # Reference: the demand after two equal lags, stepped exactly. The reference never overshoots a demand
        # that does not reverse, and its speed and acceleration stay finite at the steps of a demand in
        # counts.
        reference, speed = self._reference, self._reference_speed
        w, decay = self._filter, self._decay
        behind = reference - demand_deg + 2.0 * demand_deg_s / w
        slower = speed - demand_deg_s
        new_speed = demand_deg_s + decay * (slower - w * dt * (slower + w * behind))
        self._reference = (
            demand_deg + demand_deg_s * (dt - 2.0 / w) + decay * (behind + dt * (slower + w * behind))
        )
        self._reference_speed = new_speed

        # Both speeds are averages over the last substep.
        error = reference - measured
        wanted_speed = (reference - self._last_reference) / dt
        self._last_reference = reference
        speed_error = self._velocity_feedforward * wanted_speed + self._position_gain * error - measured_speed
        rests = -AT_REST_DEG_S < new_speed < AT_REST_DEG_S
        integral = self._integral
        if not rests and new_speed * self._direction <= 0.0:
            integral = self._turn(1.0 if new_speed > 0.0 else -1.0)
        short = error * self._direction
        awake = not rests or short > self._dead_band or short < -self._hunting_band
        if awake:
            integral += self._integral_rate * (
                self._position_gain * error if self._sums_position else speed_error
            )
        torque = (
            self._velocity_gain * speed_error
            + integral
            + self._acceleration_gain * (new_speed - speed)
            + self._viscous * new_speed
            + self._friction * self._direction
        )
        momentum = self._momentum * measured_speed
        torque += self._observed_share * (self._observed_nm - momentum)
        if self._load_known:
            torque += self._load_torque((self._reference - reference) / dt)
        if self._with_filters:
            self._filtered_nm += self._torque_share * (self._notch.notched_nm(torque) - self._filtered_nm)
            torque = self._filtered_nm
        limit = self.limit_nm
        if awake:
            given = min(max(torque, -limit), limit)
            self._observed_nm += self._observer_share * (given + momentum - self._observed_nm)
        if torque > limit:
            # At the limit the integral may only decrease.
            self._integral = min(integral, self._integral)
            return limit
        if torque < -limit:
            self._integral = max(integral, self._integral)
            return -limit
        self._integral = integral
        return torque

    def _load_torque(self, reference_speed: float) -> float:
        """Returns the mean torque over the substep that makes a load on a spring follow the reference."""
        step, ahead, speed = self._load_model, self._load_ahead, self._load_speed
        slip = speed - reference_speed
        self._load_ahead = step.distance_by_distance * ahead + step.distance_by_rate * slip
        self._load_speed = new_speed = (
            reference_speed + step.rate_by_distance * ahead + step.rate_by_rate * slip
        )
        return self._load_gain * (new_speed - speed)

    def _turn(self, direction: float) -> float:
        """Reverses the friction feed-forward; returns the integral reduced by the new feed-forward torque.

        Without friction feed-forward, the integral does not change.
        """
        standing = self._integral + self._friction * self._direction
        self._direction = direction
        if not self._friction:
            return standing
        return direction * max(0.0, direction * standing - self._friction)

    def _interpolated(self, motor_deg: float) -> float:
        return math.floor(motor_deg * self._steps_per_deg + 0.5) * self._step_deg


def _share(time_s: float, step_s: float) -> float:
    """Returns the gain per step of a first-order lag; 1 without a time constant."""
    return -math.expm1(-step_s / time_s) if time_s > 0.0 else 1.0
