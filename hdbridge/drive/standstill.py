"""Standstill of the motor, from successive readings of its encoder. Pure."""

from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.units import ARCSEC_PER_DEG

STANDSTILL_S: Final = 0.02
"""Time without motion after which the motor counts as standing still."""
_NOISE_ARCSEC: Final = 1.0
"""Movement at the load that is noise of the encoder or vibration, whatever the encoder's resolution."""
_NOISE_COUNTS: Final = 2
_ROUNDING_S: Final = 1e-6


def noise_counts(axis: AxisConfig) -> float:
    """Returns the largest movement of the motor encoder at standstill; counts."""
    return max(
        abs(axis.motor_encoder.counts(_NOISE_ARCSEC / ARCSEC_PER_DEG * axis.gear.ratio)), _NOISE_COUNTS
    )


class Standstill:
    """Follows the readings of one motor encoder; the first reading begins a new wait."""

    def __init__(self, axis: AxisConfig) -> None:
        self._noise_counts = noise_counts(axis)
        self.restart()

    def restart(self) -> None:
        """Begins the wait again with the next reading."""
        self._place_counts: int | None = None
        self._since_s = 0.0
        self.reached = False
        """True if the motor stood still up to the last reading."""

    def take(self, motor_counts: int, time_s: float) -> bool:
        """Takes a reading; returns ``reached``."""
        if self._place_counts is None or abs(motor_counts - self._place_counts) > self._noise_counts:
            self._place_counts, self._since_s = motor_counts, time_s
        self.reached = time_s - self._since_s >= STANDSTILL_S - _ROUNDING_S
        return self.reached
