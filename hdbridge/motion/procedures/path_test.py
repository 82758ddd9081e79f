"""Path test: moves at the axis's limits in both directions, and a sine, each followed by a rest."""

import math
from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Dwell, MoveTo, Sample, Sine, Steps
from hdbridge.motion.procedures.standstill import Precondition
from hdbridge.units import DEG_PER_TURN

PRECONDITION_TURNS = 2.0
"""Travel before each path, in the direction of the path, motor turns. It exceeds the width of the gear's
hysteresis, so that the gear's elastic state at the start is always the same."""
SHORT_TURNS = 1.5
"""Length of the short moves, motor turns."""
EVEN_S = 0.3
"""Duration of motion at the speed limit in the long moves."""
SINE_HZ = 0.5
SINE_PERIODS = 3
SINE_SPEED = 0.4
"""Peak speed of the sine, relative to the speed limit."""
REST_S = 0.8
KIND = "path"


@dataclass(frozen=True, slots=True)
class PathRun:
    """Samples of one path and of the rest after it."""

    name: str
    samples: tuple[Sample, ...]
    rest: tuple[Sample, ...]
    skipped: int = 0
    """Number of initial samples that are not evaluated."""


@dataclass(frozen=True, slots=True)
class PathTest:
    """Runs a long and a short move, each forward and back, and a sine, about the middle of the travel."""

    def moves(self, axis: AxisView) -> Steps[tuple[PathRun, ...]]:
        """Yields each path, preceded by a run-up in the path's direction."""
        limits = axis.limits
        travel_deg = limits.position_max_deg - limits.position_min_deg
        middle = limits.position_min_deg + 0.5 * travel_deg
        run_up_deg = min(PRECONDITION_TURNS * DEG_PER_TURN / axis.ratio, 0.1 * travel_deg)
        room_deg = 0.98 * travel_deg - 2.0 * run_up_deg
        ramp_s = limits.velocity_deg_s / limits.acceleration_deg_s2
        ramp_s += limits.acceleration_deg_s2 / limits.jerk_deg_s3
        far_deg = min(limits.velocity_deg_s * (ramp_s + EVEN_S), room_deg)
        short_deg = min(SHORT_TURNS * DEG_PER_TURN / axis.ratio, far_deg)
        runs: list[PathRun] = []
        for name, distance_deg in (("long move", far_deg), ("short move", short_deg)):
            for sign in (1.0, -1.0):
                begin, end = middle - sign * 0.5 * distance_deg, middle + sign * 0.5 * distance_deg
                yield from Precondition(begin, sign * run_up_deg).moves(axis)
                yield Dwell(REST_S, kind="precondition")
                samples = yield MoveTo(end, kind=KIND)
                rest = yield Dwell(REST_S, kind=KIND)
                runs.append(PathRun(f"{name} {'forward' if sign > 0.0 else 'back'}", (*samples,), (*rest,)))
        omega = math.tau * SINE_HZ
        speed = min(SINE_SPEED * limits.velocity_deg_s, limits.acceleration_deg_s2 / omega)
        amplitude_deg = min(speed / omega, 0.5 * room_deg)
        yield from Precondition(middle + amplitude_deg, run_up_deg).moves(axis)
        yield Dwell(REST_S, kind="precondition")
        samples = yield Sine(middle, amplitude_deg, SINE_HZ, SINE_PERIODS, kind=KIND)
        rest = yield Dwell(REST_S, kind=KIND)
        # The first period is not evaluated, because a sine begins with a step of the acceleration.
        runs.append(PathRun("sine", (*samples,), (*rest,), len(samples) // SINE_PERIODS))
        return tuple(runs)
