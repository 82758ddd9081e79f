"""Response of an axis to a correction in motion, and the filter that compensates for the response.

At rest the load follows a correction fully. In motion, servo, command filter and interpolation change its
amplitude and phase. `Response` contains the measured response and the filter weights derived from it;
`hdbridge.analysis.response` computes both.
"""

import math
from typing import Self

from pydantic import Field, model_validator

from hdbridge.strictness import Strict


class LeadFilter(Strict):
    """Filter of the correction along the path: weights of its future and past values, and of earlier outputs.

    Weight j applies to the correction of the load target ``lead_cycles - j / per_cycle`` cycles ahead.
    Feedback i, times the output i cycles earlier, is subtracted. The sum of the weights is 1 plus the sum of
    the feedback, so that the filter changes nothing at rest. Near standstill the filter is faded out, because
    its memory of the move would make the motor turn back.
    """

    lead_cycles: int = Field(ge=0, le=50, description="lead of the first weight, cycles")
    per_cycle: int = Field(ge=1, le=8, description="weights per cycle")
    full_speed_deg_s: float = Field(gt=0, description="load speed from which the filter acts fully")
    weights: tuple[float, ...] = Field(
        min_length=1, max_length=1000, description="weights; their sum is 1 plus the sum of feedback"
    )
    feedback: tuple[float, ...] = Field(
        default=(), max_length=2, description="weights of the last outputs, subtracted"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        first, second = (*self.feedback, 0.0, 0.0)[:2]
        if not abs(first) < 1.0 + second < 2.0:
            raise ValueError(
                f"the feedback {list(self.feedback)} makes the filter unstable; measure the response again"
            )
        found, wanted = math.fsum(self.weights), 1.0 + math.fsum(self.feedback)
        if not math.isclose(found, wanted, abs_tol=1e-6):
            raise ValueError(f"the weights sum to {found:.6g}; expected {wanted:.6g}")
        if (len(self.weights) - 1) % self.per_cycle:
            raise ValueError(
                f"{len(self.weights)} weights at {self.per_cycle} per cycle; "
                "expected a whole number of cycles and one"
            )
        return self


class Response(Strict):
    """Measured response of an axis to a correction; valid only for the servo gains of the measurement."""

    cycle_ms: float = Field(gt=0, description="SYNC period of the measurement")
    following_lag_ms: float = Field(description="lag of the motor behind its target at constant speed")
    known_to_hz: float = Field(gt=0, description="frequency up to which the correction is applied in full")
    frequency_hz: tuple[float, ...] = Field(description="measured frequencies, ascending")
    gain: tuple[float, ...] = Field(
        description="amplitude of the load per unit of correction, at each frequency"
    )
    phase_deg: tuple[float, ...] = Field(
        description="phase of the load against the correction, following lag included"
    )
    uncertainty: tuple[float, ...] = Field(
        description="half width of the 95 % interval, as a fraction of the gain"
    )
    load_gain: tuple[float, ...] = Field(
        default=(), description="amplitude of the load per unit of transmission error, without correction"
    )
    load_phase_deg: tuple[float, ...] = Field(default=(), description="its phase, following lag excluded")
    filter: LeadFilter = Field(description="filter of the correction, computed from the points")
    gain_objects: dict[str, int] = Field(
        default={},
        description="drive objects with servo gains, and their values",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        columns = (self.frequency_hz, self.gain, self.phase_deg, self.uncertainty)
        if not self.frequency_hz or len({len(each) for each in columns}) != 1:
            raise ValueError("expected frequency_hz, gain, phase_deg and uncertainty of the same length")
        if {len(self.load_gain), len(self.load_phase_deg)} not in ({0}, {len(self.frequency_hz)}):
            raise ValueError(
                "expected load_gain and load_phase_deg of the same length as frequency_hz, or neither"
            )
        return self

    def fits_cycle(self, cycle_s: float) -> bool:
        """Returns True if the filter was made for this SYNC period."""
        return math.isclose(self.cycle_ms, 1000.0 * cycle_s, rel_tol=1e-6)
