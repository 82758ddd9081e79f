"""Simulated axis without a bus, whose master sends whole counts each cycle."""

import math
from pathlib import Path
from typing import Any

import ruckig

from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from support.keys import changed

PROFILES = Path(__file__).parents[2] / "profiles"
CYCLE_S = 0.004
DEG_PER_COUNT = 360.0 / 8000.0
STEP_COUNTS = 968


def truth(profile: str = "article", **changes: Any) -> Truth:
    """Returns the truth of a profile's axis with changed values; keys are like ``gear__ratio``."""
    return changed(Truth.load(PROFILES / profile), **changes)


def trajectory(distance_counts: int) -> list[int]:
    """Returns a jerk-limited move in whole counts per cycle, within the limits of the article's axis file."""
    otg = ruckig.Ruckig(1, CYCLE_S)
    way, out = ruckig.InputParameter(1), ruckig.OutputParameter(1)
    way.current_position = way.current_velocity = way.current_acceleration = [0.0]
    way.target_position = [float(distance_counts)]
    counts_per_load_deg = 50.0 / DEG_PER_COUNT
    way.max_velocity = [20.0 * counts_per_load_deg]
    way.max_acceleration = [200.0 * counts_per_load_deg]
    way.max_jerk = [4000.0 * counts_per_load_deg]
    positions = []
    while True:
        result = otg.update(way, out)
        positions.append(round(out.new_position[0]))
        if result != ruckig.Result.Working:
            return positions
        out.pass_to_input(way)


class Axis:
    """Simulated axis with a master that sends a target in whole counts every cycle."""

    def __init__(self, known: Truth, seed: int = 1) -> None:
        self.machine = Machine(known, seed)
        self.target = 0
        self.overshoot_deg = 0.0
        self.loads_deg: list[float] = []
        """Load angle after each cycle of the last move."""
        self.substeps = round(CYCLE_S / self.machine.dt_s)

    def move(self, distance_counts: int, settle_s: float = 0.3) -> None:
        """Moves by whole counts, and waits."""
        start, sense = self.target, math.copysign(1.0, distance_counts)
        end_deg = (start + distance_counts) * DEG_PER_COUNT
        self.overshoot_deg = 0.0
        self.loads_deg.clear()
        for position in trajectory(distance_counts) + [distance_counts] * round(settle_s / CYCLE_S):
            self.to(start + position)
            self.loads_deg.append(self.machine.true_load_deg)
            over_deg = sense * (self.machine.true_motor_deg - end_deg)
            self.overshoot_deg = max(self.overshoot_deg, over_deg)

    def to(self, target: int) -> None:
        """Runs one cycle."""
        self.machine.follow(self.target, target, self.substeps)
        self.target = target

    def hold(self, time_s: float) -> None:
        for _ in range(round(time_s / CYCLE_S)):
            self.to(self.target)

    @property
    def error_arcsec(self) -> float:
        """Returns the load error at the target."""
        return (self.machine.true_load_deg - self.target * DEG_PER_COUNT / 50.0) * 3600.0


def static_arcsec(known: Truth, motor_deg: float, direction: int) -> float:
    """Returns the error by the article's Tables 1 and 2 after long motion in one direction, arcsec."""
    law: Any = known.gear.hysteresis
    tooth = (
        each.amplitude_arcsec * math.cos(math.radians(each.order * motor_deg + each.phase_deg))
        for each in known.gear.motor_orders
    )
    return math.fsum(tooth) + direction * float(law.offset_arcsec)
