"""Result of `fit_twin`: the simulated drive's parameters, their intervals, and the residuals."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from hdbridge.sim.truth import Truth
from hdbridge.twin.comparison import Comparison
from hdbridge.twin.naming import Alike, Finding

HELD_OUT = "held out"
"""Kind of leg for the held-out legs in a comparison."""
NOISE_LEVEL: Final = 1.3
"""Rms residual, in units of the noise in motion, up to which a channel is explained: replays of the true
values of axes 608, 609 and 612 (tools/twin_random_axes.py) leave 0.3 to 1.22."""
MOST_NOISE: Final = 3.0
"""Limit if the residual is also a small share of the signal: axis 620, whose intervals hold 1 of 18 true
values, leaves 2.9 to 28 with its true values."""
MOST_SHARE: Final = 0.05
"""Maximum share for `MOST_NOISE`: rms residual over rms signal."""


class Values(StrEnum):
    """Origin of the values of a truth; `provenance.values` in its file."""

    USUAL = "usual"
    """Assumed for axes of this kind."""
    AXIS = "axis"
    """Fitted, with residuals within the noise."""
    REPLAY = "replay"
    """Fitted, but a channel has larger residuals: a different drive with similar motion."""

    @classmethod
    def of(cls, truth: Truth) -> Values | None:
        """Returns the origin of a truth's values; None for a truth file written by hand."""
        value = truth.provenance.get("values")
        return cls(value) if value is not None else None


@dataclass(frozen=True, slots=True)
class Left:
    """Residual of a channel."""

    channel: str
    share: float
    """Rms residual over rms signal."""
    times_noise: float
    """Rms residual over the noise in motion."""
    kind: str
    """Kind of the legs with the largest residual."""

    @property
    def explained(self) -> bool:
        """True if it is within the noise, or nearly so and a small share of the signal."""
        return self.times_noise <= NOISE_LEVEL or (
            self.times_noise <= MOST_NOISE and self.share <= MOST_SHARE
        )


@dataclass(frozen=True)
class Twin:
    """A simulated drive fitted to an axis."""

    truth: Truth
    """Parameters with the intervals of the fitted ones; its provenance holds the data that `check` needs."""
    findings: tuple[Finding, ...]
    """Causes by which the initial simulation was wrong, if its values were the axis's."""
    alike: tuple[Alike, ...]
    """Sets of parameters that the recorded motion does not separate."""
    left: tuple[Left, ...]
    """Residual of each recorded channel, on held-out legs if there are any."""
    before: Comparison
    """Recordings against the initial simulation; the kind `HELD_OUT` covers the held-out legs."""
    after: Comparison
    """Recordings against the twin."""
    impossible: tuple[str, ...] = ()
    """Implausible values, each in a sentence; only for a twin whose values are not the axis's."""

    @property
    def values(self) -> Values:
        """Origin of its values: the axis, or only a replay."""
        return Values.of(self.truth) or Values.REPLAY

    @property
    def unexplained(self) -> tuple[Left, ...]:
        """Channels with residuals above their noise."""
        return tuple(each for each in self.left if each.times_noise > NOISE_LEVEL)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by path in the truth file; empty unless the values are the axis's."""
        return self.truth.intervals

    @property
    def provenance(self) -> dict[str, Any]:
        """Provenance of the truth."""
        return self.truth.provenance
