"""Number of instructions of a control cycle on a PREEMPT_RT kernel, and number of missed cycles.

    make bench-realtime
    tools/realtime/run.sh .venv/bin/python tools/bench/realtime.py --master build/realtime/master

Runs on the kernel of `tools/realtime/run.sh`, on which an instruction takes one nanosecond and nothing else
runs, so that commits can be compared. The kernel's CAN gateway answers in place of the drives. Each variant
has SCHED_FIFO, locked memory and absolute deadlines:

  bare ... canopen  the exchanges of `cycle.py`, at 1 kHz; with ``--master`` also that in C (`master.c`)
  bench             the bench's cycle (`Cycle.tick`), compensated, on the path of a move, at 1 kHz
  one, six          the daemon's loop (`Controller.turn`) with one axis at 1 kHz, and with six at 250 Hz

Next to the daemon's loop a second process is the service, on the same processor: it empties the rings of
samples and events, and posts requests of clients in a loop:

    moves, re-targeted in motion - jogs - stops - streams of knots - compensation off and on - a different
    model in motion - SDO requests

It fails if the loop skipped a period, an axis stopped without a request, or a sample was lost.

  late    from the deadline to the first instruction of the cycle
  busy    from there until the loop sleeps again: a whole cycle, sample, commands and system calls included
  missed  cycles that began more than half a period late or were busy beyond the next deadline
"""

from __future__ import annotations

import argparse
import json
import math
import select
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cycle import Variants, answering_kernel
from daemon_loop import bench_cycle, configs_of
from harness import CHANNEL, PROFILE, Waking, parser

from hdbridge.axis.model import TransmissionModel
from hdbridge.control.buscycle import BusCycle
from hdbridge.control.realtime import prepare_realtime
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind, Knot, Memory, RelayedFrame
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.drive.link import Link
from hdbridge.enums import Scheme

EXCHANGES = {
    "bare": ("bare python-can exchange", Variants.bare),
    "cycle": ("hdbridge cycle", Variants.plain),
    "compensated": ("hdbridge cycle, compensated", Variants.compensated),
    "filtered": ("hdbridge cycle, filtered", Variants.filtered),
    "canopen": ("canopen's PDO objects", Variants.with_canopen),
}
LOOPS = {"one": (1, 1.0), "six": (6, 4.0)}
"""Number of axes and cycle time, ms, of the daemon's loop."""
FAST_MS = 1.0
WARM_UP = 50
STATUS_OFF = 0x0250
POLL_S = 0.02
JOG_EVERY_S = 0.05
SDO_UPLOAD = bytes.fromhex("4041600000000000")
SPEED = 5.0
"""Velocity of the moves, deg/s at the load."""


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


def in_c(master: Path, cycles: int, period_s: float) -> Figures:
    """Measures the same exchange in C."""
    command = [str(master), CHANNEL, f"{1e6 * period_s:.0f}", str(cycles)]
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


# -------------------------------------------------------------------- the service's process


class Clients:
    """Requests of clients to one axis: a repeated sequence of about six seconds."""

    def __init__(self, memory: Memory, axis: int, setting: CompensationSetting) -> None:
        """``setting`` is the compensation setting that is activated in motion."""
        self._memory, self._axis, self._setting = memory, axis, setting
        self._stream = 0
        self.steps = self._steps()

    def _post(self, kind: CommandKind, **fields: float) -> None:
        self._memory.commands.post(kind, self._axis, **fields)  # type: ignore[arg-type]

    def _use(self, setting: CompensationSetting) -> None:
        slot = self._memory.settings[self._axis]
        self._post(CommandKind.CHANGE, i=slot.put(setting.to_json()))

    def _steps(self) -> Iterator[float]:
        """Makes one request per `next`; yields the time until the next request, s."""
        while True:
            for target in (2.0, -2.0, 3.0, 0.5):
                self._post(CommandKind.MOVE, a=target, b=SPEED, c=math.nan)
                yield 0.3
            for _ in range(10):
                self._post(CommandKind.JOG, a=1.0, b=0.3)
                yield JOG_EVERY_S
            self._post(CommandKind.STOP)
            yield 0.7
            self._use(replace(self._setting, scheme=Scheme.NONE))
            yield 0.3
            self._use(self._setting)
            self._post(CommandKind.MOVE, a=0.0, b=SPEED, c=math.nan)
            yield 0.1
            self._use(replace(self._setting, scheme=Scheme.SYNCHRONOUS))
            yield 1.4
            yield from self._streamed()

    def _streamed(self) -> Iterator[float]:
        """Streams a slow sine about the current position, with 100 knots per second."""
        self._stream += 1
        knots = self._memory.knots[self._axis]

        def knot(time_s: float) -> Knot:
            phase = math.pi * time_s
            position, velocity = math.sin(phase) ** 2, math.pi * math.sin(2.0 * phase)
            return Knot(self._stream, time_s, position, velocity)

        knots.put([knot(0.01 * place) for place in range(30)])
        self._post(CommandKind.STREAM_BEGIN, a=0.2, j=self._stream)
        for burst in range(3, 10):
            yield 0.1
            knots.put([knot(0.01 * place) for place in range(10 * burst, 10 * burst + 10)])
        knots.put([knot(1.0)])
        self._post(CommandKind.STREAM_END)
        yield 1.0


def serve(fd: int, axes: int) -> int:
    """Runs as the service until standard input is closed; prints the observations as JSON."""
    with Memory.attach(fd) as memory:
        samples, events = memory.reader(), memory.event_reader()
        seen: dict[str, Any] = {"samples": 0, "lost": 0, "events": {}, "refused": []}
        model = TransmissionModel.load(PROFILE / "model.yaml")
        clients = [
            Clients(memory, axis, CompensationSetting(model.bound_to(config), Scheme.EXTENDED))
            for axis, config in enumerate(configs_of(axes, 1e3 * memory.period_s))
        ]
        due: list[float] = []
        enabled = 0
        print("ready", flush=True)
        polls = 0
        while not select.select([sys.stdin], [], [], POLL_S)[0]:
            now = time.monotonic()
            arrays, lost = samples.read()
            arrived, missed = events.read()
            seen["samples"] += len(arrays)
            seen["lost"] += lost + missed
            for event in arrived:
                name = event.kind.name
                seen["events"][name] = seen["events"].get(name, 0) + 1
                if event.kind in (EventKind.REFUSED, EventKind.STREAM_REFUSED, EventKind.STOPPED):
                    seen["refused"].append(event.text)
                enabled += event.kind is EventKind.STATE and event.code == AxisState.ENABLED
            if enabled < axes:
                continue
            due = due or [now + 0.1 * axis for axis in range(axes)]
            for axis, each in enumerate(clients):
                if now >= due[axis]:
                    due[axis] = now + next(each.steps)
            memory.outgoing.add(RelayedFrame(time.monotonic_ns(), 0x601 + polls % axes, SDO_UPLOAD))
            polls += 1
    print(json.dumps({**seen, "refused": seen["refused"][:10]}), flush=True)
    return 0


@contextmanager
def service(memory: Memory) -> Iterator[subprocess.Popen[str]]:
    """Yields the service's process, which waits for a start command."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--serve", str(memory.fd), "--axes", str(memory.axes)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=(memory.fd,),
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


# -------------------------------------------------------------------- the loop


def enabled(controller: Controller, memory: Memory) -> None:
    """Enables all axes."""
    for axis in range(memory.axes):
        memory.commands.post(CommandKind.VERIFIED, axis, k=STATUS_OFF)
        memory.commands.post(CommandKind.ENABLE, axis, k=STATUS_OFF)
        for _ in range(10):
            controller.turn()
    check(controller)


def check(controller: Controller) -> None:
    """Checks that every axis still moves and no period was skipped."""
    for axis in controller.axes:
        if axis.state is not AxisState.ENABLED:
            raise SystemExit(f"{axis.config.name} is {axis.state.name}: {axis.supervision.stop}")
    if controller.cycle.skipped:
        raise SystemExit(f"{controller.cycle.skipped} periods were skipped")


def measured(axes: int, cycle_ms: float, turns: int) -> tuple[Figures, dict[str, Any]]:
    """Measures the loop with this number of axes; returns figures and the service's observations."""
    configs = configs_of(axes, cycle_ms)
    model = TransmissionModel.load(PROFILE / "model.yaml")
    clock = Waking()
    with ExitStack() as stack:
        bus = stack.enter_context(answering_kernel(*range(1, axes + 1)))
        memory = stack.enter_context(Memory.create(axes, configs[0].drive.cycle_s))
        cycle = BusCycle(Link(bus, clock), clock, memory.period_s, bitrate_bps=1_000_000)
        controller = Controller(cycle, [(each, None) for each in configs], memory)
        for each in controller.axes:
            setting = CompensationSetting(model.bound_to(each.config), Scheme.EXTENDED)
            each.follower.use(setting, moving=False)
        process = stack.enter_context(service(memory))
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        stack.enter_context(prepare_realtime())
        cycle.restart()
        enabled(controller, memory)
        name = "daemon's loop, one axis" if axes == 1 else f"daemon's loop, {axes} axes"
        figures = timed(name, controller.turn, clock, turns, memory.period_s)
        check(controller)
        assert process.stdin is not None
        process.stdin.close()
        for _ in range(2 * WARM_UP):
            controller.turn()
        seen = json.loads(process.stdout.readline())
    if seen["lost"] or not seen["samples"]:
        raise SystemExit(f"the service saw {seen['samples']} samples and lost {seen['lost']}")
    return figures, seen


def of_bench(cycle_ms: float, turns: int) -> Figures:
    """Measures the bench's cycle on the path of a move, alone on the processor."""
    (axis,) = configs_of(1, cycle_ms)
    clock = Waking()
    with answering_kernel(1) as bus, prepare_realtime():
        turn, _ = bench_cycle(bus, TransmissionModel.load(PROFILE / "model.yaml"), axis, clock)
        return timed("bench's cycle, compensated", turn, clock, turns, axis.drive.cycle_s)


def of_exchanges(kinds: list[str], master: Path | None, cycles: int) -> list[Figures]:
    """Measures the exchanges of `cycle.py`, and the one in C."""
    (axis,) = configs_of(1, FAST_MS)
    model, clock, figures = TransmissionModel.load(PROFILE / "model.yaml"), Waking(), []
    with answering_kernel(axis.drive.node_id) as bus:
        variants = Variants(bus, axis, model, clock)
        for kind in kinds:
            name, loop = EXCHANGES[kind]
            with prepare_realtime():
                variants.start()
                figures.append(timed(name, partial(loop, variants), clock, cycles, variants.period_s))
            print(f"measured: {name}", flush=True)
        if master is not None:
            figures.append(in_c(master, cycles, variants.period_s))
    return figures


def main() -> int:
    given = parser(__doc__, cycles=20_000)
    given.add_argument("--master", type=Path, help="the compiled master.c")
    given.add_argument(
        "--only", choices=(*EXCHANGES, "bench", *LOOPS), action="append", help="measure these only"
    )
    given.add_argument("--serve", type=int, metavar="FD", help=argparse.SUPPRESS)
    given.add_argument("--axes", type=int, default=1, help=argparse.SUPPRESS)
    options = given.parse_args()
    warnings.simplefilter("ignore")
    if options.serve is not None:
        return serve(options.serve, options.axes)
    wanted, cycles = options.only or (*EXCHANGES, "bench", *LOOPS), options.cycles
    fast = of_exchanges([each for each in EXCHANGES if each in wanted], options.master, cycles)
    if "bench" in wanted:
        fast.append(of_bench(FAST_MS, cycles))
    print(table(fast, 1e-3 * FAST_MS), flush=True)
    for kind, (axes, cycle_ms) in LOOPS.items():
        if kind in wanted:
            figures, seen = measured(axes, cycle_ms, cycles)
            print(table([figures], 1e-3 * cycle_ms), flush=True)
            events = ", ".join(f"{count} {name}" for name, count in sorted(seen["events"].items()))
            print(f"the service saw {seen['samples']} samples and lost none; events: {events}", flush=True)
            print(*seen["refused"], sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
