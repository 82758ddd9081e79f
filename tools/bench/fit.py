"""Time of an identification against the number of samples.

.venv/bin/python tools/bench/fit.py [samples ...]

One axis (ratio 50): sweeps over whole load turns both ways, sines, nested reversals, steps and rests at
250 Hz, laid end to end until there are enough samples. Prints seconds per fit and how they grow.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from identify_records import Truth, plan, record, recording

from hdbridge.analysis.identification import FitOptions
from hdbridge.analysis.identify import fit
from hdbridge.axis.effects import Start
from hdbridge.commissioning.calibration import measured_of
from hdbridge.records.recording import Recording


def made(samples: int) -> Recording:
    truth = Truth(orders={1: (4.9, -126.8), 2: (9.33, -132.1), 4: (12.21, 105.7), 6: (3.18, -127.0)})
    fixed = sum(len(leg) for _, leg in plan(truth.ratio, turns=0.001, steps=20))
    speed = 4.0
    turns = max((samples - fixed) * speed / 250.0 / 720.0, 0.3)
    if turns > 2.0:
        turns, speed = 2.0, 2.0 * 720.0 * 250.0 / (samples - fixed)
    legs = plan(truth.ratio, turns=turns, speed=speed, steps=20)
    rows = record(truth, np.random.default_rng(1), legs)
    return recording(rows)


def main() -> None:
    sizes = [int(float(each)) for each in sys.argv[1:]] or [100_000, 300_000, 1_000_000]
    before: tuple[int, float] | None = None
    for size in sizes:
        measured = measured_of([made(size)])
        count = len(measured.record)
        begun, cpu = time.perf_counter(), time.process_time()
        fit(measured, 50.0, FitOptions(start=Start.FORWARD))
        taken, cpu = time.perf_counter() - begun, time.process_time() - cpu
        growth = ""
        if before:
            growth = f", {taken / before[1]:.2f} x the time for {count / before[0]:.2f} x the samples"
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        print(
            f"{count:9d} samples: {taken:6.1f} s, processor {cpu:6.1f} s, {memory:.0f} MB{growth}", flush=True
        )
        before = (count, taken)


if __name__ == "__main__":
    main()
