"""Measures accuracy and cost of the simulated axis alone, for docs/how-well.md.

.venv/bin/python tools/plant_figures.py [--steps 240]
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from pathlib import Path

import ruckig

from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import RollingFriction, Truth

PROFILES = Path(__file__).parents[1] / "profiles"
CYCLE_S = 0.004
STEP_COUNTS = 968
DEG_PER_COUNT = 360.0 / 8000.0


def trajectory() -> list[int]:
    """Returns the set-points of a step of 43.56 motor deg, in counts per cycle, within the axis limits."""
    otg = ruckig.Ruckig(1, CYCLE_S)
    way, out = ruckig.InputParameter(1), ruckig.OutputParameter(1)
    way.current_position = way.current_velocity = way.current_acceleration = [0.0]
    way.target_position = [float(STEP_COUNTS)]
    counts_per_load_deg = 50.0 / DEG_PER_COUNT
    way.max_velocity = [20.0 * counts_per_load_deg]
    way.max_acceleration = [200.0 * counts_per_load_deg]
    way.max_jerk = [4000.0 * counts_per_load_deg]
    positions = []
    while otg.update(way, out) == ruckig.Result.Working:
        positions.append(round(out.new_position[0]))
        out.pass_to_input(way)
    return [*positions, STEP_COUNTS]


def static_arcsec(truth: Truth, motor_deg: float, direction: int) -> float:
    """Returns tooth error plus saturated hysteresis, the transmission error in the limit of slow motion."""
    assert isinstance(truth.gear.hysteresis, RollingFriction)
    tooth = (
        each.amplitude_arcsec * math.cos(math.radians(each.order * motor_deg + each.phase_deg))
        for each in truth.gear.motor_orders
    )
    return math.fsum(tooth) + direction * truth.gear.hysteresis.offset_arcsec


def step_test(truth: Truth, steps: int) -> str:
    """Runs a stepping test in both directions with 0.3 s of settling; returns one row of the table."""
    machine = Machine(truth, 1)
    substeps = round(CYCLE_S / machine.dt_s)
    move = trajectory()
    position, cycles, spent_s = 0, 0, 0.0
    measured: dict[int, list[float]] = {1: [], -1: []}
    off_law, overshoots, settled = [], [], []
    for direction in (1, -1):
        for step in range(steps + 1):
            goal = position + direction * STEP_COUNTS
            ends, over = [], 0.0
            began_s = time.perf_counter()
            last = position
            for point in move + [STEP_COUNTS] * 75:
                target = position + direction * point
                machine.follow(last, target, substeps)
                last = target
                over = max(over, direction * (machine.true_motor_deg - goal * DEG_PER_COUNT))
                ends.append(machine.true_load_deg)
            spent_s += time.perf_counter() - began_s
            cycles += len(ends)
            position = goal
            if step == 0:
                continue  # the pre-conditioning move
            nominal_deg = goal * DEG_PER_COUNT / truth.gear.ratio
            measured[direction].append((machine.load_counts / 8000.0 - nominal_deg) * 3600.0)
            true_arcsec = (machine.true_load_deg - nominal_deg) * 3600.0
            off_law.append(true_arcsec - static_arcsec(truth, goal * DEG_PER_COUNT, direction))
            overshoots.append(over)
            apart = [i for i, deg in enumerate(ends) if abs(deg - ends[-1]) * 3600.0 > 0.3]
            settled.append((apart[-1] + 2 - len(move)) * CYCLE_S)
    columns = [
        f"{3 * statistics.pstdev(rows):.1f} / {statistics.fmean(rows):.2f}"
        for rows in (measured[1], measured[-1], measured[1] + measured[-1])
    ]
    rms = math.sqrt(statistics.fmean(each * each for each in off_law))
    columns += [
        f"{rms:.3f} / {max(map(abs, off_law)):.3f}",
        f"{max(overshoots):.4f}",
        f"{1e3 * max(settled):.0f}",
        f"{1e6 * spent_s / cycles:.0f}",
    ]
    return " | ".join(columns)


def main() -> None:
    """Prints the table of the documentation."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--steps", type=int, default=240, help="steps each way")
    steps = parser.parse_args().steps
    print(
        "| axis | substep, ms | CW: 3 sigma / mean | CCW | pooled | off the static law: rms / max, arcsec "
        "| overshoot, motor deg | settled to 0.3 arcsec, ms | us per 4 ms cycle |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for profile in ("article", "demo"):
        for substep_ms in (1.0, 0.5, 0.25):
            truth = Truth.load(PROFILES / profile).model_copy(update={"substep_ms": substep_ms})
            print(f"| {profile} | {substep_ms:g} | {step_test(truth, steps)} |", flush=True)


if __name__ == "__main__":
    main()
