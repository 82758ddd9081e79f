"""Stop operator, which follows the motor within the limits -1 and 1: the building block of dead zones."""

import numpy as np

from hdbridge.axis.effects.motion import FloatArray, Start
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


class Stop:
    """On-line stop operator: `at` evaluates it, `to` changes its state."""

    def __init__(self, width_deg: float, start: Start) -> None:
        self._gain = 2.0 / width_deg
        self._value = float(start.value)
        self._angle: float | None = None

    @property
    def memory_deg(self) -> float:
        """Motor travel from one limit to the other."""
        return 2.0 / self._gain

    def at(self, motor_deg: float) -> float:
        """Returns the value after a move to ``motor_deg`` in one direction, without changing the state."""
        if self._angle is None:
            return self._value
        value = self._value + self._gain * (motor_deg - self._angle)
        return 1.0 if value > 1.0 else -1.0 if value < -1.0 else value

    def to(self, motor_deg: float) -> float:
        """Moves to ``motor_deg`` and returns the value there."""
        self._value = self.at(motor_deg)
        self._angle = motor_deg
        return self._value
