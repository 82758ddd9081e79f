"""The transmission model: a gear ratio and a sum of effects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from hdbridge.effects import Effect, FloatArray, Moment, Motion, Start, Tracker


@dataclass(frozen=True)
class TransmissionModel:
    """theta_TE = theta_L - theta_M / N as a sum of effects, arcsec at the load."""

    ratio: float
    """N: motor turns per load turn, positive."""
    effects: tuple[Effect, ...] = ()
    uncertainty: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Per effect name: parameter name -> 95 % half width, in the parameter's unit."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the numbers come from: recording, date, versions, drive identity."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Transmission error in arcsec for each sample of a motion, shape (n,)."""
        total = np.zeros(len(motion))
        for effect in self.effects:
            total += effect.predict(motion, start)
        return total

    def tracker(self, start: Start = Start.VIRGIN) -> ModelTracker:
        """A fresh on-line tracker of the whole sum."""
        return ModelTracker([effect.tracker(start) for effect in self.effects])

    def only(self, names: Iterable[str]) -> Self:
        """The same model with no other effects than those named (unknown names are not an error)."""
        wanted = set(names)
        return replace(self, effects=tuple(each for each in self.effects if each.name in wanted))


class ModelTracker(Tracker):
    """The sum of its effects' trackers."""

    __slots__ = ("_trackers",)

    def __init__(self, trackers: list[Tracker]) -> None:
        self._trackers = trackers

    def peek(self, motor_deg: float, moment: Moment) -> float:
        """Sum of the effects at ``motor_deg``, arcsec; changes nothing."""
        total = 0.0
        for tracker in self._trackers:
            total += tracker.peek(motor_deg, moment)
        return total

    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Move every effect on and return the sum, arcsec."""
        total = 0.0
        for tracker in self._trackers:
            total += tracker.advance(motor_deg, moment)
        return total
