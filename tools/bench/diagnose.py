"""Time and memory of a diagnosis as a function of the number of samples.

    python tools/bench/diagnose.py [SAMPLES ...]

One axis (ratio 50) with two hidden causes runs a bench plan; the record is repeated until there are enough
samples. CPU time is that of one thread if OMP_NUM_THREADS=1 is set.
"""

from __future__ import annotations

import resource
import time

import numpy as np
from harness import parser
from support import plant

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

HIDDEN = {"backlash": {"gap": 6.0}, "load_order": {"orders": [(1, 5.0, 30.0)]}}


def record(samples: int) -> Record:
    """Returns a record that repeats one plan, with continuing time and new noise."""
    once = plant.record(plant.Truth(effects=HIDDEN), plant.Plan(), 1)
    count = len(once["time_s"])
    period = float(np.median(np.diff(once["time_s"])))
    rng = np.random.default_rng(1)
    whole = {name: np.resize(values, samples) for name, values in once.items()}
    whole["time_s"] = once["time_s"][0] + np.arange(samples) * period
    later = np.arange(samples) >= count
    whole["load_position_deg"] = whole["load_position_deg"] + later * rng.normal(0.0, 0.3 / 3600.0, samples)
    return Record(whole)


def main() -> None:
    """Prints a line for each number of samples."""
    given = parser(__doc__)
    given.add_argument("samples", type=int, nargs="*", default=[32_000, 100_000, 300_000, 1_000_000])
    model = TransmissionModel.from_text(plant.model_text(1))
    before: tuple[int, float] | None = None
    for size in given.parse_args().samples:
        measured = record(size)
        begun, cpu = time.perf_counter(), time.process_time()
        result = diagnose(measured, model)
        taken, cpu = time.perf_counter() - begun, time.process_time() - cpu
        growth = ""
        if before:
            growth = f", {cpu / before[1]:.2f} x the processor time for {size / before[0]:.2f} x the samples"
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        named = ", ".join(each.cause for each in result.findings) or "nothing"
        print(
            f"{size:9d} samples: {taken:6.1f} s, processor {cpu:6.1f} s, {memory:.0f} MB{growth}; {named}",
            flush=True,
        )
        before = (size, cpu)


if __name__ == "__main__":
    main()
