"""Runs at constant speed in both directions, which measure ripple and response of the axis in motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import AxisView, MoveTo, Sample, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive
from hdbridge.units import DEG_PER_TURN

SHARES = (0.95, 0.8, 0.64, 0.5, 0.38, 0.28, 0.18, 0.08)
"""Speeds of the default test, relative to the speed limit. At the limit itself a drive would clip the
correction."""
WINDOW_S = 1.0
TURNS = 3.0
"""Minimum travel of a run at constant speed, motor turns."""
TRANSIENT_S = 0.6
"""Duration of constant speed before the evaluated samples, in which the transient decays."""
KIND = "even speed"


@dataclass(frozen=True, slots=True)
class EvenRun:
    """Samples of one run at constant speed."""

    speed_deg_s: float
    """Load speed; negative in backward motion."""
    samples: tuple[Sample, ...]


@dataclass(frozen=True, slots=True)
class EvenSpeed(Checked):
    """Runs an axis at several constant speeds about the middle of the travel, in both directions."""

    speeds_deg_s: tuple[Positive, ...]
    window_s: Positive = WINDOW_S

    @classmethod
    def spread(cls, axis: AxisView, shares: Sequence[float] = SHARES) -> Self:
        """Returns a test with speeds that are ``shares`` of the highest speed for which the travel suffices.

        Raises `InputError` if the travel is too short for any run.
        """
        limits = axis.limits
        fastest = limits.velocity_deg_s
        travel_deg = limits.position_max_deg - limits.position_min_deg
        while cls((fastest,)).travel_deg(axis, fastest) > 0.98 * travel_deg:
            fastest *= 0.95
            if TURNS * DEG_PER_TURN / axis.ratio > 0.98 * travel_deg:
                raise InputError(
                    f"the travel of {travel_deg:g} deg is too short for a run of {TURNS:g} motor turns at "
                    "constant speed: widen position_min_deg and position_max_deg in the axis file"
                )
        return cls(tuple(round(share * fastest, 3) for share in shares))

    def travel_deg(self, axis: AxisView, speed_deg_s: float) -> float:
        """Returns the travel of one run, including its ramps, load degrees."""
        limits = axis.limits
        ramp_s = speed_deg_s / limits.acceleration_deg_s2 + limits.acceleration_deg_s2 / limits.jerk_deg_s3
        even_deg = max(self.window_s * speed_deg_s, TURNS * DEG_PER_TURN / axis.ratio)
        return even_deg + speed_deg_s * (TRANSIENT_S + ramp_s)

    def moves(self, axis: AxisView) -> Steps[tuple[EvenRun, ...]]:
        """Yields a forward and a backward run at each speed."""
        runs: list[EvenRun] = []
        middle = axis.limits.middle_deg
        for speed in self.speeds_deg_s:
            half = 0.5 * self.travel_deg(axis, speed)
            yield MoveTo(middle - half)
            for sign in (1.0, -1.0):
                samples = yield MoveTo(middle + sign * half, speed, kind=KIND)
                runs.append(EvenRun(sign * speed, _even(samples, sign * speed)))
        return tuple(runs)


def _even(samples: Sequence[Sample], speed_deg_s: float) -> tuple[Sample, ...]:
    """Returns the samples at constant speed, except those in the initial transient."""
    cycle_s = (samples[-1].time_s - samples[0].time_s) / (len(samples) - 1)
    step = speed_deg_s * cycle_s
    even = [
        place
        for place in range(1, len(samples))
        if abs(samples[place].load_target_deg - samples[place - 1].load_target_deg - step) < 1e-3 * abs(step)
    ]
    if not even:
        return ()
    first = even[0] + round(TRANSIENT_S / cycle_s)
    return tuple(samples[first : even[-1] + 1])
