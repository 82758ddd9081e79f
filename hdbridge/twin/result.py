"""What `fit_twin` gives: the simulated drive's parameters, how sure they are, and what is left."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from hdbridge.sim.truth import Truth
from hdbridge.twin.comparison import Comparison
from hdbridge.twin.naming import Alike, Finding

HELD_OUT = "held out"
"""The kind of leg that stands for those held out in a comparison."""
NOISE_LEVEL: Final = 1.3
"""Rms of what is left, in units of the noise in motion, up to which nothing is left: replays of the true
values of 608, 609 and 612 (tools/twin_random_axes.py) leave 0.3 to 1.22."""
MOST_NOISE: Final = 3.0
"""The same, up to which a channel is explained if what is left is also a small share of its signal: 620,
whose intervals hold 1 of 18 true values, leaves 2.9 to 28 with its true values."""
MOST_SHARE: Final = 0.05
"""That share, rms of what is left over rms of the signal."""


class Values(StrEnum):
    """Where the values of a truth come from; `provenance.values` in its file."""

    USUAL = "usual"
    """Assumed for axes of this kind."""
    AXIS = "axis"
    """Fitted, and nothing is left beyond the noise."""
    REPLAY = "replay"
    """Fitted, but a channel is left with more: a different drive that moves alike."""

    @classmethod
    def of(cls, truth: Truth) -> Values | None:
        """That of a truth; None of a truth file that somebody wrote."""
        value = truth.provenance.get("values")
        return cls(value) if value is not None else None


@dataclass(frozen=True, slots=True)
class Left:
    """What a replay leaves of a channel."""

    channel: str
    share: float
    """Rms over that of the signal."""
    times_noise: float
    """Rms over the noise in motion."""
    kind: str
    """Kind of the legs in which it is largest."""

    @property
    def explained(self) -> bool:
        """Whether it is within the noise, or nearly so and a small share of the signal."""
        return self.times_noise <= NOISE_LEVEL or (
            self.times_noise <= MOST_NOISE and self.share <= MOST_SHARE
        )


@dataclass(frozen=True)
class Twin:
    """A simulated drive that has learnt an axis."""

    truth: Truth
    """With the intervals of what was fitted, and in its provenance what `check` needs."""
    findings: tuple[Finding, ...]
    """What was wrong with the simulation that the fit began with, if its values were the axis's."""
    alike: tuple[Alike, ...]
    """Parameters that the recordings' motion cannot tell apart."""
    left: tuple[Left, ...]
    """What is left of each recorded channel, on held-out legs if there are any."""
    before: Comparison
    """The recordings against the simulation that the fit began with; the kind `HELD_OUT` is of legs that the
    fit has not seen."""
    after: Comparison
    """The same against the twin."""
    impossible: tuple[str, ...] = ()
    """Values that no such axis has, each in a sentence; only of a twin whose values are not the axis's."""

    @property
    def values(self) -> Values:
        """Whether its values are those of the axis."""
        return Values.of(self.truth) or Values.REPLAY

    @property
    def unexplained(self) -> tuple[Left, ...]:
        """The channels that are left with more than their noise."""
        return tuple(each for each in self.left if each.times_noise > NOISE_LEVEL)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by the place in the truth file; none unless the values are the axis's."""
        return self.truth.intervals

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the values come from."""
        return self.truth.provenance
