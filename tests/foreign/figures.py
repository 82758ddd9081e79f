"""Figures of the foreign axes: `PYTHONPATH=tests python -m foreign.figures [SEEDS]`.

Per structure: rejected draws; simulated seconds per processor second, of the machine alone and of a stepping
test over the bus; and the share of the load's ripple at even speed that a correction of the tooth error
removes, per cent, median (worst). The corrections are the exact static one, and the one whose orders below a
third of the SYNC rate are divided by the response.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from foreign.bench import bench_of
from foreign.draw import Truth, draw
from foreign.response import load_response
from foreign.servos import STRUCTURES

from hdbridge import Bench, Drive, Stepping

SPEEDS_DEG_S = (5.0, 20.0, 38.0, 60.0, 76.0, 100.0)


def ripple_arcsec(truth: Truth, speed_deg_s: float, correction: np.ndarray) -> float:
    """Rms of the load about a straight line; ``correction`` is complex, load arcsec for each motor order."""
    machine, ratio, cycle_s = truth.machine(), truth.mechanics.ratio, truth.cycle_ms / 1000.0
    counts, before, load_deg, line = truth.encoders.motor_counts_per_turn, 0, [], []
    watch_s = max(2.0, 720.0 / ratio / speed_deg_s)
    for at in range(1, round((1.5 + watch_s) / cycle_s)):
        time_s = at * cycle_s
        path_deg = speed_deg_s * (time_s**2 if time_s < 0.5 else time_s - 0.25)
        turns = np.exp(
            1j * math.radians(path_deg * ratio) * np.array([o.order for o in truth.mechanics.motor_orders])
        )
        motor_deg = ratio * (path_deg + float((correction * turns).real.sum()) / 3600.0)
        target = round(motor_deg / 360.0 * counts)
        machine.follow(before, target, round(cycle_s / machine.dt_s))
        before = target
        if time_s > 1.5:
            load_deg.append(machine.true_load_deg)
            line.append(path_deg)
    error = np.array(load_deg) - np.polyval(np.polyfit(line, load_deg, 1), line)
    return float(error.std() * 3600.0)


def removed_percent(truth: Truth, speed_deg_s: float) -> tuple[float, float]:
    """Figures of the static correction, and of the one filtered by the response."""
    orders = truth.mechanics.motor_orders
    frequency_hz = np.array([o.order for o in orders]) * speed_deg_s * truth.mechanics.ratio / 360.0
    error = np.array([o.amplitude_arcsec * np.exp(1j * math.radians(o.phase_deg)) for o in orders])
    slow_hz = 0.05  # at even speed the whole motion lags, and the tooth error with it
    late_s = -np.angle(truth.response(np.array([slow_hz])))[0] / (math.tau * slow_hz)
    in_step = truth.response(frequency_hz) * np.exp(1j * math.tau * frequency_hz * late_s)
    path = load_response(truth.mechanics, frequency_hz) * in_step
    filtered = np.where(
        frequency_hz < 1000.0 / truth.cycle_ms / 3.0, -error * truth.ripple(frequency_hz) / path, 0.0
    )
    none = ripple_arcsec(truth, speed_deg_s, np.zeros(len(orders)))
    static, best = (ripple_arcsec(truth, speed_deg_s, each) for each in (-error, filtered))
    return 100.0 * (1.0 - static / none), 100.0 * (1.0 - best / none)


def times_real_time(truth: Truth) -> tuple[float, float]:
    """Simulated per processor second, the machine alone and over the bus."""
    machine, cycle_s = truth.machine(), truth.cycle_ms / 1000.0
    start = time.process_time()
    for _ in range(round(4.0 / cycle_s)):
        machine.follow(0, 0, round(cycle_s / machine.dt_s))
    alone = 4.0 / (time.process_time() - start)
    with (
        tempfile.TemporaryDirectory() as folder,
        bench_of(truth, Path(folder)) as bench,
        Drive(bench.bus, bench.axis, bench.clock) as drive,
    ):
        drive.boot()
        start, from_s = time.process_time(), bench.clock.now()
        Bench(drive).run(Stepping(count=12))
        return alone, (bench.clock.now() - from_s) / (time.process_time() - start)


def main(seeds: int) -> None:
    for structure in STRUCTURES:
        axes = [draw(seed, structure) for seed in range(seeds)]
        times_real_time(axes[0])
        speeds = np.array([times_real_time(axis) for axis in axes])
        machine, bench = np.median(speeds, axis=0)
        print(f"{structure}: {seeds} axes, {sum(axis.rejected for axis in axes)} draws rejected")
        print(f"  times real time: machine {machine:.0f}, bench {bench:.0f} (least {speeds[:, 1].min():.0f})")
        for speed in SPEEDS_DEG_S:
            removed = np.array(
                [removed_percent(axis, speed) for axis in axes if axis.velocity_deg_s >= speed]
            ).T
            cells = [f"{np.median(each):.0f} ({each.min():.0f})" for each in removed]
            print(f"  {speed:.0f} deg/s: static {cells[0]}, by the response {cells[1]}")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
