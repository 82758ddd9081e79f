"""Bench for the fault rows of a whole daemon on a real CAN stack: its cable, its listener, its recovery."""

import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import can
import pytest

from hdbridge.drive.states import State, decode
from support.reliability import DAEMON_VCAN, Seen, record
from support.running import Daemon

OURS, THEIRS = "hdvx0", "hdvx1"
"""Ends of the cable: the daemon's and the drive's."""
NODE: Final = 1
STATE_TPDO: Final = 0x180 + NODE
EMERGENCY: Final = 0x080 + NODE
FAR_DEG: Final = 60.0
SLOW_DEG_S: Final = 2.0
STANDS: Final = 3
"""Cycles without motion after which the motor counts as standing still."""


class Cable:
    """A vxcan pair with the simulated drive at its far end; the ends can be disturbed separately."""

    def __init__(self, profile: Path) -> None:
        self._profile = profile
        self._drive: subprocess.Popen[str] | None = None

    def plug(self) -> None:
        """Makes the pair and the drive; skips the test if the kernel or the user's rights do not allow it."""
        made = _run("ip", "link", "add", "dev", OURS, "type", "vxcan", "peer", "name", THEIRS)
        if made.returncode:
            pytest.skip(f"no vxcan pair: {made.stderr.strip()}")
        for end in (THEIRS, OURS):
            self.up(end)
        self._drive = subprocess.Popen(
            [sys.executable, "-m", "hdbridge", "simulate", str(self._profile),
             "--interface", "socketcan", "--channel", THEIRS],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._drive.stderr is not None
        assert "simulated drive: node" in self._drive.stderr.readline()

    def unplug(self) -> None:
        """Deletes the pair and ends the drive."""
        if self._drive is not None:
            self._drive.kill()
            self._drive.wait()
            assert self._drive.stderr is not None
            self._drive.stderr.close()
            self._drive = None
        _run("ip", "link", "delete", OURS)

    def down(self, end: str = OURS) -> None:
        assert _run("ip", "link", "set", "down", end).returncode == 0

    def up(self, end: str = OURS) -> None:
        assert _run("ip", "link", "set", "up", end).returncode == 0

    @contextmanager
    def spoilt(self, end: str, *how: str) -> Iterator[None]:
        """Loses, doubles or delays frames that leave an end (tc-netem); skips if the kernel cannot."""
        done = _run("tc", "qdisc", "replace", "dev", end, "root", "netem", *how)
        if done.returncode:
            pytest.skip(f"no netem: {done.stderr.strip()}")
        try:
            yield
        finally:
            _run("tc", "qdisc", "delete", "dev", end, "root")


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    if shutil.which(command[0]) is None:
        pytest.skip(f"no program {command[0]}")
    return subprocess.run(command, check=False, capture_output=True, text=True)


class Witness:
    """Passive node on the bus; measures time in cycles of the master."""

    def __init__(self, channel: str, period_s: float) -> None:
        self._bus = can.Bus(interface="socketcan", channel=channel, ignore_config=True)
        self._period_s = period_s
        self._begun_s = time.time()

    def begin(self) -> None:
        """Discards received frames and starts counting."""
        while self._bus.recv(0) is not None:
            pass
        self._begun_s = time.time()

    def cycles_until(self, met: Callable[[can.Message], bool], most: int) -> int:
        """Returns the cycles up to and including that of a frame; AssertionError after ``most``."""
        while (waited_s := time.time() - self._begun_s) < (most + 1) * self._period_s:
            message = self._bus.recv((most + 1) * self._period_s - waited_s)
            if message is not None and met(message):
                return 1 + int((message.timestamp - self._begun_s) / self._period_s)
        raise AssertionError(f"not within {most} cycles")

    def cycles_until_standing(self, most: int) -> int:
        """Returns the cycles until the motor stands still, by the drive's TPDO."""
        places: list[int] = []

        def standing(message: can.Message) -> bool:
            if message.arbitration_id == STATE_TPDO:
                places.append(struct.unpack_from("<Hi", message.data)[1])
            return len(places) > STANDS and len(set(places[-STANDS - 1 :])) == 1

        return self.cycles_until(standing, most)

    def cycles_until_disabled(self, most: int) -> int:
        """Returns the cycles until the motor has no power; AssertionError if it was in motion just before."""
        places: list[int] = []

        def disabled(message: can.Message) -> bool:
            if message.arbitration_id != STATE_TPDO:
                return False
            status, place = struct.unpack_from("<Hi", message.data)
            places.append(place)
            return decode(status) is not State.OPERATION_ENABLED

        cycles = self.cycles_until(disabled, most)
        assert len(places) < 3 or max(places[-3:]) - min(places[-3:]) <= 2, f"power off in motion: {places}"
        return cycles

    def send(self, can_id: int, data: bytes = b"", *, is_error_frame: bool = False) -> None:
        """Sends a frame as another node."""
        self._bus.send(
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=is_error_frame)
        )

    def close(self) -> None:
        self._bus.shutdown()


@dataclass(frozen=True)
class Made:
    """Cycles before a fault was made, and after it."""

    begun: int
    done: int


@dataclass
class DaemonBench:
    """Daemon with one axis on a real interface, and the means to disturb both."""

    daemon: Daemon
    cable: Cable
    disk: Path
    """Folder of its recordings."""
    period_s: float
    heartbeat_timeout_s: float
    witness: Witness
    target_deg: float = FAR_DEG
    since: int = 0
    """Newest event before the axis was under way."""

    def look_again(self) -> None:
        """Listens again after the far end of the cable was replaced."""
        self.witness.close()
        self.witness = Witness(THEIRS, self.period_s)

    def under_way(self) -> None:
        """Starts a long slow motion of the axis, from any state."""
        daemon = self.daemon
        state = daemon.until(
            lambda: (
                (found := daemon.axis()).get("state") in {"disabled", "enabled", "quick-stopped"} and found
            ),
            "verified",
        )
        if state["state"] == "quick-stopped":
            daemon.ask("reset")
        if daemon.axis()["state"] != "enabled":
            daemon.until_axis("disabled")
            daemon.ask("enable")
        self.target_deg = -self.target_deg
        self.since = daemon.newest_event()
        daemon.ask("move", target_deg=self.target_deg, velocity_deg_s=SLOW_DEG_S, wait=False)
        daemon.until(lambda: abs(daemon.axis().get("velocity_deg_s") or 0.0) > 0.9 * SLOW_DEG_S, "it moves")
        self.witness.begin()

    def reported(self, made: Made, kind: str, within: int, words: str = "", reaction: str = "") -> int:
        """Returns the cycles from a fault until its event; AssertionError if it took more than ``within``."""

        def found() -> dict[str, Any] | None:
            for each in self.daemon.events_since(self.since):
                wanted = each["kind"] == kind and (each["cycle"] or 0) >= made.begun
                if wanted and each["text"].startswith(words) and each["text"].endswith(reaction):
                    return each
            return None

        event = self.daemon.until(found, f"{kind} {words}")
        taken = int(event["cycle"]) - made.done
        assert taken <= within, f"{kind} after {taken} cycles: {event}"
        return max(taken, 1)

    def made(self, fault: Callable[[], object]) -> Made:
        """Makes a fault; a program that does it may need some cycles to begin."""
        begun = self.daemon.cycle()
        fault()
        return Made(begun, self.daemon.cycle())

    def stopped(self, state: str, fault: str) -> None:
        """Checks that clients see the axis stopped in this state, for this fault."""
        axis = self.daemon.until_axis(state)
        assert axis["fault"]["name"] == fault, axis["fault"]

    def goes_on(self, cycles: int = 50) -> None:
        """Checks that the axis keeps moving for this number of cycles."""
        first = self.daemon.cycle()
        axis = self.daemon.until(
            lambda: self.daemon.cycle() > first + cycles and self.daemon.axis(), "the cycle goes on"
        )
        assert axis["state"] == "enabled", axis
        assert abs(axis["velocity_deg_s"]) > 0.9 * SLOW_DEG_S


@dataclass(frozen=True)
class DaemonRow:
    """One fault, with its expected effect and the number of cycles allowed."""

    name: str
    expected: str
    within: str
    """Time limit in words, for the page."""
    try_out: Callable[[DaemonBench], tuple[str, int, int]]
    """Makes the fault and checks its effect; returns it in words, the cycles it took, and those allowed."""
    last: bool = False
    """True if it ends the daemon."""
    slow: bool = False
    """True if neither kernel nor clock has a part in it. In every run it is made without them: on the virtual
    bus, or to the processes of a daemon of simulated drives.
    """


def try_out(row: DaemonRow, bench: DaemonBench) -> None:
    """Makes a row's fault on an axis under way, checks its effect and records it."""
    bench.under_way()
    seen, cycles, allowed = row.try_out(bench)
    assert cycles <= allowed, f"{row.name}: {cycles} cycles, allowed are {allowed}"
    record(Seen(DAEMON_VCAN, row.name, seen, cycles, allowed))
