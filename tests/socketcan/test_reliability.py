"""Every fault of the reliability table on a real Linux CAN stack, and the behaviour of commands on a shared
bus.
"""

import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest
from support.characters import FRIENDLY, RESTLESS, Character, PowerCount
from support.command import run_here
from support.reliability import ABOUT_POWER, VCAN, Row, cases_on, try_out

from hdbridge.axis import AxisConfig
from hdbridge.clock import MonotonicClock
from hdbridge.device.node import DriveNode
from hdbridge.device.run import run
from hdbridge.drive.supervision import Fault, Reaction
from hdbridge.errors import BusError
from hdbridge.sim.lockstep import nameplate_of
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from tests.socketcan.conftest import master_on


@contextmanager
def drive_in_a_thread(interface: str, profile: Path, character: Character = FRIENDLY) -> Iterator[DriveNode]:
    """Provides the simulated drive on its own socket, with access to its fault injector."""
    axis, truth = AxisConfig.load(profile), character.of_truth(Truth.load(profile))
    ended = threading.Event()
    with can.Bus(interface="socketcan", channel=interface, ignore_config=True) as bus:
        clock = MonotonicClock()
        node = DriveNode(bus, Machine(truth, 0), axis.eds_path, 1, clock, nameplate_of(truth), truth.firmware)

        def serve() -> None:
            with suppress(BusError):  # the row has taken the interface away
                run(bus, node, clock, ended.is_set)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield node
        finally:
            ended.set()
            thread.join()


@dataclass
class VcanBench:
    """A master that moves its axis over vcan."""

    master: Any
    node: DriveNode
    intruder: can.BusABC
    configure: Callable[..., None]
    interface: str

    def __post_init__(self) -> None:
        self.supervision, self.period_s = self.master.supervision, self.master.cycle.period_s
        self.bad: float | None = None

    def move(self) -> Any:
        bad, self.bad = self.bad, None
        return self.master.move() if bad is None else self.master.cycle.tick(bad)

    def bad_target(self, counts: float) -> None:
        self.bad = counts

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        kind = {"is_extended_id": False, **kind}
        self.intruder.send(can.Message(arbitration_id=can_id, data=data, **kind))

    def hang(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def interface_down(self) -> None:
        self.configure("link", "set", "down", self.interface)

    def interface_deleted(self) -> None:
        self.configure("link", "delete", self.interface)

    def transmit_queue_full(self) -> None:
        raise NotImplementedError("vcan has no queue that fills")

    @property
    def motor_counts(self) -> int:
        return self.node.firmware.motion.motor_counts


@pytest.fixture
def bench(interface, profile, intruder, may_configure, tmp_path, request):
    character = request.param
    own = Path(shutil.copytree(profile, tmp_path / "axis"))
    text = (own / "axis.yaml").read_text()
    option = f"quick_stop_option: {character.quick_stop_option}"
    (own / "axis.yaml").write_text(re.sub("quick_stop_option: [0-9]", option, text))
    with drive_in_a_thread(interface, own, character) as node, master_on(interface, own) as master:
        master.boot()
        master.run(20)
        yield VcanBench(master, node, intruder, may_configure, interface)


KERNEL = {
    Fault.DISCARDED_FRAME,
    Fault.DUPLICATE_TPDO,
    Fault.FOREIGN_SYNC,
    Fault.OWN_ID_ELSEWHERE,
    Fault.OVERRUN,
    Fault.BUS_DOWN,
    *ABOUT_POWER,
}
"""Faults in whose detection the kernel's CAN stack or its clock takes part."""


def of_the_kernel(character: Character, row: Row) -> bool:
    """Returns True if this case differs from the one on the virtual bus enough for every run."""
    return (
        row.fault in KERNEL if character is FRIENDLY else character is RESTLESS and row.fault in ABOUT_POWER
    )


@pytest.mark.parametrize(("bench", "row"), cases_on(VCAN, of_the_kernel), indirect=["bench"])
def test_a_fault_has_its_reaction_in_time(bench: VcanBench, row: Row, request: pytest.FixtureRequest) -> None:
    check(bench, row, request.node.callspec.params["bench"])


def check(bench: VcanBench, row: Row, character: Character) -> None:
    if row.unseen_on(character):
        pytest.skip("nothing that this drive sends shows it")
    power = PowerCount(bench.node)
    try_out(row, bench, VCAN, bench.master.drive.image.heartbeat_timeout_s, character)
    if row.reaction >= Reaction.QUICK_STOP:
        time.sleep(1.0)
        place = bench.motor_counts
        if row.fault is not Fault.BUS_DOWN:
            bench.interfere(0x080)  # the first SYNC of the other program
        time.sleep(0.3)
        assert abs(bench.motor_counts - place) <= 2
        assert power.times <= row.resumptions_on(character), "power without a request"


# ------------------------------------------------------------------ commands on a shared bus


def test_a_bus_of_another_master_is_left_alone(interface: str, profile: Path, intruder: can.BusABC) -> None:
    ended = threading.Event()

    def drive_on() -> None:
        while not ended.wait(0.02):
            intruder.send(can.Message(arbitration_id=0x080, is_extended_id=False))

    other = threading.Thread(target=drive_on, daemon=True)
    other.start()
    with can.Bus(interface="socketcan", channel=interface, ignore_config=True) as witness:
        done = step(profile, interface, 3)
        ended.set()
        other.join()
        sent = {message.arbitration_id for message in iter(lambda: witness.recv(0), None)}
    assert "another master is on this bus" in done.stdout + done.stderr
    assert sent == {0x080}


def test_a_bus_without_the_drive(interface: str, profile: Path) -> None:
    done = step(profile, interface, 4)
    assert "node 1" in done.stderr
    assert "drive.node_id" in done.stderr


def step(profile: Path, interface: str, status: int) -> subprocess.CompletedProcess[str]:
    """Runs ``hdbridge step`` in this process, because in user-mode-linux a new process needs 3 s of CPU time
    to start.
    """
    bus = ("--interface", "socketcan", "--channel", interface)
    return run_here(Path.cwd(), "step", profile, *bus, status=status)
