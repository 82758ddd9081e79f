"""Every fault of the reliability table on a real Linux CAN stack, and the manners of the commands there."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.clock import MonotonicClock
from hdbridge.drive.supervision import Reaction
from hdbridge.errors import BusError
from hdbridge.sim.lockstep import nameplate_of
from hdbridge.sim.machine import Machine
from hdbridge.sim.node import SimulatedDrive
from hdbridge.sim.run import run
from hdbridge.sim.truth import Truth
from tests.support.command import run_here
from tests.support.reliability import VCAN, Row, rows_of, try_out


@contextmanager
def drive_in_a_thread(interface: str, profile: Path) -> Iterator[SimulatedDrive]:
    """The simulated drive on a socket of its own, with its fault injector within reach."""
    axis, truth = AxisConfig.load(profile), Truth.load(profile)
    ended = threading.Event()
    with can.Bus(interface="socketcan", channel=interface, ignore_config=True) as bus:
        clock = MonotonicClock()
        node = SimulatedDrive(bus, Machine(truth, 0), axis.eds_path, 1, clock, nameplate_of(truth))

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
    node: SimulatedDrive
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
def bench(
    interface: str,
    profile: Path,
    another_master: Callable[..., AbstractContextManager[Any]],
    intruder: can.BusABC,
    may_configure: Callable[..., None],
) -> Iterator[VcanBench]:
    with drive_in_a_thread(interface, profile) as node, another_master(interface) as master:
        master.boot()
        master.run(20)
        yield VcanBench(master, node, intruder, may_configure, interface)


@pytest.mark.parametrize("row", rows_of(VCAN), ids=lambda row: row.name)
def test_a_fault_has_its_reaction_in_time(bench: VcanBench, row: Row) -> None:
    try_out(row, bench, VCAN, bench.master.drive.image.heartbeat_timeout_s)
    if row.reaction >= Reaction.QUICK_STOP:
        time.sleep(1.0)
        place = bench.motor_counts
        time.sleep(0.3)
        assert abs(bench.motor_counts - place) <= 2


# ------------------------------------------------------------------ manners


@pytest.mark.parametrize("command", ["step", "doctor", "scan", "run"])
def test_a_bus_that_another_master_has_is_left_alone(
    command: str,
    interface: str,
    profile: Path,
    intruder: can.BusABC,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for each in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(each, str(tmp_path))
    ended = threading.Event()

    def drive_on() -> None:
        while not ended.wait(0.02):
            intruder.send(can.Message(arbitration_id=0x080, is_extended_id=False))

    other = threading.Thread(target=drive_on, daemon=True)
    other.start()
    with can.Bus(interface="socketcan", channel=interface, ignore_config=True) as witness:
        # In user-mode-linux a process takes 3 s of processor time to begin; the daemon consists of several.
        done = (hdbridge if command == "run" else hdbridge_here)(command, profile, interface)
        ended.set()
        other.join()
        sent = {message.arbitration_id for message in iter(lambda: witness.recv(0), None)}
    assert "somebody else masters this bus" in done.stdout + done.stderr
    assert done.returncode == (4 if command == "doctor" else 3), done.stderr
    assert sent == {0x080}


def test_one_master_of_an_interface_at_a_time(
    interface: str, profile: Path, another_master: Callable[..., AbstractContextManager[Any]]
) -> None:
    with another_master(interface):
        done = hdbridge("step", profile, interface)
    assert done.returncode == 3
    assert f"socketcan:{interface}: another hdbridge on this machine masters it" in done.stderr


def test_a_bus_without_the_drive(interface: str, profile: Path) -> None:
    done = hdbridge_here("step", profile, interface)
    assert done.returncode == 4
    assert "node 1" in done.stderr
    assert "drive.node_id" in done.stderr


def hdbridge(command: str, profile: Path, interface: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hdbridge", *arguments(command, profile, interface)],
        capture_output=True, text=True, timeout=120, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip


def hdbridge_here(command: str, profile: Path, interface: str) -> subprocess.CompletedProcess[str]:
    """The same in this process."""
    return run_here(Path.cwd(), *arguments(command, profile, interface))


def arguments(command: str, profile: Path, interface: str) -> list[str]:
    return [command, str(profile), "--interface", "socketcan", "--channel", interface]
