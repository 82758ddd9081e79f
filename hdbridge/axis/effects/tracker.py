"""On-line evaluation of an effect: queried at any angle any number of times, advanced once per cycle."""

from abc import ABC, abstractmethod
from collections.abc import Callable

from hdbridge.axis.effects.motion import Moment


class Tracker(ABC):
    """On-line state of an effect.

    `peek` returns the error at a motor angle reached from the present state, as often as it is called. Only
    `advance` changes the state.
    """

    @property
    def memory_deg(self) -> float:
        """Motor angle that, run in one direction, makes the state independent of the start.

        0 if the path is not remembered at all. Memory in time (creep, warmth) does not count.
        """
        return 0.0

    @abstractmethod
    def peek(self, motor_deg: float, moment: Moment) -> float:
        """Returns the error at the load if the motor moved straight to ``motor_deg``, arcsec; changes
        nothing.
        """

    @abstractmethod
    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Moves to ``motor_deg``, keeps the new state and returns the error at the load, arcsec."""


class Memoryless(Tracker):
    """Tracker without state, for which `advance` equals `peek`."""

    def __init__(self, at: Callable[[float, Moment], float]) -> None:
        """``at`` returns the error at a motor angle and a moment."""
        self._at = at

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._at(motor_deg, moment)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        return self.peek(motor_deg, moment)


class Level(Memoryless):
    """Tracker whose error is the same at every motor angle: the moment alone decides."""
