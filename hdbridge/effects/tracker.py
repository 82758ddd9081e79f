"""An effect on line: asked about an angle as often as one likes, moved on once per cycle."""

from __future__ import annotations

from abc import ABC, abstractmethod

from hdbridge.effects.motion import Moment


class Tracker(ABC):
    """An effect followed on line.

    `peek` answers "what would the error be at this motor angle, coming from the present state" as often as
    it is asked; only `advance` moves the state on.
    """

    __slots__ = ()

    @property
    def memory_deg(self) -> float:
        """Motor angle that, run in one direction, makes the state independent of where it began.

        0 where the path is not remembered at all. Memory of time (creep, warmth) does not count.
        """
        return 0.0

    @abstractmethod
    def peek(self, motor_deg: float, moment: Moment) -> float:
        """Error in arcsec at the load if the motor moved straight to ``motor_deg``; changes nothing."""

    @abstractmethod
    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Move to ``motor_deg``, keep the new state and return the error in arcsec at the load."""


class Memoryless(Tracker):
    """Base for the trackers of effects without state: to advance is to peek."""

    __slots__ = ()

    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Same as `peek`."""
        return self.peek(motor_deg, moment)
