"""Lost encoder counts or a skipped tooth: a persistent step of the error."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Angleless, Effect
from hdbridge.axis.effects.described import (
    Cause,
    Coefficient,
    Compensable,
    Moves,
    Observations,
    Shape,
    Sought,
    Stretch,
)
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.path import away_from_reversals
from hdbridge.strictness import Strict

NEAR_S, LEAST_NEAR = 1.0, 5
"""Neighbourhood in which a step must be sudden: duration in seconds, and minimum number of samples."""


class Step(Strict):
    """One step: from ``time_s`` on, the error is larger by ``size_arcsec``."""

    time_s: float = Field(ge=-1e10, le=1e10, description="time of the step, on the record's clock")
    size_arcsec: float = Field(ge=-1e6, le=1e6, description="the step, at the load")


class CountLoss(Angleless):
    """Sum of size_j over all steps with time_j <= t."""

    name = "count_loss"
    channels = frozenset({Channel.TIME})
    about = Cause(
        title="lasting step",
        subject="lost counts",
        equation="sum of size_j over the steps with t >= t_j",
        signature="a sudden lasting shift by whole encoder counts or by a tooth",
        consequence="every later position is off by the step until the axis is homed",
        remedy="home again; check cable, shield and supply of the encoder; a step of a whole tooth (360/z "
        "deg) is ratcheting: stop and inspect the gear",
        experiment="pass an index pulse or a reference mark before and after",
        aliases=("zero_drift", "wear"),
        source="kinematics",
        size="from one motor count (3 arcsec)",
    )
    compensable = Compensable(
        False,
        "it cannot be predicted and ends with homing; a loss in the load encoder is an error of the "
        "measurement",
    )
    shape = (Shape("time_s", -1e10, 1e10, moves=Moves.NEVER),)
    usual = 2
    sought = Sought.STEP
    inexact = 0.03
    """Slow effects can leave apparent smaller steps next to a large one."""
    typical = {"steps": (Step(time_s=0.0, size_arcsec=10.0),)}

    steps: tuple[Step, ...] = Field(
        min_length=1, max_length=100, description="losses: time_s, size_arcsec each"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields one step in the middle of the record, as an example."""
        if observations.motion.time_s is not None:
            middle = float(np.quantile(observations.motion.time_s, 0.5))
            yield cls(steps=(Step(time_s=middle, size_arcsec=1.0),))

    def unidentifiable(self, observations: Observations) -> str:
        """Requires reversals, because without them a step in time may also be a step in position."""
        return "" if observations.reversals >= 2 else "a step in time could also be a step at one angle"

    def shows(self, motion: Motion) -> Stretch | None:
        """Returns the samples away from reversals, where a misfit of the loop's shape leaves no steps."""
        return away_from_reversals(motion)

    def changing(self, motion: Motion) -> FloatArray:
        """Returns steps shortly before and after the real one, which a slow change would need in addition."""
        time_s = motion.channel(Channel.TIME, self.name)
        first = int(np.searchsorted(time_s, self.steps[0].time_s))
        near = max(LEAST_NEAR, round(NEAR_S / float(np.median(np.diff(time_s)))))
        number = np.arange(len(time_s))
        return np.column_stack([number >= first - near, number >= first + near]).astype(np.float64)

    def pieces(self) -> tuple[Self, ...]:
        return tuple(self.model_copy(update={"steps": (each,)}) for each in self.steps)

    def joined(self, other: Effect) -> Self | None:
        if not isinstance(other, CountLoss):
            return None
        steps = tuple(sorted((*self.steps, *other.steps), key=lambda each: each.time_s))
        return self.model_copy(update={"steps": steps})

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(
            Coefficient(f"step_{i + 1}_size_arcsec", (i,), ("steps", i, "size_arcsec"))
            for i in range(len(self.steps))
        )

    def at(self, motor_deg: float, moment: Moment) -> float:
        now = moment.time_s
        return sum((each.size_arcsec for each in self.steps if now >= each.time_s), 0.0)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns a unit step for each step, shape (n, steps)."""
        time_s = motion.channel(Channel.TIME, self.name)
        return (time_s[:, np.newaxis] >= [each.time_s for each in self.steps]).astype(np.float64)

    def coefficients(self) -> FloatArray:
        return np.array([each.size_arcsec for each in self.steps])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with new step sizes; ``time_s`` in ``shape`` is the time of the last step."""
        times = [each.time_s for each in self.steps]
        if shape and "time_s" in shape:
            times[-1] = float(shape["time_s"])
        steps = tuple(
            Step.model_construct(time_s=time_s, size_arcsec=float(size))
            for time_s, size in zip(times, coefficients, strict=True)
        )
        return self.model_copy(update={"steps": steps})

    def bound_arcsec(self) -> float:
        return sum(abs(each.size_arcsec) for each in self.steps)
