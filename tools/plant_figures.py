"""Measures accuracy and cost of the simulated axis alone, for docs/how-well.md.

.venv/bin/python tools/plant_figures.py [--steps 240]
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.bare_axis import CYCLE_S, DEG_PER_COUNT, STEP_COUNTS, Axis, static_arcsec, trajectory, truth

from hdbridge.sim.truth import Truth


def step_test(known: Truth, steps: int) -> str:
    """Runs a stepping test in both directions with 0.3 s of settling; returns one row of the table."""
    axis, moving = Axis(known), len(trajectory(STEP_COUNTS))
    cycles, spent_s = 0, 0.0
    measured: dict[int, list[float]] = {1: [], -1: []}
    off_law, overshoots, settled = [], [], []
    for direction in (1, -1):
        for step in range(steps + 1):
            began_s = time.perf_counter()
            axis.move(direction * STEP_COUNTS)
            spent_s += time.perf_counter() - began_s
            ends = axis.loads_deg
            cycles += len(ends)
            if step == 0:
                continue  # the pre-conditioning move
            motor_deg = axis.target * DEG_PER_COUNT
            measured[direction].append((axis.machine.load_counts / 8000.0 - motor_deg / 50.0) * 3600.0)
            off_law.append(axis.error_arcsec - static_arcsec(known, motor_deg, direction))
            overshoots.append(axis.overshoot_deg)
            apart = [i for i, deg in enumerate(ends) if abs(deg - ends[-1]) * 3600.0 > 0.3]
            settled.append((apart[-1] + 2 - moving) * CYCLE_S)
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
            row = step_test(truth(profile, substep_ms=substep_ms), steps)
            print(f"| {profile} | {substep_ms:g} | {row} |", flush=True)


if __name__ == "__main__":
    main()
