"""Properties of a record that an effect may use before any fit, to propose itself or to decline."""

from typing import Final, Protocol

import numpy as np

from hdbridge.axis.effects.motion import Channel, Motion
from hdbridge.axis.effects.path import standing_s

TOP: Final = 0.98
"""Quantile of a channel's magnitude that counts as its maximum, because single readings may be wrong."""


class Observations(Protocol):
    """A record as seen by an effect."""

    @property
    def motion(self) -> Motion:
        """Motion of the axis."""
        ...

    @property
    def ratio(self) -> float:
        """Motor turns per turn of the load."""
        ...

    @property
    def period_s(self) -> float:
        """Median time between samples, s."""
        ...

    @property
    def reversals(self) -> int:
        """Number of motor reversals with travel on both sides."""
        ...

    @property
    def motor_count_arcsec(self) -> float:
        """One count of the motor encoder at the load, arcsec."""
        ...


def top_speed_deg_s(motion: Motion) -> float:
    """Returns the highest motor speed, ignoring outliers; one turn per second if the speed is not known."""
    speed = motion.motor_speed_deg_s
    return 360.0 if speed is None else float(np.quantile(np.abs(speed), 0.99))


def top(motion: Motion, channel: Channel) -> float:
    """Returns the largest magnitude of a measured channel; 0 if it was not measured or never changes."""
    values = motion.measured.get(channel)
    if values is None or not float(np.ptp(values)) > 0.0:
        return 0.0
    return float(np.quantile(np.abs(values), TOP))


def duration_s(motion: Motion) -> float:
    """Returns the time from the first to the last sample, s; 0 without a clock."""
    return 0.0 if motion.time_s is None else float(np.ptp(motion.time_s))


def longest_rest_s(motion: Motion) -> float:
    """Returns the duration of the longest standstill, s."""
    return float(np.max(standing_s(motion), initial=0.0))
