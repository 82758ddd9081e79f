"""Number of instructions of a cycle of the daemon's control loop on a PREEMPT_RT kernel, and missed cycles.

    make bench-realtime
    tools/realtime/run.sh .venv/bin/python tools/bench/realtime_daemon.py

Runs on the kernel of `tools/realtime/run.sh`, as `realtime_cycle.py`: one axis at 1 kHz, then six at 250 Hz,
compensated, and before them the bench's cycle (`Cycle.tick`) with the same compensation and set-point. The
loop (`Controller.turn`) is in this process, with SCHED_FIFO and locked memory. A second process is the
service, on the same processor: it empties the rings of samples and events, and posts requests of clients
in a loop:

    moves, re-targeted in motion - jogs - stops - streams of knots - compensation off and on - a different
    model in motion - SDO requests

  busy    from the wake-up to the next time that the loop sleeps: a whole cycle, sample and commands included
  missed  cycles that began more than half a period late or were busy beyond the next deadline

It fails if a period was skipped, an axis stopped without a request, or a sample was lost.
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
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from typing import Any

from cycle import answering_kernel
from daemon_loop import bench_cycle, configs_of
from harness import PROFILE, Waking, keep, parser
from realtime_cycle import WARM_UP, Figures, table, timed

from hdbridge.axis.model import TransmissionModel
from hdbridge.control.buscycle import BusCycle
from hdbridge.control.realtime import prepare_realtime
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind, Knot, Memory, RelayedFrame
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.drive.link import Link
from hdbridge.enums import Scheme

VARIANTS = {"bench": (1, 1.0), "one": (1, 1.0), "six": (6, 4.0)}
"""Number of axes and cycle time, ms, of each variant."""
STATUS_OFF = 0x0250
POLL_S = 0.02
JOG_EVERY_S = 0.05
SDO_UPLOAD = bytes.fromhex("4041600000000000")
SPEED = 5.0
"""Velocity of the moves, deg/s at the load."""


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
        seen: dict[str, Any] = {"samples": 0, "lost": 0, "told": {}, "refused": []}
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
            told, missed = events.read()
            seen["samples"] += len(arrays)
            seen["lost"] += lost + missed
            for event in told:
                name = event.kind.name
                seen["told"][name] = seen["told"].get(name, 0) + 1
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


def measured(axes: int, cycle_ms: float, turns: int, channel: str) -> tuple[Figures, dict[str, Any]]:
    """Measures the loop with this number of axes; returns figures and the service's observations."""
    configs = configs_of(axes, cycle_ms)
    model = TransmissionModel.load(PROFILE / "model.yaml")
    clock = Waking()
    with ExitStack() as stack:
        bus = stack.enter_context(answering_kernel(channel, *range(1, axes + 1)))
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


def of_bench(cycle_ms: float, turns: int, channel: str) -> Figures:
    """Measures the bench's cycle on the path of a move, alone on the processor."""
    (axis,) = configs_of(1, cycle_ms)
    clock = Waking()
    with answering_kernel(channel, 1) as bus, prepare_realtime():
        turn, _ = bench_cycle(bus, TransmissionModel.load(PROFILE / "model.yaml"), axis, clock)
        return timed("bench's cycle, compensated", turn, clock, turns, axis.drive.cycle_s)


def report(seen: dict[str, Any]) -> None:
    """Prints the observations of the service, if there was one."""
    if seen:
        told = ", ".join(f"{count} {name}" for name, count in sorted(seen["told"].items()))
        print(f"the service saw {seen['samples']} samples and lost none; events: {told}", flush=True)
        for text in seen["refused"]:
            print(f"  {text}")


def main() -> int:
    given = parser(__doc__)
    given.add_argument("--channel", default="vcan0")
    given.add_argument("--turns", type=int, default=20_000)
    given.add_argument("--only", choices=tuple(VARIANTS), action="append", help="measure these only")
    given.add_argument("--serve", type=int, metavar="FD", help=argparse.SUPPRESS)
    given.add_argument("--axes", type=int, default=1, help=argparse.SUPPRESS)
    options = given.parse_args()
    warnings.simplefilter("ignore")
    if options.serve is not None:
        return serve(options.serve, options.axes)
    results = []
    for kind in options.only or VARIANTS:
        axes, cycle_ms = VARIANTS[kind]
        if kind == "bench":
            figures, seen = of_bench(cycle_ms, options.turns, options.channel), {}
        else:
            figures, seen = measured(axes, cycle_ms, options.turns, options.channel)
        print(table([figures], 1e-3 * cycle_ms), flush=True)
        report(seen)
        results.append({**asdict(figures), "cycle_ms": cycle_ms, **seen})
    keep(results, options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
