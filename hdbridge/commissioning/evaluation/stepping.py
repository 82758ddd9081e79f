"""Results of a stepping test: scatter and mean per direction and pooled, and the quantisation floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

if TYPE_CHECKING:
    from hdbridge.motion.procedures.stepping import SteppingOutcome


@dataclass(frozen=True, slots=True)
class Scatter:
    """Three standard deviations and the mean of a set of errors at rest, arcsec."""

    three_sigma_arcsec: float
    mean_arcsec: float

    @classmethod
    def of(cls, errors_arcsec: Sequence[float]) -> Scatter:
        """Uses the population standard deviation for 3 sigma, as is usual in the literature."""
        errors = np.asarray(errors_arcsec)
        return cls(3.0 * float(np.std(errors)), float(np.mean(errors)))


@dataclass(frozen=True, slots=True)
class Stepped:
    """Result of a stepping test with one model or scheme."""

    model: str
    """Description of the model, or the scheme."""
    errors_arcsec: tuple[tuple[float, ...], tuple[float, ...]]
    """Error at rest after each step, outward and back."""
    targets_deg: tuple[tuple[float, ...], tuple[float, ...]]

    @classmethod
    def of(cls, model: str, outcome: SteppingOutcome) -> Stepped:
        """Creates the result from the procedure's outcome."""
        cw, ccw = outcome.cw, outcome.ccw
        return cls(
            model,
            (tuple(each.error_arcsec for each in cw), tuple(each.error_arcsec for each in ccw)),
            (tuple(each.target_deg for each in cw), tuple(each.target_deg for each in ccw)),
        )

    @property
    def cw(self) -> Scatter:
        """Scatter of the outward steps."""
        return Scatter.of(self.errors_arcsec[0])

    @property
    def ccw(self) -> Scatter:
        """Scatter of the return steps."""
        return Scatter.of(self.errors_arcsec[1])

    @property
    def pooled(self) -> Scatter:
        """Scatter of both directions together."""
        return Scatter.of(sum(self.errors_arcsec, ()))

    @property
    def scatter(self) -> dict[str, dict[str, float]]:
        """Three sigma and mean, arcsec, of each direction and of both directions pooled."""
        return {name: asdict(getattr(self, name)) for name in ("cw", "ccw", "pooled")}

    def as_dict(self) -> dict[str, Any]:
        """Returns plain data for `hdbridge.commissioning.calibration.Validation.from_dict`."""
        return {**asdict(self), **self.scatter}


def quantisation_floor_arcsec(motor_counts_per_turn: float, ratio: float) -> float:
    """Returns three sigma at the load due to rounding motor targets to whole counts (uniform distribution).

    Compensation by motor targets cannot be more accurate, however good its model.
    """
    count = DEG_PER_TURN * ARCSEC_PER_DEG / (motor_counts_per_turn * ratio)
    return 3.0 * count / math.sqrt(12.0)
