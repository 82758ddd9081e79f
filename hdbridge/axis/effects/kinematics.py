"""Speed, acceleration and direction of the command, defined once for records and for the control loop.

They are backward differences over the actual time steps:

    v[i] = (theta[i] - theta[i-1]) / (t[i] - t[i-1])        v[0] = 0
    a[i] = (v[i] - v[i-1]) / (t[i] - t[i-1])                a[0] = a[1] = 0
    d[i] = sign(theta[i] - theta[i-1]), held at rest

A time step of zero gives a speed of zero. On line, the angle is the uncompensated command (N times the load
target). The correction itself is much slower than the motion and need not be included. If it were, each
cycle's correction would affect the speed in the next. If a better speed is known (from the procedure, or
smoothed from the load encoder), `Motion` contains it, and it is used directly.
"""

from collections.abc import Iterator

import numpy as np

from hdbridge.axis.effects.motion import (
    AT_REST,
    MEASURED,
    Channel,
    FloatArray,
    Moment,
    Motion,
    Start,
    missing_error,
)


def speed_of(motion: Motion, effect: str) -> FloatArray:
    """Returns the motor speed, motor degrees per second, shape (n,)."""
    if motion.motor_speed_deg_s is not None:
        return motion.motor_speed_deg_s
    return _differences(motion.motor_deg, _time(motion, effect, Channel.SPEED))


def acceleration_of(motion: Motion, effect: str) -> FloatArray:
    """Returns the motor acceleration, motor degrees per second squared, shape (n,)."""
    if motion.motor_acceleration_deg_s2 is not None:
        return motion.motor_acceleration_deg_s2
    time_s = _time(motion, effect, Channel.ACCELERATION)
    result = _differences(speed_of(motion, effect), time_s)
    result[:2] = 0.0
    return result


def direction_of(motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
    """Returns the direction of the last motion, -1 or 1, held at rest; at first that of ``start``."""
    if motion.motor_speed_deg_s is not None:
        signs = np.sign(motion.motor_speed_deg_s)
    else:
        signs = np.sign(np.diff(motion.motor_deg, prepend=motion.motor_deg[:1]))
    last = np.maximum.accumulate(np.where(signs != 0.0, np.arange(len(signs)), -1))
    held: FloatArray = np.where(last >= 0, signs[last], float(start.value)) if len(signs) else signs
    return held


def _time(motion: Motion, effect: str, channel: Channel) -> FloatArray:
    if motion.time_s is None:
        raise missing_error(effect, frozenset({channel, Channel.TIME}))
    return motion.time_s


def _differences(values: FloatArray, time_s: FloatArray) -> FloatArray:
    steps = np.diff(time_s)
    result = np.zeros(len(values))
    np.divide(np.diff(values), steps, out=result[1:], where=steps > 0.0)
    return result


class Observer:
    """Computes the `Moment` of each control cycle from the command; on-line form of the functions above."""

    def __init__(self) -> None:
        self._count = 0
        self._angle = self._time = self._speed = 0.0
        self._direction = 0

    def moment(
        self,
        motor_deg: float,
        time_s: float,
        *,
        measured: tuple[float, ...] = AT_REST,
        load_deg: float = 0.0,
    ) -> Moment:
        """Returns the moment of a control cycle; must be called exactly once per cycle.

        ``motor_deg`` is the uncompensated command, N times the load target. For ``measured`` see
        `Moment.measured`.
        """
        speed = acceleration = 0.0
        if self._count:
            step = time_s - self._time
            moved = motor_deg - self._angle
            if step > 0.0:
                speed = moved / step
                if self._count > 1:
                    acceleration = (speed - self._speed) / step
            if moved:
                self._direction = 1 if moved > 0.0 else -1
        self._count += 1
        self._angle, self._time, self._speed = motor_deg, time_s, speed
        return Moment(time_s, measured, speed, acceleration, self._direction, load_deg)


def moments(motion: Motion) -> Iterator[Moment]:
    """Yields the moment of each sample as in the control loop, with defaults for missing channels."""
    here = motion.available()
    zeros = np.zeros(len(motion))
    known = [motion.measured.get(each, zeros + each.at_rest).tolist() for each in MEASURED]
    measured = zip(*known, strict=True)
    columns = (
        speed_of(motion, "") if Channel.SPEED in here else zeros,
        acceleration_of(motion, "") if Channel.ACCELERATION in here else zeros,
        direction_of(motion).astype(np.int64),
        _or(motion.load_deg, zeros),
    )
    time_s = _or(motion.time_s, zeros).tolist()
    yield from map(Moment, time_s, measured, *(each.tolist() for each in columns))


def _or(values: FloatArray | None, default: FloatArray) -> FloatArray:
    return default if values is None else values


def top_speed_deg_s(motion: Motion) -> float:
    """Returns the highest motor speed, excluding outliers; one turn per second if the speed is unknown."""
    speed = motion.motor_speed_deg_s
    return 360.0 if speed is None else float(np.quantile(np.abs(speed), 0.99))


def duration_s(motion: Motion) -> float:
    """Returns the time from the first to the last sample, s; 0 without a clock."""
    return 0.0 if motion.time_s is None else float(np.ptp(motion.time_s))
