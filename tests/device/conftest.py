"""Fixtures for the simulated drive: a motor without physics, and a master of raw frames."""

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.ideal_motor import IdealMotor
from support.rawmaster import FrameMaster

from hdbridge.device.node import DriveNode
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, lockstep_bench

EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"
PERIOD_S = 0.004


class RawMaster(FrameMaster):
    """Master of the simulated drive with a motor without physics."""

    def __init__(self, bus: LockstepBus, clock: VirtualClock, node: DriveNode, motor: IdealMotor) -> None:
        super().__init__(bus, clock)
        self.node, self.motor = node, motor

    def emergencies(self) -> list[int]:
        """Returns the codes of all EMCY frames so far."""
        self.take()
        return [data[0] | data[1] << 8 for can_id, data in self.seen if can_id == 0x081]

    @property
    def statusword(self) -> int:
        return self.read(0x6041) & 0xFFFF

    @property
    def state(self) -> str:
        """Returns the power state, decoded as CiA 402 tabulates the statusword."""
        word = self.statusword
        if word & 0x4F in (0x00, 0x40, 0x0F, 0x08):
            return {0x00: "not ready", 0x40: "disabled", 0x0F: "reaction", 0x08: "fault"}[word & 0x4F]
        return {0x21: "ready", 0x23: "switched on", 0x27: "enabled", 0x07: "quick stop"}[word & 0x6F]

    def control(self, word: int) -> None:
        self.put(0x6040, 0, word, 2)

    def enable(self, mode: int | None = None) -> None:
        """Leads the drive to OPERATION ENABLED by SDO."""
        if mode is not None:
            self.put(0x6060, 0, mode, 1)
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        assert self.state == "enabled"

    # PDO

    def cycle(self, word=0x0F, target=None, period_s=PERIOD_S):
        """Runs SYNC, both TPDOs, RPDO and one period of time; returns (status, actual, torque, load,
        demand).
        """
        self.take()
        self.send(0x080)
        frames = [frame for frame in self.take() if frame[0] in (0x181, 0x281)]
        assert [can_id for can_id, _ in frames] == [0x181, 0x281]
        feedback = struct.unpack("<Hih", frames[0][1]) + struct.unpack("<ii", frames[1][1])
        self.send(0x201, struct.pack("<Hi", word, feedback[1] if target is None else target))
        self.clock.sleep_until(self.clock.now() + period_s)
        return feedback

    def enable_csp(self) -> None:
        """Starts the node and enables it in CSP by PDOs; only the mode is set by SDO."""
        self.put(0x6060, 0, 8, 1)
        self.nmt(1)
        for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F):
            feedback = self.cycle(word)
        feedback = self.cycle()
        assert feedback[0] & 0x6F == 0x27

    def cruise(self, counts_per_cycle: int, cycles: int, start: int | None = None) -> int:
        """Moves the CSP target at constant speed; returns the last target."""
        target = self.read(0x6064) if start is None else start
        for _ in range(cycles):
            target += counts_per_cycle
            self.cycle(0x0F, target)
        return target


@pytest.fixture
def motor() -> IdealMotor:
    return IdealMotor()


@pytest.fixture
def master(motor: IdealMotor) -> Iterator[RawMaster]:
    with lockstep_bench(motor, EDS) as (bus, clock, node):
        yield RawMaster(bus, clock, node, motor)
