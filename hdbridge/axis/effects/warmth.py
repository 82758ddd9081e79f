"""Warmth of the gear, on which the drifts depend."""

import math
from collections.abc import Iterator
from typing import Final, Literal

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.described import Observations, Shape, Tracker
from hdbridge.axis.effects.kinematics import duration_s
from hdbridge.axis.effects.motion import SLOT, Channel, FloatArray, Moment, Motion
from hdbridge.axis.effects.recurrence import lagged

VARIES_K: Final = 0.3
"""Minimum temperature change in a record for a visible effect, K."""
QUICK_S: Final = (2.0, 15.0)
SLOW_S: Final = (60.0, 240.0, 600.0, 1500.0, 4000.0)
_TEMPERATURE = SLOT[Channel.TEMPERATURE]


class Warmed(Effect):
    """Base class of effects that depend on the gear's warmth, its temperature above a reference, in kelvin.

    With a temperature channel, the gear's temperature follows the sensor with a first-order lag, in
    equilibrium at the first sample. Without a sensor, the gear is assumed to be cold at the first sample, and
    to warm up by ``warm_up_k`` in the long term.
    """

    channels = frozenset({Channel.TIME})
    shape = (Shape("tau_s", 2.0, 3 * 3600.0, logarithmic=True),)

    tau_s: float = Field(gt=0, le=1e6, description="time constant of the gear's temperature")
    driven_by: Literal["temperature", "time"] = Field(
        "temperature", description="the temperature channel, or time since a cold start"
    )
    reference_c: float = Field(20.0, ge=-60, le=200, description="temperature at which the effect is zero")
    warm_up_k: float = Field(10.0, gt=0, le=200, description="final warmth, if driven by time (assumed)")
    limit_k: float = Field(
        60.0, gt=0, le=200, description="warmth in either direction above which the effect is constant"
    )

    @classmethod
    def lags(cls, observations: Observations) -> Iterator[tuple[Literal["temperature", "time"], float]]:
        """Yields the possible inputs (temperature or time) for a record, each with a time constant (s).

        The temperature of a gear with its own sensor hardly lags the reading. Without a sensor, a change that
        settles within a minute is creep, and a change much slower than the record is a straight line.
        """
        temperature = observations.motion.measured.get(Channel.TEMPERATURE)
        if temperature is not None and float(np.ptp(temperature)) > VARIES_K:
            yield from (("temperature", each) for each in (*QUICK_S, *SLOW_S))
        else:
            longest = 6.0 * duration_s(observations.motion)
            yield from (("time", each) for each in SLOW_S if each <= longest)

    def needs(self) -> frozenset[Channel]:
        """Returns the time channel, and the temperature channel if the effect uses it."""
        return self.channels | ({Channel.TEMPERATURE} if self.driven_by == "temperature" else frozenset())

    def warmth(self, motion: Motion) -> FloatArray:
        """Returns the warmth at each sample, K, shape (n,)."""
        time_s = motion.channel(Channel.TIME, self.name)
        if self.driven_by == "time":
            warmth = self.warm_up_k * -np.expm1(-(time_s - time_s[:1]) / self.tau_s)
        else:
            temperature = motion.channel(Channel.TEMPERATURE, self.name)
            warmth = lagged(temperature, time_s, self.tau_s) - self.reference_c
        return np.clip(warmth, -self.limit_k, self.limit_k)


class WarmthTracker(Tracker):
    """Tracker of the warmth times ``gain``."""

    def __init__(self, effect: Warmed, gain: float = 1.0) -> None:
        self._gain = gain
        self._tau = effect.tau_s
        self._by_time = effect.driven_by == "time"
        self._reference = effect.reference_c
        self._final = effect.warm_up_k
        self._limit = effect.limit_k
        self._start: float | None = None
        self._time = self._temperature = 0.0

    def peek(self, motor_deg: float, moment: Moment) -> float:
        if self._by_time:
            since = 0.0 if self._start is None else moment.time_s - self._start
            warmth = -self._final * math.expm1(-since / self._tau)
        else:
            warmth = self._followed(moment) - self._reference
        return self._gain * min(max(warmth, -self._limit), self._limit)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        warmth = self.peek(motor_deg, moment)
        self._temperature = self._followed(moment)
        if self._start is None:
            self._start = moment.time_s
        self._time = moment.time_s
        return warmth

    def _followed(self, moment: Moment) -> float:
        if self._start is None:
            return moment.measured[_TEMPERATURE]
        decay = math.exp(-max(moment.time_s - self._time, 0.0) / self._tau)
        return decay * self._temperature + (1.0 - decay) * moment.measured[_TEMPERATURE]
