"""What a model gains on data that its fit has not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray

SURE = 2.0
"""Standard errors by which the fall must be more than nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Squares that stretches of a record leave, each left out of the fit that is judged on it.

    Only a hold-out knows them: two root mean squares of one fit make no gain. Arrays of shape (stretches,).
    """

    over: str
    """What was left out at a time, in words: motor turns, stretches of time, recordings."""
    folds: int
    """So many fits were made, each without a part of the record."""
    samples: FloatArray
    """Weight of each stretch."""
    before_arcsec2: FloatArray
    """Sum of squares without what is judged, or with what it is compared with."""
    after_arcsec2: FloatArray
    """... and with it."""

    @property
    def before_arcsec(self) -> float:
        """Root mean square without it."""
        return math.sqrt(float(np.sum(self.before_arcsec2)) / float(np.sum(self.samples)))

    @property
    def after_arcsec(self) -> float:
        """Root mean square with it."""
        return math.sqrt(float(np.sum(self.after_arcsec2)) / float(np.sum(self.samples)))

    @property
    def recovered(self) -> float:
        """Share of the mean square that it takes away; negative where it makes things worse."""
        return 1.0 - (self.after_arcsec / max(self.before_arcsec, 1e-12)) ** 2

    @property
    def sure(self) -> bool:
        """Whether the squares fall by more than chance from one stretch to another."""
        fall = self.before_arcsec2 - self.after_arcsec2
        if len(fall) < 2:
            return False
        return float(np.mean(fall)) > SURE * float(np.std(fall, ddof=1)) / math.sqrt(len(fall))

    def as_dict(self) -> dict[str, float | str]:
        """For the provenance of a model file."""
        return {
            "over": self.over,
            "before_arcsec": self.before_arcsec,
            "after_arcsec": self.after_arcsec,
        }
