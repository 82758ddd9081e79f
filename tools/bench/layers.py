"""Cost of each layer of the simulated bench's cycle: `python tools/bench/layers.py`.

The same targets are run in cycles that lack one layer more each time: the samples, the compensation, the axis
(its encoders follow the demand at once), the drive (the same two TPDOs answer each SYNC), the master. What is
left at the end is SYNC, two TPDOs and the RPDO over the lockstep bus and nothing else. Servo and mechanics
are compiled where numba is installed.

Processor time of the thread per cycle; blocks of all variants in turn, and of each the lower decile, because
what another program takes of a shared processor only ever adds. The median beside it has that in it, as the
sum over a whole procedure has (`speed.py`): the two are to be compared with each other.
"""

from __future__ import annotations

import argparse
import math
import statistics
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import can

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.canframe import DataFrame
from hdbridge.control.bench import compensation_for
from hdbridge.control.cycle import Cycle, Feedback
from hdbridge.device.node import DriveNode
from hdbridge.drive.drive import Drive
from hdbridge.drive.objects import Mode
from hdbridge.drive.supervision import Supervision
from hdbridge.drive.switching import until_enabled
from hdbridge.files.bundled import bundled_profile
from hdbridge.motion.procedures.moves import Sample
from hdbridge.sim import fast
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, lockstep_bench, nameplate_of, simulated_bench
from hdbridge.sim.truth import Truth

CYCLES = 250
WAVE_DEG = [2.0 * min(1.0, max(0.0, 0.5 + 0.75 * math.sin(math.tau * k / CYCLES))) for k in range(CYCLES)]
"""Load targets of a block: there and back at up to 9 deg/s, with a rest at either end."""
TPDO1, TPDO2, RPDO1 = struct.Struct("<Hih"), struct.Struct("<ii"), struct.Struct("<Hi")
FOLDER = bundled_profile("article")
AXIS, MODEL = AxisConfig.load(FOLDER / "axis.yaml"), TransmissionModel.load(FOLDER / "model.yaml")
TRUTH = Truth.load(FOLDER / "truth.yaml")
NODE = AXIS.drive.node_id
SYNC, TPDO1_ID, TPDO2_ID, RPDO1_ID = 0x80, 0x180 + NODE, 0x280 + NODE, 0x200 + NODE
Block = Callable[[], object]
Set = tuple[Drive, Cycle, LockstepBus, VirtualClock, DriveNode]


class Obedient:
    """An axis without mechanics: both encoders are where the demand is."""

    dt_s = TRUTH.substep_s
    torque_limit_permille = 3000.0
    motor_counts = load_counts = torque_permille = 0
    velocity_counts_s = temperature_c = load_torque_nm = 0.0
    load_per_motor = AXIS.load_encoder.counts_per_turn / AXIS.motor_encoder.counts_per_turn / AXIS.gear.ratio

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        """Be there."""
        self.motor_counts, self.load_counts = round(end_counts), round(end_counts * self.load_per_motor)

    def coast(self, substeps: int, braked: bool) -> None:
        """Stay there."""


class Answering:
    """A node that answers each SYNC with the same two TPDOs, and sends its heartbeat every twelfth time."""

    def __init__(self, bus: can.BusABC, counts: int) -> None:
        self.bus, self.syncs = bus, 0
        load = round(counts * Obedient.load_per_motor)
        self.answers = (TPDO1_ID, TPDO1.pack(0x1237, counts, 0)), (TPDO2_ID, TPDO2.pack(load, counts))

    def poll(self, now_s: float) -> None:
        """Answer what has come."""
        while (message := self.bus.recv(0)) is not None:
            if message.arbitration_id != SYNC:
                continue
            for can_id, data in self.answers:
                self.bus.send(DataFrame(can_id, data))
            self.syncs += 1
            if self.syncs % 12 == 0:
                self.bus.send(DataFrame(0x700 + NODE, b"\x05"))

    def next_event_s(self) -> float:
        """Nothing happens by itself."""
        return math.inf


def cycle_on(stack: ExitStack, machine: Obedient | None) -> Set:
    """An enabled drive, its master's cycle, and what is between; ``machine`` None: the article's axis."""
    bus, clock, node = stack.enter_context(
        simulated_bench(TRUTH, AXIS.eds_path, NODE)
        if machine is None
        else lockstep_bench(machine, AXIS.eds_path, NODE, nameplate=nameplate_of(TRUTH))
    )
    drive = Drive(bus, AXIS, clock)
    drive.boot()
    cycle = Cycle(drive.link, clock, drive.image, Supervision(), AXIS.drive.cycle_s, monitor=drive.monitor)
    drive.enable(Mode.CSP)
    cycle.restart()
    until_enabled(cycle.tick, drive.image.power, cycle.period_s)
    return drive, cycle, bus, clock, node


def held_targets(cycle: Cycle, targets: list[int]) -> Block:
    """The master's cycle alone, with targets that are known."""

    def block() -> None:
        for target in targets:
            cycle.tick(target)

    return block


def compensated(drive: Drive, cycle: Cycle, *, keep: bool) -> Block:
    """The cycle with the article's compensation, as `Bench` runs it; ``keep``: and with its samples."""
    compensation, counts_for = compensation_for(AXIS, MODEL), drive.image.target_counts_for
    compensation.reset(0.0)
    compensation.engage()
    motor_deg, load_deg = AXIS.motor_encoder.scale.degrees, AXIS.load_encoder.scale.degrees

    def block() -> list[Sample]:
        samples: list[Sample] = []

        def command(_: Feedback) -> int:
            return counts_for(compensation.command(target_deg))

        for target_deg in WAVE_DEG:
            feedback = cycle.tick(command)
            if keep:
                sample = Sample(
                    feedback.time_s,
                    target_deg,
                    motor_deg(feedback.demand_counts),
                    motor_deg(feedback.motor_counts),
                    load_deg(feedback.load_counts),
                    feedback.torque_permille * 1e-3,
                )
                samples.append(sample)
        return samples

    return block


def frames_alone(bus: LockstepBus) -> Block:
    """SYNC, the TPDOs and the RPDO, packed and unpacked with struct."""

    def block() -> None:
        for _ in WAVE_DEG:
            bus.send(DataFrame(SYNC, b""))
            while (message := bus.recv(0)) is not None:
                if message.arbitration_id == TPDO1_ID:
                    TPDO1.unpack(message.data)
                elif message.arbitration_id == TPDO2_ID:
                    TPDO2.unpack(message.data)
            bus.send(DataFrame(RPDO1_ID, RPDO1.pack(0x0F, 0)))

    return block


def variants(stack: ExitStack) -> Iterator[tuple[str, Block]]:
    """Yields each omitted layer, and the cycle without that layer and all before."""
    targets = [round(AXIS.motor_encoder.counts(deg * AXIS.gear.ratio)) for deg in WAVE_DEG]
    drive, cycle, *_ = cycle_on(stack, None)
    yield "nothing", compensated(drive, cycle, keep=True)
    drive, cycle, *_ = cycle_on(stack, None)
    yield "samples", compensated(drive, cycle, keep=False)
    _, cycle, *_ = cycle_on(stack, None)
    yield "compensation", held_targets(cycle, targets)
    _, cycle, *_ = cycle_on(stack, Obedient())
    yield "mechanics and servo", held_targets(cycle, targets)
    _, cycle, bus, clock, node = cycle_on(stack, Obedient())
    counts = cycle.tick().motor_counts
    clock.nodes[:] = [Answering(node.bus, counts)]
    yield "the drive's firmware", held_targets(cycle, [counts] * CYCLES)
    yield "the master", frames_alone(bus)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What each layer of the simulated bench's cycle takes.")
    parser.add_argument("--blocks", type=int, default=60, help="blocks of 250 cycles of each variant")
    options = parser.parse_args()
    fast.waiting.left = 0
    with ExitStack() as stack:
        blocks = dict(variants(stack))
        spent: dict[str, list[float]] = {name: [] for name in blocks}
        for block in blocks.values():  # compiles, and begins
            block()
        for _ in range(options.blocks):
            for name, block in blocks.items():
                begin = time.thread_time()
                block()
                spent[name].append(1e6 * (time.thread_time() - begin) / CYCLES)
    before = math.nan
    for name, each in spent.items():
        decile = statistics.quantiles(each, n=10)[0]
        print(
            f"without {name:<22} {decile:6.1f} us per cycle"
            + ("         " if math.isnan(before) else f" ({before - decile:+5.1f}) ")
            + f" median {statistics.median(each):6.1f}"
        )
        before = decile


if __name__ == "__main__":
    main()
