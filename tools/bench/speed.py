"""How much faster than the axis itself the bench on the virtual bus is: `python tools/bench/speed.py`.

One run measures, side by side: the whole bench (master, compensation, bus, simulated drive and plant), and
the plant alone, moved along the same targets. Ratios are axis time over this process's time.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise

from hdbridge.axis import AxisConfig
from hdbridge.bench import Bench, compensation_for
from hdbridge.bundled import bundled_profile
from hdbridge.drive.drive import Drive
from hdbridge.model import TransmissionModel
from hdbridge.procedures.stepping import Stepping
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="steps each way")
    parser.add_argument("--blocks", type=int, default=3, help="repetitions; the median is printed")
    options = parser.parse_args()
    folder = bundled_profile("article")
    axis, model = AxisConfig.load(folder / "axis.yaml"), TransmissionModel.load(folder / "model.yaml")
    truth = Truth.load(folder / "truth.yaml")
    whole, alone = [], []
    for block in range(options.blocks):
        with (
            simulated_bench(truth, axis.eds_path, axis.drive.node_id, block) as (bus, clock, _),
            Drive(bus, axis, clock) as drive,
        ):
            drive.boot()
            bench = Bench(drive, compensation_for(axis, model))
            began, axis_began = time.perf_counter(), clock.now()
            run = bench.run(Stepping(count=options.count))
            wall, axis_time = time.perf_counter() - began, clock.now() - axis_began
        whole.append(wall / axis_time)
        targets = (run.record.columns["motor_target_deg"] * axis.motor_encoder.counts_per_turn / 360).tolist()
        machine = Machine(truth, block)
        substeps = round(axis.drive.cycle_s / machine.dt_s)
        began = time.perf_counter()
        for last, target in pairwise(targets):
            machine.follow(last, target, substeps)
        alone.append((time.perf_counter() - began) / ((len(targets) - 1) * axis.drive.cycle_s))
    for name, shares in (("whole bench", whole), ("plant alone", alone)):
        share = sorted(shares)[len(shares) // 2]
        cycle_us = share * axis.drive.cycle_s * 1e6
        print(f"{name:>12}: {1 / share:6.1f} x real time, {cycle_us:6.1f} us per cycle")


if __name__ == "__main__":
    main()
