"""Stop operator, which follows the motor within the limits -1 and 1: the building block of dead zones."""

import numpy as np

from hdbridge.axis.effects.described import Tracker
from hdbridge.axis.effects.motion import FloatArray, Moment, Start
from hdbridge.axis.effects.path import path_of


def stop(motor_deg: FloatArray, width_deg: float, start: Start) -> FloatArray:
    """Returns s[i] = clip(s[i-1] + 2 (theta[i] - theta[i-1]) / width, -1, 1), shape (n,), in linear time.

    Between two reversals, clipping once suffices, so the Python loop runs over the reversals only.
    """
    if not len(motor_deg):
        return np.empty(0)
    path = path_of(motor_deg, start)
    gain = 2.0 / width_deg
    value = float(start.value)
    begin = []
    for step in (gain * path.steps_deg).tolist():
        begin.append(value)
        value += step
        value = 1.0 if value > 1.0 else -1.0 if value < -1.0 else value
    result = np.full(len(motor_deg), float(start.value))
    inside = result[path.turning[0] + 1 :]
    np.multiply(gain, path.away_deg, out=inside)
    inside += np.repeat(begin, path.lengths)
    np.clip(inside, -1.0, 1.0, out=inside)
    return result


class Stop(Tracker):
    """Tracker of ``height`` times the stop operator."""

    def __init__(self, height: float, width_deg: float, start: Start) -> None:
        self._height = height
        self._gain = 2.0 / width_deg
        self._value = float(start.value)
        self._angle: float | None = None

    @property
    def memory_deg(self) -> float:
        """Motor travel from one limit to the other."""
        return 2.0 / self._gain

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._height * self._at(motor_deg)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        self._value = self._at(motor_deg)
        self._angle = motor_deg
        return self._height * self._value

    def _at(self, motor_deg: float) -> float:
        if self._angle is None:
            return self._value
        value = self._value + self._gain * (motor_deg - self._angle)
        return 1.0 if value > 1.0 else -1.0 if value < -1.0 else value
