"""CPU time of the control cycle of n axes.

    python tools/bench/buscycle.py [--interface virtual|loopback]... [--json FILE]

One run measures, in interleaved blocks, the CPU time of the thread (`time.thread_time`) per cycle of one axis
through `Cycle`, and of `BusCycle` with 1, 2, 4 and 6 axes, each with the target held, and compensated. The
buses are those of `cycle.py`, and the cost of the answering nodes is subtracted. Of n axes the cost for each
axis and for one axis more is printed: what is linear in n has both constant or falling.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from cycle import PROFILE, AnsweringBus, LoopbackSocket, NeverSleeping, Variants, block_us, loopback_bus

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.clock import Clock
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.control.buscycle import BusCycle
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import SafetyStop

AXES = (1, 2, 4, 6)
HELD, COMPENSATED = "held", "compensated"


class Busy(Exception):  # noqa: N818 - what happened
    """Raised if the machine stalled within a block, which the cycle reported as a fault."""


class Axes:
    """Enabled axes on one bus, each on its own slow sine."""

    def __init__(self, bus: Any, count: int, model: TransmissionModel, clock: Clock | None = None) -> None:
        self.bus = bus
        self.clock = clock if clock is not None else NeverSleeping()
        axis = AxisConfig.load(PROFILE)
        self.period_s = axis.drive.cycle_s
        self.cycle = BusCycle(Link(bus, self.clock), self.clock, self.period_s, bitrate_bps=1_000_000)
        self.answers: list[Callable[[Feedback], int]] = []
        for node_id in range(1, count + 1):
            drive = axis.drive.model_copy(update={"node_id": node_id})
            image = ProcessImage(axis.model_copy(update={"drive": drive}))
            each = AxisCycle(image, Supervision())
            self.cycle.join(each)
            each.begin()
            self.answers.append(self._answer(image, model, float(node_id)))

    def _answer(
        self, image: ProcessImage, model: TransmissionModel, phase: float
    ) -> Callable[[Feedback], int]:
        compensation = Compensation(model, CompensationLimits(), self.period_s)
        compensation.engage()
        sin, command, counts_for = math.sin, compensation.command, image.target_counts_for
        return lambda feedback: counts_for(command(2.0 * sin(feedback.time_s + phase)))

    def start(self, kind: str) -> None:
        """Prepares a block: latches released, power on."""
        while self.bus.recv(0.0) is not None:
            pass
        for axis, answer in zip(self.cycle.axes, self.answers, strict=True):
            axis.reset(verified=True)
            axis.begin()
            axis.command = answer if kind == COMPENSATED else 0
        self.cycle.restart()
        for _ in range(20):
            self.cycle.exchange()
            if all(axis.feedback.fresh for axis in self.cycle.axes):
                break
        for axis in self.cycle.axes:
            axis.image.power.go(State.OPERATION_ENABLED)

    def check(self) -> None:
        """Raises `Busy` if an axis was stopped within the block."""
        if any(axis.supervision.stop is not None for axis in self.cycle.axes):
            raise Busy


def _bus(interface: str, count: int) -> tuple[Any, Callable[[], object]]:
    """Returns a bus on which ``count`` drives answer, and the cost of answering."""
    node_ids = range(1, count + 1)
    if interface == "virtual":
        bus = AnsweringBus(*node_ids)
        return bus, bus.answer
    sock = LoopbackSocket(*node_ids)
    return loopback_bus(sock), sock.answer_nobody


class Worker:
    """Cycles, measured block by block."""

    def __init__(self) -> None:
        self.model = TransmissionModel.load(PROFILE / "model.yaml")
        self.axis = AxisConfig.load(PROFILE)
        self.singles: dict[str, tuple[Variants, Callable[[], object]]] = {}
        self.several: dict[tuple[str, int], tuple[Axes, Callable[[], object]]] = {}

    def block(self, interface: str, count: int, kind: str, cycles: int) -> float:
        """Returns the net cost of one cycle, us; ``count`` 0 is one axis through `Cycle`."""
        for _ in range(20):
            with suppress(SafetyStop, Busy):
                return (
                    self._single(interface, kind, cycles)
                    if not count
                    else self._bus(interface, count, kind, cycles)
                )
        raise SystemExit("no block ran to its end: this machine is too busy to measure on")

    def _single(self, interface: str, kind: str, cycles: int) -> float:
        if interface not in self.singles:
            bus, answer = _bus(interface, 1)
            self.singles[interface] = Variants(bus, self.axis, self.model), answer
        variants, answer = self.singles[interface]
        variants.start()
        loop = variants.plain if kind == HELD else variants.compensated
        block_us(loop, 20)
        return block_us(loop, cycles) - self._cost(variants.bus, answer, cycles)

    def _bus(self, interface: str, count: int, kind: str, cycles: int) -> float:
        if (interface, count) not in self.several:
            bus, answer = _bus(interface, count)
            self.several[interface, count] = Axes(bus, count, self.model), answer
        axes, answer = self.several[interface, count]
        axes.start(kind)
        block_us(axes.cycle.exchange, 20)
        own_us = block_us(axes.cycle.exchange, cycles)
        axes.check()
        return own_us - self._cost(axes.bus, answer, cycles)

    @staticmethod
    def _cost(bus: Any, answer: Callable[[], object], cycles: int) -> float:
        """Returns the CPU time of the answering nodes in one cycle; clears the bus of their frames."""
        cost_us = block_us(answer, cycles)
        while bus.recv(0.0) is not None:
            pass
        return cost_us


def measure(interface: str, blocks: int, cycles: int) -> dict[str, dict[str, float]]:
    """Returns medians by kind and variant, us, and the median ratio of neighbouring blocks."""
    worker = Worker()
    times: dict[tuple[str, str], list[float]] = {}
    for _ in range(blocks):
        for kind in (HELD, COMPENSATED):
            times.setdefault((kind, "now"), []).append(worker.block(interface, 0, kind, cycles))
            for count in AXES:
                own_us = worker.block(interface, count, kind, max(cycles // count, 50))
                times.setdefault((kind, str(count)), []).append(own_us)
    result: dict[str, dict[str, float]] = {HELD: {}, COMPENSATED: {}}
    for (kind, name), values in times.items():
        result[kind][name] = statistics.median(values)
    for kind, figures in result.items():
        pairs = zip(times[kind, "1"], times[kind, "now"], strict=True)
        figures["bus of one / now"] = statistics.median(a / b for a, b in pairs)
    return result


def report(result: dict[str, dict[str, float]], where: str) -> str:
    lines = [f"CPU time of one cycle on {where}, medians, us:", "", f"{'':<28} {HELD:>10} {COMPENSATED:>12}"]

    def row(label: str, *values: float) -> None:
        lines.append(f"  {label:<26} {values[0]:>10.2f} {values[1]:>12.2f}")

    for name, label in (
        ("now", "one axis, Cycle"),
        ("bus of one / now", "  BusCycle / Cycle"),
    ):
        row(label, *(figures[name] for figures in result.values()))
    for place, count in enumerate(AXES):
        row(f"{count} axes", *(figures[str(count)] for figures in result.values()))
        row("  for each axis", *(figures[str(count)] / count for figures in result.values()))
        if place:
            less = AXES[place - 1]
            more = [(each[str(count)] - each[str(less)]) / (count - less) for each in result.values()]
            row("  for one axis more", *more)
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--interface", choices=("virtual", "loopback"), action="append")
    parser.add_argument("--blocks", type=int, default=41, help="blocks per variant")
    parser.add_argument("--cycles", type=int, default=400, help="cycles per block, for one axis")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    began_s = time.monotonic()
    results = {}
    for interface in options.interface or ["virtual", "loopback"]:
        results[interface] = measure(interface, options.blocks, options.cycles)
        print(report(results[interface], interface), end="\n\n")
    print(f"{time.monotonic() - began_s:.0f} s")
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
