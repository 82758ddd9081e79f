"""Result of a calibration: the fit, the validation, and the offer for commit."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hdbridge.analysis.identification import FitResult
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.difference import diff
from hdbridge.commissioning.calibration.motion import MotionTest
from hdbridge.commissioning.calibration.validation import Stepped, Validation
from hdbridge.units import unit_of

__all__ = ["Calibration", "Offer", "Stepped"]


@dataclass(frozen=True, slots=True)
class Offer:
    """Decision to offer a model for commit, with its reason."""

    made: bool
    reason: str
    pending: Path | None = None
    """File of the pending model."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of a calibration, or of a fit to recordings alone (then without validation and offer)."""

    recordings: tuple[str, ...]
    fit: FitResult
    model: TransmissionModel
    """Model, with its provenance."""
    active: TransmissionModel | None
    """Model that it is compared with."""
    axis: str | None = None
    date: str | None = None
    """Date and time of the recording, ISO 8601."""
    plan: str | None = None
    shortened: tuple[str, ...] = ()
    """Parts of the plan that were shortened for this axis, in words."""
    validation: Validation | None = None
    motion: MotionTest | None = None
    """Motion test, which measures the response; None if the plan has none."""
    drift: tuple[tuple[float, float], ...] = ()
    """Time (s) and error (arcsec, relative to the first) of each visit to the reference pose."""
    offer: Offer | None = None

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``--json``, schema ``hdbridge.calibration/1``."""
        fit, held_out = self.fit, self.fit.held_out
        return {
            "schema": "hdbridge.calibration/1",
            "axis": self.axis,
            "recordings": list(self.recordings),
            "date": self.date,
            "plan": self.plan,
            "shortened": list(self.shortened),
            "ratio": self.model.ratio,
            "offered": self.offer.made if self.offer else None,
            "reason": self.offer.reason if self.offer else None,
            "pending": str(self.offer.pending) if self.offer and self.offer.pending else None,
            "parameters": [
                {
                    "effect": each.effect,
                    "parameter": each.parameter,
                    "value": _number(each.value),
                    "unit": unit_of(each.parameter),
                    "ci95": [_number(each.value - each.half_width), _number(each.value + each.half_width)],
                    "identifiable": each.identifiable,
                }
                for each in fit.intervals
            ],
            "changes": [
                {name: getattr(each, name) for name in ("effect", "parameter", "before", "after")}
                for each in (diff(self.active, self.model) if self.active else [])
                if each.changed
            ],
            "orders": [
                {
                    "order": str(each.order),
                    "amplitude_arcsec": each.amplitude_arcsec,
                    "fall_in_chi_square": each.fall_in_chi_square,
                    "threshold": each.threshold,
                }
                for each in fit.orders
            ],
            "beside_the_model": [
                {
                    "name": each.name,
                    "value": each.value,
                    "half_width": _number(each.half_width),
                    "unit": each.unit,
                }
                for each in fit.nuisances
            ],
            "noise": asdict(fit.noise),
            "held_out": {
                "before_arcsec": held_out.gain.before_arcsec if held_out.gain else None,
                "after_arcsec": held_out.gain.after_arcsec if held_out.gain else None,
                "fitted_arcsec": _number(held_out.fitted_arcsec),
                "over": held_out.gain.over if held_out.gain else None,
                "folds": held_out.gain.folds if held_out.gain else 0,
                "improves": held_out.improves,
                "text": held_out.text,
            },
            "residual_tests": [
                {**asdict(each), "size_arcsec": _number(each.size_arcsec)} for each in fit.residual_tests
            ],
            "outliers": {"samples": fit.outliers.samples, "longest_run": fit.outliers.longest_run},
            "warnings": list(fit.warnings),
            "drift": [{"time_s": time_s, "error_arcsec": error} for time_s, error in self.drift],
            "stepping": self.validation.as_dict() if self.validation else None,
            "motion": self.motion.as_dict() if self.motion else None,
        }


def _number(value: float) -> float | None:
    """Returns the number; None if it is not finite, because JSON has no infinity."""
    return float(value) if math.isfinite(value) else None
