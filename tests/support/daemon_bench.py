"""Bench for the fault rows of a whole daemon on a real CAN stack, with its cable and a listening node."""

import shutil
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import can
import pytest

from hdbridge.drive.states import State, decode
from support.command import started
from support.reliability import DAEMON_VCAN, Seen, record
from support.running import Daemon

OURS, THEIRS = "hdvx0", "hdvx1"
"""Interfaces at the ends of the cable: the daemon's and the drive's."""
NODE: Final = 1
STATE_TPDO: Final = 0x180 + NODE
EMERGENCY: Final = 0x080 + NODE
NMT: Final = 0x000
SDO_REQUEST, SDO_ANSWER = 0x600 + NODE, 0x580 + NODE
MASTER_LOST: Final = frozenset({0x8130, 0x8250, 0x8700})
"""EMCY codes of a lost master: heartbeat, RPDO, SYNC."""
ANSWERED: Final = 10
"""Maximum cycles until the drive answers an SDO request."""
FAR_DEG: Final = 60.0
SLOW_DEG_S: Final = 2.0
STANDS: Final = 3
"""Cycles without motion after which the motor counts as standing still."""


class Cable:
    """Pair of vxcan interfaces with the simulated drive at one end; each end can be disturbed separately."""

    def __init__(self, profile: Path) -> None:
        self._profile = profile
        self._drive: subprocess.Popen[str] | None = None

    def plug(self) -> None:
        """Creates the pair and starts the drive; skips the test if kernel or permissions do not allow it."""
        made = _run("ip", "link", "add", "dev", OURS, "type", "vxcan", "peer", "name", THEIRS)
        if made.returncode:
            pytest.skip(f"no vxcan pair: {made.stderr.strip()}")
        for end in (THEIRS, OURS):
            self.up(end)
        bus = ("--interface", "socketcan", "--channel", THEIRS)
        self._drive = started(Path.cwd(), "simulate", self._profile, *bus, stdout=subprocess.DEVNULL)
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
        """Drops, duplicates or delays frames that leave an end (tc-netem); skips the test without netem."""
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
    """Node that listens on the bus, and measures time in cycles of the master."""

    def __init__(self, bus: can.BusABC, period_s: float, now: Callable[[], float] = time.time) -> None:
        """``now`` is the clock of the bus's time stamps, s."""
        self._bus = bus
        self._period_s = period_s
        self._now = now
        self._begun_s = now()

    @classmethod
    def on(cls, channel: str, period_s: float) -> Self:
        """Opens a SocketCAN interface."""
        return cls(can.Bus(interface="socketcan", channel=channel, ignore_config=True), period_s)

    def begin(self) -> None:
        """Discards the received frames and starts to count cycles."""
        while self._bus.recv(0) is not None:
            pass
        self._begun_s = self._now()

    def cycles_until(self, met: Callable[[can.Message], bool], most: int) -> int:
        """Returns the number of cycles until a frame meets the condition; AssertionError after ``most``."""
        while (waited_s := self._now() - self._begun_s) < (most + 1) * self._period_s:
            message = self._bus.recv((most + 1) * self._period_s - waited_s)
            if message is not None and met(message):
                return 1 + int((message.timestamp - self._begun_s) / self._period_s)
        raise AssertionError(f"not within {most} cycles")

    def cycles_until_standing(self, most: int) -> int:
        """Returns the number of cycles until the drive's TPDO shows that the motor stands still."""
        places: list[int] = []

        def standing(message: can.Message) -> bool:
            if message.arbitration_id == STATE_TPDO:
                places.append(struct.unpack_from("<Hi", message.data)[1])
            return len(places) > STANDS and len(set(places[-STANDS - 1 :])) == 1

        return self.cycles_until(standing, most)

    def cycles_until_disabled(self, most: int) -> int:
        """Returns the number of cycles until power is off; AssertionError if the motor moved just before."""
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

    def cycles_until_own_stop(self, most: int) -> int:
        """Returns the number of cycles until the drive has stopped by its own supervision.

        The drive must report a lost master without an NMT command before it, and must then be out of
        *operation enabled*. AssertionError otherwise.
        """

        def reports(message: can.Message) -> bool:
            assert message.arbitration_id != NMT, "a master commands the drive"
            code = int.from_bytes(message.data[:2], "little")
            return message.arbitration_id == EMERGENCY and code in MASTER_LOST

        cycles = self.cycles_until(reports, most)
        state = decode(self._read_statusword(most + ANSWERED))
        assert state is not State.OPERATION_ENABLED, "the drive reports a lost master but does not stop"
        return cycles

    def _read_statusword(self, most: int) -> int:
        """Reads 6041h by SDO; AssertionError if no answer arrives in ``most`` cycles."""
        answers: list[int] = []

        def answer(message: can.Message) -> bool:
            if message.arbitration_id == SDO_ANSWER and message.data[1:4] == b"\x41\x60\x00":
                answers.append(int.from_bytes(message.data[4:6], "little"))
            return bool(answers)

        self.send(SDO_REQUEST, b"\x40\x41\x60\x00\0\0\0\0")
        self.cycles_until(answer, most)
        return answers[0]

    def send(self, can_id: int, data: bytes = b"", *, is_error_frame: bool = False) -> None:
        """Sends a frame as another node."""
        self._bus.send(
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=is_error_frame)
        )

    def close(self) -> None:
        self._bus.shutdown()


@dataclass(frozen=True)
class Made:
    """Numbers of the cycles just before and just after a fault was made."""

    begun: int
    done: int


@dataclass
class DaemonBench:
    """Daemon with one axis on a real interface, and methods to disturb both."""

    daemon: Daemon
    cable: Cable
    disk: Path
    """Folder of the daemon's recordings."""
    period_s: float
    heartbeat_timeout_s: float
    witness: Witness
    target_deg: float = FAR_DEG
    since: int = 0
    """Number of the newest event before the axis was set in motion."""

    def look_again(self) -> None:
        """Replaces the listening node after the far end of the cable was replaced."""
        self.witness.close()
        self.witness = Witness.on(THEIRS, self.period_s)

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
        """Returns the number of cycles from a fault to its event; AssertionError for more than ``within``."""

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
        """Makes a fault; returns the cycles before and after, because a program may need some cycles."""
        begun = self.daemon.cycle()
        fault()
        return Made(begun, self.daemon.cycle())

    def stopped(self, state: str, fault: str) -> None:
        """Checks that the API reports the axis as stopped in this state, because of this fault."""
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
    """Makes the fault and checks its effect; returns the effect in words, and cycles taken and allowed."""
    last: bool = False
    """True if the fault ends the daemon."""
    slow: bool = False
    """True if the fault involves neither kernel nor clock. It is then made in every run without them: on the
    virtual bus, or to the processes of a daemon of simulated drives.
    """


def try_out(row: DaemonRow, bench: DaemonBench) -> None:
    """Makes a row's fault on an axis in motion, checks its effect and records the result."""
    bench.under_way()
    seen, cycles, allowed = row.try_out(bench)
    assert cycles <= allowed, f"{row.name}: {cycles} cycles, allowed are {allowed}"
    record(Seen(DAEMON_VCAN, row.name, seen, cycles, allowed))
