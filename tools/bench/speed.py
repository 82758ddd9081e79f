"""Speed of the bench on the virtual bus, relative to the axis itself: `python tools/bench/speed.py`.

One run measures, side by side: the whole bench (master, compensation, bus, simulated drive and plant), the
same with load torque and temperature on the bus and compliance in the model, and the plant alone, moved along
the same targets. Ratios are axis time over wall time, and over this process's
CPU time, which does not count what other programs take of the machine. Where numba is installed the loops and
mechanics are compiled, which is done before anything is timed; ``--python`` keeps them in Python.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from itertools import pairwise

from hdbridge.axis import AxisConfig, LoadTorque, Temperature
from hdbridge.axis.channels import ChannelSource
from hdbridge.axis.effects import Compliance, extended
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import Bench, compensation_for
from hdbridge.drive.drive import Drive
from hdbridge.files.bundled import bundled_profile
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.sim import fast
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth


def clocks() -> tuple[float, float]:
    """Returns wall time and CPU time of this process, s."""
    return time.perf_counter(), time.process_time()


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description="How much faster than the axis itself the bench is.")
    parser.add_argument("--count", type=int, default=40, help="steps each way")
    parser.add_argument("--blocks", type=int, default=3, help="repetitions; the median is printed")
    parser.add_argument("--python", action="store_true", help="keep the loops and mechanics in Python")
    options = parser.parse_args()
    folder = bundled_profile("article")
    axis, model = AxisConfig.load(folder / "axis.yaml"), TransmissionModel.load(folder / "model.yaml")
    truth = Truth.load(folder / "truth.yaml")
    period_s = axis.drive.cycle_s
    if options.python:
        os.environ[fast.SWITCH] = "0"
    fast.waiting.left = 0
    Machine(truth, 0, may_compile=True).follow(0.0, 0.0, 1)
    told = {
        "load_torque": LoadTorque(
            source=ChannelSource(index=0x2101, type="int32"), newton_metres_per_count=0.001
        ),
        "temperature": Temperature(source=ChannelSource(index=0x2100, type="int16"), celsius_per_count=0.1),
    }
    knowing = axis.model_copy(update=told)
    longer = replace(model, effects=extended(model.effects, Compliance.candidate(model.ratio)))
    benches = {"whole bench": (axis, model), "with torque and temperature": (knowing, longer)}
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in (*benches, "plant alone")}

    def note(name: str, began: tuple[float, float], axis_s: float) -> None:
        wall, cpu = (after - before for before, after in zip(began, clocks(), strict=True))
        spent[name].append((wall / axis_s, cpu / axis_s))

    for block in range(options.blocks):
        for name, (config, compensated) in benches.items():
            with (
                simulated_bench(truth, axis.eds_path, axis.drive.node_id, block) as (bus, clock, _),
                Drive(bus, config, clock) as drive,
            ):
                drive.boot()
                bench = Bench(drive, compensation_for(config, compensated))
                began, axis_began = clocks(), clock.now()
                run = bench.run(Stepping(count=options.count))
                note(name, began, clock.now() - axis_began)
        targets = (run.record.columns["motor_target_deg"] * axis.motor_encoder.counts_per_turn / 360).tolist()
        machine = Machine(truth, block, may_compile=True)
        substeps = round(period_s / machine.dt_s)
        began = clocks()
        for last, target in pairwise(targets):
            machine.follow(last, target, substeps)
        note("plant alone", began, (len(targets) - 1) * period_s)
    for name, shares in spent.items():
        wall, cpu = (sorted(each)[len(each) // 2] for each in zip(*shares, strict=True))
        print(
            f"{name}: {1 / wall:5.1f} x real time by the wall, {1 / cpu:5.1f} x by CPU time "
            f"({cpu * period_s * 1e6:.0f} us per cycle of {axis.drive.cycle_ms:g} ms)"
        )


if __name__ == "__main__":
    main()
