"""Plausibility of a cycle's positions, and the following error. Pure.

If an encoder moves further in a cycle than the axis can, its reading is rejected and the last good reading is
kept, so that one glitch costs one cycle. The drive's following error is checked here as well as by the drive
itself (6065h and 6066h).
"""

from dataclasses import dataclass
from typing import Final, Self

from hdbridge.axis import AxisConfig
from hdbridge.units import ARCSEC_PER_DEG

OVERSPEED: Final = 1.5
"""Factor by which a quick stop, an overshoot or a resonance may exceed the axis's velocity limit."""
FLOOR_ARCSEC: Final = 180.0
"""Load movement that vibration and noise may cause, whatever the axis's velocity limit."""


@dataclass(frozen=True, slots=True)
class Plausibility:
    """Limits of the movement within one cycle, in encoder counts."""

    motor_floor_counts: float
    motor_step_counts: float
    """Maximum movement of the motor encoder per cycle, in addition to ``motor_floor_counts``."""
    load_floor_counts: float
    load_step_counts: float
    """Maximum movement of the load encoder per cycle, in addition to ``load_floor_counts``."""
    following_counts: float
    """Maximum difference between the motor position and the drive's demand."""

    @classmethod
    def of(cls, axis: AxisConfig) -> Self:
        """Derives the limits from an axis file."""
        step_deg = OVERSPEED * axis.limits.velocity_deg_s * axis.drive.cycle_s
        floor_deg = FLOOR_ARCSEC / ARCSEC_PER_DEG
        motor, load, ratio = axis.motor_encoder, axis.load_encoder, axis.gear.ratio
        return cls(
            motor_floor_counts=abs(motor.counts(floor_deg * ratio)) + 2.0,
            motor_step_counts=abs(motor.counts(step_deg * ratio)),
            load_floor_counts=abs(load.counts(floor_deg)) + 2.0,
            load_step_counts=abs(load.counts(step_deg)),
            following_counts=abs(motor.counts(axis.drive.following_error_deg)),
        )

    def jump(self, motor_counts: int, load_counts: int, cycles: int) -> str | None:
        """Returns a description of an implausible movement over ``cycles`` cycles, or None."""
        allowed = self.motor_floor_counts + cycles * self.motor_step_counts
        if not -allowed <= motor_counts <= allowed:
            return f"motor encoder: {motor_counts:+d} counts, at most {allowed:.0f} are possible"
        allowed = self.load_floor_counts + cycles * self.load_step_counts
        if not -allowed <= load_counts <= allowed:
            return f"load encoder: {load_counts:+d} counts, at most {allowed:.0f} are possible"
        return None

    def lag(self, error_counts: int) -> str | None:
        """Returns a description of an excessive following error (demand minus actual), or None."""
        if -self.following_counts <= error_counts <= self.following_counts:
            return None
        return f"{error_counts:+d} motor counts, allowed are {self.following_counts:.0f}"
