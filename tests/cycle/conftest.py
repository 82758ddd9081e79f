"""A simulated axis on a virtual clock, enabled and moving, with an intruder's bus on the same channel."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from uuid import uuid4

import can
import pytest
from support.characters import FRIENDLY, Character
from support.spoilt import SpoiltBus

from hdbridge.axis import AxisConfig
from hdbridge.control.cycle import Cycle, Feedback
from hdbridge.device.node import DriveNode
from hdbridge.drive.drive import Drive
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction, Supervision
from hdbridge.errors import SafetyStop
from hdbridge.sim.lockstep import VirtualClock, simulated_bench
from hdbridge.sim.truth import Truth

PROFILE = Path(__file__).resolve().parents[2] / "profiles" / "article"
STEP_COUNTS = 40
"""Target step per cycle: 9 load degrees per second at 4 ms."""


class SyncAnswer:
    """A node that answers each SYNC with the same frames."""

    def __init__(self, bus: can.BusABC, frames: tuple[tuple[int, bytes], ...]) -> None:
        self.bus, self.frames = bus, frames

    def next_event_s(self) -> float:
        return float("inf")

    def poll(self, now_s: float) -> None:
        while (message := self.bus.recv(0)) is not None:
            if message.arbitration_id == 0x080:
                for can_id, data in self.frames:
                    self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


@dataclass
class Rig:
    """An axis in motion, and everything that a test may change."""

    bus: SpoiltBus
    clock: VirtualClock
    node: DriveNode
    drive: Drive
    cycle: Cycle
    supervision: Supervision
    intruder: can.BusABC
    target: int = 0
    bad: float | None = None
    sent: list[tuple[float, int, bytes]] = field(default_factory=list)
    """Time, identifier and data of each frame of the master."""

    def __post_init__(self) -> None:
        self.bus.spy = lambda can_id, data: self.sent.append((self.clock.now(), can_id, data))

    def enable(self) -> None:
        self.drive.enable()
        self.cycle.restart()
        for _ in range(50):
            feedback = self.cycle.tick()
            if self.drive.image.power.state is State.OPERATION_ENABLED:
                break
        assert self.drive.image.power.state is State.OPERATION_ENABLED
        self.target = feedback.motor_counts

    def set_off(self) -> None:
        """Enables the axis and moves it at constant speed."""
        self.enable()
        self.move(60)
        self.sent.clear()

    @property
    def period_s(self) -> float:
        return self.cycle.period_s

    def bad_target(self, counts: float) -> None:
        """Makes the next cycle command this target, motor counts."""
        self.bad = counts

    def move(self, cycles: int = 1) -> Feedback:
        """Continues at constant speed."""
        for _ in range(cycles):
            self.target += STEP_COUNTS
            bad, self.bad = self.bad, None
            feedback = self.cycle.tick(self.target if bad is None else bad)  # type: ignore[arg-type]
        return feedback

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        """Sends a frame from another node before the next cycle."""
        kind = {"is_extended_id": False, **kind}
        self.intruder.send(can.Message(arbitration_id=can_id, data=data, **kind))

    def hang(self, duration_s: float) -> None:
        """Stalls the master for ``duration_s``."""
        self.clock.sleep_until(self.clock.now() + duration_s)

    def interface_down(self) -> None:
        self.bus.down = errno.ENETDOWN

    def interface_deleted(self) -> None:
        self.bus.down = errno.ENODEV

    def transmit_queue_full(self) -> None:
        self.bus.no_room_for = 0x201

    def answers_sync(self, *frames: tuple[int, bytes]) -> None:
        """Another node that sends these frames after every SYNC, before the drive does."""
        self.clock.nodes.insert(0, SyncAnswer(self.intruder, frames))

    def events(self, fault: Fault) -> list[Reaction]:
        return [event.reaction for event in self.supervision.events if event.fault is fault]

    def stopped_within(self, cycles: int, fault: Fault) -> str:
        """Continues until the stop, which must come within these cycles for this fault; returns its text."""
        first = self.drive.image.target_counts
        for _ in range(cycles):
            try:
                self.move()
            except SafetyStop as stop:
                assert self.supervision.stop is not None
                assert self.supervision.stop.fault is fault
                return str(stop)
        raise AssertionError(f"no stop within {cycles} cycles; target went from {first} to {self.target}")

    def stands_still(self) -> None:
        """Checks that the axis comes to rest without the master and stays there."""
        self.clock.sleep_until(self.clock.now() + 1.0)
        place = self.node.firmware.motion.machine.motor_counts
        self.clock.sleep_until(self.clock.now() + 0.5)
        assert abs(self.node.firmware.motion.machine.motor_counts - place) <= 2
        assert abs(place - self.target) < 8000

    def next_program(self, cycles: int = 10) -> None:
        """Starts another program with its own cycle on this bus; it requests no power."""
        self.bus.down = self.bus.no_room_for = None
        link = Link(self.bus, self.clock)
        cycle = Cycle(link, self.clock, ProcessImage(self.drive.axis), Supervision(), self.period_s)
        for _ in range(cycles):
            with suppress(SafetyStop):
                cycle.tick()

    def frames(self, can_id: int) -> list[tuple[float, bytes]]:
        return [(time_s, data) for time_s, sent, data in self.sent if sent == can_id]


@contextmanager
def rig(profile: Path = PROFILE, character: Character = FRIENDLY) -> Iterator[Rig]:
    axis = character.of_axis(AxisConfig.load(profile))
    channel = f"cycle-{uuid4()}"
    truth = character.of_truth(Truth.load(profile))
    with simulated_bench(truth, axis.eds_path, axis.drive.node_id, channel=channel) as (
        bus,
        clock,
        node,
    ):
        intruder = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        bus.shutdown()
        with intruder, SpoiltBus(channel, clock) as spoilt:
            drive = Drive(spoilt, axis, clock)
            drive.boot()
            supervision = Supervision()
            cycle = Cycle(
                drive.link, clock, drive.image, supervision, axis.drive.cycle_s, monitor=drive.monitor
            )
            yield Rig(spoilt, clock, node, drive, cycle, supervision, intruder)


@pytest.fixture
def idle() -> Iterator[Rig]:
    """Booted, but not enabled."""
    with rig() as made:
        yield made


@pytest.fixture
def moving() -> Iterator[Rig]:
    """Enabled and moving at constant speed."""
    with rig() as made:
        made.set_off()
        yield made
