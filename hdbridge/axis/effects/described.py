"""Types that describe an effect: texts, shape parameters, its part in a model, on-line tracker."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple, Protocol

from hdbridge.axis.effects.motion import BoolArray, Moment, Motion


class Part(Enum):
    """Part of a model that other effects may scale, and of which they therefore contain a copy."""

    ORDERS = "ripple"
    """Motor orders of the model."""
    LOOP = "elastic loop"
    GROWTH = "growth of the ripple with torque"


class Sought(Enum):
    """Form of an effect for which a matched filter searches, at all locations simultaneously."""

    STEP = "a step in time"
    BUMP = "a bump at one load angle"
    TONE = "one line of the spectrum over time"
    LINE = "one line of the spectrum over a turn of the load"


class Moves(Enum):
    """Distance from the optimum within which local steps of a fit improve a shape parameter."""

    ANYWHERE = "anywhere"
    NEARBY = "nearby"
    """Local steps improve it only near the optimum, which a search must find first."""
    NEVER = "never"
    """Local steps never improve it, because the error does not depend smoothly on the parameter."""


class Experiment(NamedTuple):
    """Measurement that separates two causes."""

    minutes: float
    words: str


@dataclass(frozen=True, slots=True)
class Shape:
    """Parameter in which an effect is *not* linear, with its range in a fit."""

    name: str
    lower: float
    upper: float
    logarithmic: bool = False
    """True if a fit steps in the parameter's logarithm (for widths and time constants)."""
    moves: Moves = Moves.ANYWHERE
    is_frequency: bool = False
    """True for a frequency in time, whose resolution depends on the length of the record."""

    def grid(self, points: int) -> tuple[float, ...]:
        """Returns ``points`` values over the range, evenly spaced (in the logarithm if logarithmic)."""
        if points < 2:
            return (
                math.sqrt(self.lower * self.upper) if self.logarithmic else 0.5 * (self.lower + self.upper),
            )
        share = [(i + 0.5) / points for i in range(points)]
        if self.logarithmic:
            return tuple(self.lower * (self.upper / self.lower) ** each for each in share)
        return tuple(self.lower + (self.upper - self.lower) * each for each in share)


@dataclass(frozen=True, slots=True)
class Cause:
    """Texts that describe an effect, for reports and the generated page of the catalogue."""

    title: str
    """Short descriptive name in standard terms."""
    equation: str
    """Law in plain text."""
    signature: str
    """Visible symptom in a record."""
    consequence: str
    remedy: str
    """Advice to the user."""
    experiment: str
    """Measurement that separates the cause from similar causes."""
    aliases: tuple[str, ...] = ()
    """Names of the causes with which it can be confused."""
    source: str = ""
    """Source of the equation."""
    size: str = ""
    """Typical size."""
    subject: str = ""
    """Noun for summaries that cover several causes; if empty, the cause's name is used."""
    apart: Mapping[str, Experiment] = field(default_factory=dict)
    """Measurements that separate this cause from others, by the other's name. Either cause may declare it."""


@dataclass(frozen=True, slots=True)
class Compensable:
    """Possibility of compensating effects of a kind, with the reason."""

    possible: bool
    why: str


@dataclass(frozen=True, slots=True)
class Coefficient:
    """Name and location of one coefficient, or of the cosine and sine of an order."""

    name: str
    """Name of the parameter with its unit; for a cosine and sine, the prefix of amplitude and phase."""
    columns: tuple[int, ...]
    """Column of the coefficient; for a cosine and sine, both columns."""
    path: tuple[str | int, ...]
    """Path of the parameter in `Effect.parameters`; for a cosine and sine, the path of their order."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Samples in which an effect must be visible, because elsewhere other effects may imitate it."""

    rows: BoolArray
    """Mask of the samples, shape (n,)."""
    otherwise: str
    """Reason for rejecting the effect if these samples do not show it, for messages."""


class Observations(Protocol):
    """Properties of a record that effects use."""

    @property
    def motion(self) -> Motion: ...

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
        """Number of motor reversals with sufficient travel on both sides."""
        ...

    @property
    def motor_count_arcsec(self) -> float:
        """One count of the motor encoder, referred to the load, arcsec."""
        ...

    @property
    def load_swings(self) -> bool:
        """True if the load's oscillation on its spring is ordinary, and not part of the error."""
        ...


class Tracker(ABC):
    """On-line state of an effect.

    `peek` returns the error after a move from the current state to a motor angle, and may be called
    repeatedly. Only `advance` changes the state.
    """

    @property
    def memory_deg(self) -> float:
        """Motor travel in one direction after which the error no longer depends on the earlier path.

        0 for an effect that does not depend on the path. Memory in time (creep, warmth) does not count.
        """
        return 0.0

    @abstractmethod
    def peek(self, motor_deg: float, moment: Moment) -> float:
        """Returns the error at the load after a move to ``motor_deg``, arcsec, without changing the state."""

    @abstractmethod
    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Moves to ``motor_deg``, updates the state and returns the error at the load, arcsec."""


class Memoryless(Tracker):
    """Tracker without state, whose `advance` equals `peek`."""

    def __init__(self, at: Callable[[float, Moment], float]) -> None:
        """``at`` returns the error at a motor angle and a moment."""
        self._at = at

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._at(motor_deg, moment)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        return self.peek(motor_deg, moment)


class Level(Memoryless):
    """Tracker of an error that depends only on the moment, not on the motor angle."""


class Scaled(Tracker):
    """Tracker of another tracker's error times a factor that depends on the moment."""

    def __init__(self, tracker: Tracker, factor: Callable[[Moment], float]) -> None:
        self._tracker, self._factor = tracker, factor

    @property
    def memory_deg(self) -> float:
        return self._tracker.memory_deg

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._factor(moment) * self._tracker.peek(motor_deg, moment)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        return self._factor(moment) * self._tracker.advance(motor_deg, moment)


class Sum(Tracker):
    """Tracker of the sum of several trackers' errors."""

    def __init__(self, trackers: Sequence[Tracker]) -> None:
        self._trackers = trackers

    @property
    def memory_deg(self) -> float:
        """Longest memory of all trackers."""
        return max((each.memory_deg for each in self._trackers), default=0.0)

    def peek(self, motor_deg: float, moment: Moment) -> float:
        total = 0.0
        for tracker in self._trackers:
            total += tracker.peek(motor_deg, moment)
        return total

    def advance(self, motor_deg: float, moment: Moment) -> float:
        total = 0.0
        for tracker in self._trackers:
            total += tracker.advance(motor_deg, moment)
        return total
