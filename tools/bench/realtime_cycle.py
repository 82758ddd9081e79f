"""Number of instructions of a 1 ms cycle on a PREEMPT_RT kernel, and number of missed cycles.

    make bench-realtime
    tools/realtime/run.sh .venv/bin/python tools/bench/realtime_cycle.py --master build/realtime/master

Runs on the kernel of `tools/realtime/run.sh`, on which an instruction takes one nanosecond and nothing else
runs, so that commits can be compared. The exchanges are those of `cycle.py` and one in C (`master.c`). The
kernel's CAN gateway answers in place of the drive. Each exchange has SCHED_FIFO, locked memory and absolute
deadlines.

  late    from the deadline to the first instruction of the cycle
  busy    from there to the last instruction of the cycle, system calls included
  missed  cycles that began more than half a period late or were busy beyond the next deadline
"""

from __future__ import annotations

import subprocess
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from cycle import Variants, answering_kernel
from harness import PROFILE, Waking, keep, parser

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.realtime import prepare_realtime

WARM_UP = 50
KINDS = ("bare", "cycle", "compensated", "filtered", "canopen")


@dataclass(frozen=True)
class Figures:
    """Figures of one kind of cycle; times in microseconds."""

    name: str
    busy_median_us: float
    busy_999_us: float
    busy_most_us: float
    late_999_us: float
    missed: int
    cycles: int

    @classmethod
    def of(cls, name: str, late_us: np.ndarray, busy_us: np.ndarray, period_us: float) -> Figures:
        missed = (late_us > 0.5 * period_us) | (late_us + busy_us > period_us)
        return cls(
            name,
            *(float(each) for each in np.percentile(busy_us, [50.0, 99.9, 100.0])),
            float(np.percentile(late_us, 99.9)),
            int(missed.sum()),
            len(busy_us),
        )


def timed(name: str, cycle: Callable[[], object], clock: Waking, cycles: int, period_s: float) -> Figures:
    """Measures ``cycles`` cycles, each started at its deadline."""
    for _ in range(WARM_UP):
        cycle()
    clock.record(cycles, cycle)
    return Figures.of(name, 1e6 * np.array(clock.late_s), 1e6 * np.array(clock.busy_s), 1e6 * period_s)


def in_c(master: Path, channel: str, cycles: int, period_s: float) -> Figures:
    """Measures the same exchange in C."""
    command = [str(master), channel, f"{1e6 * period_s:.0f}", str(cycles)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    late_ns, busy_ns = np.array([line.split() for line in done.stdout.splitlines()], dtype=float).T
    return Figures.of("a master in C", 1e-3 * late_ns, 1e-3 * busy_ns, 1e6 * period_s)


def table(figures: list[Figures], period_s: float) -> str:
    """Returns a table with one line per kind of cycle, and ratios to the bare exchange if it was measured."""
    bare = next((each for each in figures if each.name.startswith("bare")), None)
    head = (
        f"{'':<28} {'busy us':>8} {'99.9 %':>8} {'most':>8} {'late 99.9 %':>12} {'missed':>14} {'x bare':>7}"
    )
    lines = [f"Cycles of {1e3 * period_s:g} ms on PREEMPT_RT, 1 us = 1000 instructions:", "", head]
    lines += [
        f"{each.name:<28} {each.busy_median_us:>8.1f} {each.busy_999_us:>8.1f} {each.busy_most_us:>8.1f} "
        f"{each.late_999_us:>12.1f} {f'{each.missed} of {each.cycles}':>14} "
        + (f"{each.busy_median_us / bare.busy_median_us:>7.2f}" if bare is not None else "")
        for each in figures
    ]
    return "\n".join(lines)


def main() -> int:
    given = parser(__doc__)
    given.add_argument("--channel", default="vcan0")
    given.add_argument("--cycles", type=int, default=20_000)
    given.add_argument("--master", type=Path, help="the compiled master.c")
    given.add_argument("--only", choices=KINDS, action="append", help="measure these only")
    options = given.parse_args()
    warnings.simplefilter("ignore")
    axis = AxisConfig.load(PROFILE)
    axis = axis.model_copy(update={"drive": axis.drive.model_copy(update={"cycle_ms": 1.0})})
    model = TransmissionModel.load(PROFILE / "model.yaml")
    period_s = axis.drive.cycle_s
    clock = Waking()
    figures: list[Figures] = []
    wanted = options.only or KINDS
    with answering_kernel(options.channel, axis.drive.node_id) as bus:
        variants = Variants(bus, axis, model, clock)
        loops: dict[str, tuple[str, Callable[[], object]]] = {
            "bare": ("bare python-can exchange", variants.bare),
            "cycle": ("hdbridge cycle", variants.plain),
            "compensated": ("hdbridge cycle, compensated", variants.compensated),
            "filtered": ("hdbridge cycle, filtered", variants.filtered),
            "canopen": ("canopen's PDO objects", variants.with_canopen),
        }
        for kind, (name, loop) in loops.items():
            if kind not in wanted:
                continue
            with prepare_realtime():
                variants.start()
                figures.append(timed(name, loop, clock, options.cycles, period_s))
            print(f"measured: {name}", flush=True)
        if options.master is not None:
            figures.append(in_c(options.master, options.channel, options.cycles, period_s))
    print(table(figures, period_s), flush=True)
    keep([asdict(each) for each in figures], options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
