"""Lost motion that grows with the distance travelled."""

import math
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect, Linear
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Shape, Tracker
from hdbridge.axis.effects.motion import FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.path import once
from hdbridge.axis.effects.play import stop
from hdbridge.units import DEG_PER_TURN


class Wear(Linear):
    """(growth / 2) (run / 1000)^exponent s: a loop whose height grows with the number of motor turns run.

    Growth is positive for a loop in the sense of a leading elastic loop, and negative for a growing gap (the
    load lags). Steady wear has an exponent of 1. Running-in, which slows down, has an exponent below 1.
    Within the first turn the height grows linearly, because no power law holds there.
    """

    name = "wear"
    about = Cause(
        title="growing lost motion",
        equation="(growth / 2) (run / 1000)^exponent s, run = turns_before + sum |d theta_M| / 360, "
        "s = clip(s_before + 2 d theta_M / width, -1, 1)",
        signature="the distance between the two directions grows steadily with the turns run, at one "
        "temperature",
        consequence="repeatability from either side worsens with time",
        remedy="calibrate at intervals; watch the rate; grease; replace the gear when the rate rises",
        experiment="the same stepping test, cold, some hours of running apart",
        aliases=("amplitude_drift", "zero_drift", "ratio_error", "backlash"),
        source="lost motion proportional to sliding distance (Archard's law), slowing down while it runs in",
        size="0.1-10 arcsec per 1000 motor turns in a fast test",
    )
    compensable = Compensable(True, "the turns run must be carried over in turns_before")
    shape = (
        Shape("width_deg", 0.05, 60.0, logarithmic=True),
        Shape("exponent", 0.3, 1.5),
    )
    linear = ("growth_arcsec_per_kiloturn",)
    typical = {"growth_arcsec_per_kiloturn": 1.0, "width_deg": 2.0}

    growth_arcsec_per_kiloturn: float = Field(
        ge=-1000, le=1000, description="growth of the loop's height in the first 1000 turns"
    )
    width_deg: float = Field(gt=0, le=360, description="motor angle of a full crossing")
    exponent: float = Field(1.0, ge=0.1, le=3, description="1 for steady wear, below 1 while it runs in")
    turns_before: float = Field(0.0, ge=0, le=1e9, description="motor turns run before the first sample")
    turns_limit: float = Field(
        10_000.0, gt=0, le=1e9, description="motor turns beyond which the height stays constant"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields loops with widths from that of a gap to that of the elastic loop."""
        yield from (cls(growth_arcsec_per_kiloturn=1.0, width_deg=each) for each in (0.5, 4.0, 20.0))

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the motor turns run since the start of the record."""
        run = np.cumsum(np.abs(np.diff(motion.motor_deg, prepend=motion.motor_deg[:1]))) / DEG_PER_TURN
        return Coordinate("motor turns run", "", run, both_ways=True, bins=20)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a growth of 1 arcsec in 1000 turns, shape (n, 1)."""
        angle = motion.motor_deg
        # Cached, because the derivative with respect to the width uses the same growth.
        key = (self.name, self.turns_before, self.turns_limit, self.exponent)
        half = once(angle, start, key, lambda: self._growth(angle))
        column: FloatArray = half * stop(angle, self.width_deg, start)
        return column[:, np.newaxis]

    def _growth(self, angle_deg: FloatArray) -> FloatArray:
        run = self.turns_before + np.cumsum(np.abs(np.diff(angle_deg, prepend=angle_deg[:1]))) / DEG_PER_TURN
        run = np.minimum(run, self.turns_limit)
        share = np.where(run < 1.0, run, np.maximum(run, 1.0) ** self.exponent)
        return np.asarray(0.5 * _kiloturns(1.0, self.exponent) * share)

    def after(self, turns: float) -> Self:
        """Returns the effect after ``turns`` more motor turns."""
        return self.model_copy(update={"turns_before": self.turns_before + turns})

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return _Tracker(self, start, math.inf)

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        if self.growth_arcsec_per_kiloturn >= 0.0:
            return None
        crossing = fall_arcsec_per_deg - self._fastest_growth()
        return _Tracker(self, start, crossing) if crossing > 0.0 else None

    def bound_arcsec(self) -> float:
        return abs(self._half(self.turns_limit))

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns the slope of a downward crossing at maximum height, plus that due to growth with travel."""
        crossing = max(-2.0 * self._half(self.turns_limit) / self.width_deg, 0.0)
        return crossing + self._fastest_growth()

    def _half(self, turns: float) -> float:
        """Returns half the signed height of the loop after this number of motor turns, arcsec."""
        return 0.5 * self.growth_arcsec_per_kiloturn * _kiloturns(turns, self.exponent)

    def _fastest_growth(self) -> float:
        """Returns the maximum growth rate of half the loop's height, arcsec per motor degree."""
        late = self.exponent * math.pow(max(self.turns_limit, 1.0), self.exponent - 1.0)
        return abs(self._half(1.0)) * max(1.0, self.exponent, late) / DEG_PER_TURN


def _kiloturns(turns: float, exponent: float) -> float:
    """Returns the loop's height after ``turns``, relative to that after 1000 turns."""
    return math.pow(1e-3, exponent) * (turns if turns < 1.0 else math.pow(turns, exponent))


class _Tracker(Tracker):
    """Tracker whose state is the stop operator's value, the distance run (degrees) and the last angle."""

    def __init__(self, effect: Wear, start: Start, fall_arcsec_per_deg: float) -> None:
        """``fall_arcsec_per_deg`` limits the slope of a crossing."""
        self._half = effect._half
        self._gain = 2.0 / effect.width_deg
        self._fall = fall_arcsec_per_deg
        self._before = effect.turns_before
        self._limit = effect.turns_limit
        self._value = float(start.value)
        self._distance = 0.0
        self._angle: float | None = None

    @property
    def memory_deg(self) -> float:
        """Motor travel of a full crossing at maximum height; the distance run does not count as memory."""
        return max(2.0 / self._gain, 2.0 * abs(self._half(self._limit)) / self._fall)

    def peek(self, motor_deg: float, moment: Moment) -> float:
        _, half, value = self._at(motor_deg)
        return half * value

    def advance(self, motor_deg: float, moment: Moment) -> float:
        self._distance, half, self._value = self._at(motor_deg)
        self._angle = motor_deg
        return half * self._value

    def _at(self, motor_deg: float) -> tuple[float, float, float]:
        """Returns the distance run, half the loop's height and the stop operator's value at ``motor_deg``."""
        step = 0.0 if self._angle is None else motor_deg - self._angle
        distance = self._distance + abs(step)
        half = self._half(min(self._before + distance / DEG_PER_TURN, self._limit))
        gain = self._gain if abs(half) * self._gain <= self._fall else self._fall / abs(half)
        return distance, half, min(max(self._value + gain * step, -1.0), 1.0)
