"""What `fit_twin` gives: the simulated drive's parameters, how sure they are, and what was wrong before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hdbridge.sim.truth import Truth
from hdbridge.twin.comparison import Comparison
from hdbridge.twin.naming import Alike, Finding, Unexplained

HELD_OUT = "held out"
"""The kind of leg that stands for those held out in a comparison."""


@dataclass(frozen=True)
class Twin:
    """A simulated drive that has learnt an axis."""

    truth: Truth
    """With the intervals of what was fitted, and in its provenance what `check` needs."""
    findings: tuple[Finding, ...]
    """What was wrong with the simulation that the fit began with."""
    alike: tuple[Alike, ...]
    """Parameters that the recordings' motion cannot tell apart."""
    unexplained: tuple[Unexplained, ...]
    """What is left beyond the noise."""
    before: Comparison
    """The recordings against the simulation that the fit began with; the kind `HELD_OUT` is of legs that the
    fit has not seen."""
    after: Comparison
    """The same against the twin."""

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by the place in the truth file."""
        return self.truth.intervals

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the values come from."""
        return self.truth.provenance
