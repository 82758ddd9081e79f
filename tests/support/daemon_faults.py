"""What the whole daemon has to survive on a real CAN stack, as rows for `docs/reliability.md`."""

from __future__ import annotations

import json
import os
import signal
import struct
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import can

from hdbridge.drive.states import State, decode
from tests.support.reliability import RECORD, Seen
from tests.support.running import Daemon, gone

DAEMON: Final = "daemon"
"""What stands for the bus in the record."""
NODE: Final = 1
STATE_TPDO: Final = 0x180 + NODE
EMERGENCY: Final = 0x080 + NODE
FAR_DEG: Final = 60.0
SLOW_DEG_S: Final = 2.0
STANDS: Final = 3
"""Cycles in which the motor keeps its place when it stands."""


class Witness:
    """Another node's end of the bus: it only listens, and counts time in cycles of the master."""

    def __init__(self, channel: str, period_s: float) -> None:
        self._bus = can.Bus(interface="socketcan", channel=channel, ignore_config=True)
        self._period_s = period_s
        self._begun_s = time.time()

    def begin(self) -> None:
        """Forget what was heard; count from now on."""
        while self._bus.recv(0) is not None:
            pass
        self._begun_s = time.time()

    def cycles_until(self, met: Callable[[can.Message], bool], most: int) -> int:
        """After how many cycles a frame came, its own included; AssertionError when not within ``most``."""
        while (waited_s := time.time() - self._begun_s) < (most + 1) * self._period_s:
            message = self._bus.recv((most + 1) * self._period_s - waited_s)
            if message is not None and met(message):
                return 1 + int((message.timestamp - self._begun_s) / self._period_s)
        raise AssertionError(f"not within {most} cycles")

    def cycles_until_standing(self, most: int) -> int:
        """The same until the motor stands, by what the drive sends of it."""
        places: list[int] = []

        def standing(message: can.Message) -> bool:
            if message.arbitration_id == STATE_TPDO:
                places.append(struct.unpack_from("<Hi", message.data)[1])
            return len(places) > STANDS and len(set(places[-STANDS - 1 :])) == 1

        return self.cycles_until(standing, most)

    def cycles_until_disabled(self, most: int) -> int:
        """The same until the motor is without power; AssertionError where it was in motion just before."""
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

    def sync(self) -> None:
        """Be another master, once."""
        self._bus.send(can.Message(arbitration_id=0x080, is_extended_id=False))

    def close(self) -> None:
        self._bus.shutdown()


@dataclass
class DaemonBench:
    """A daemon that holds one axis on a real interface, and what can be done to both."""

    daemon: Daemon
    interface: str
    configure: Callable[..., None]
    restart_drive: Callable[[], None]
    period_s: float
    heartbeat_timeout_s: float
    witness: Witness
    target_deg: float = FAR_DEG

    def under_way(self) -> None:
        """The axis moves, slowly and for long, whatever there was before."""
        daemon = self.daemon
        state = daemon.until(
            lambda: daemon.axis().get("state") not in {"", None, "unverified"} and daemon.axis(), "verified"
        )
        if state["state"] in {"latched", "quick-stopped"}:
            daemon.ask("reset")
        if daemon.axis()["state"] != "enabled":
            daemon.until_axis("disabled")
            daemon.ask("enable")
        self.target_deg = -self.target_deg
        daemon.ask("move", target_deg=self.target_deg, velocity_deg_s=SLOW_DEG_S, wait=False)
        daemon.until(lambda: abs(daemon.axis().get("velocity_deg_s") or 0.0) > 0.9 * SLOW_DEG_S, "it moves")
        self.witness.begin()

    def cycles_since(self, cycle: int, kind: str, within: int) -> int:
        """How many cycles after ``cycle`` an event of a kind came; AssertionError when it came later."""
        names = (kind, kind.replace("_", " "))
        event = self.daemon.until(
            lambda: next(
                (each for each in self.daemon.events if each["event"] in names and each["cycle"] >= cycle),
                None,
            ),
            kind,
        )
        taken = int(event["cycle"]) - cycle
        assert taken <= within, f"{kind} after {taken} cycles: {event}"
        return max(taken, 1)


@dataclass(frozen=True)
class DaemonRow:
    """One fault: how it is made and what has to come of it, and within how many cycles."""

    name: str
    expected: str
    within: str
    """In words, for the page."""
    try_out: Callable[[DaemonBench], tuple[str, int, int]]
    """Makes it and checks what comes of it: in words, the cycles that it took, those allowed."""
    last: bool = False
    """It ends the daemon."""


def try_out(row: DaemonRow, bench: DaemonBench) -> None:
    """Make a row's fault on an axis under way, check it, and note what came of it."""
    bench.under_way()
    seen, cycles, allowed = row.try_out(bench)
    assert cycles <= allowed, f"{row.name}: {cycles} cycles, allowed are {allowed}"
    if path := os.environ.get(RECORD):
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(Seen(DAEMON, row.name, seen, cycles, allowed))) + "\n")


# ------------------------------------------------------------------ the bus


def _interface_goes(bench: DaemonBench, back: Callable[[], None], *how: str) -> tuple[str, int, int]:
    daemon = bench.daemon
    processes = daemon.pids("control"), daemon.pids("service")
    cycle = daemon.cycle()
    bench.configure("link", *how, bench.interface)
    cycles = bench.cycles_since(cycle, "bus_down", within=NOTICED)
    daemon.until_axis("latched")
    time.sleep(2.0)
    back()
    bench.witness.close()
    bench.witness = Witness(bench.interface, bench.period_s)
    daemon.until(lambda: "bus up" in daemon.names(), "the bus is opened again")
    daemon.until(lambda: (daemon.state() or {}).get("bus", {}).get("up"), "and it is said")
    daemon.ask("reset")
    axis = daemon.until_axis("disabled")
    assert axis["power"] != "operation enabled"
    assert (daemon.pids("control"), daemon.pids("service")) == processes
    return "latch; opened again, verified, disabled, in the same processes", cycles, NOTICED


def _goes_down(bench: DaemonBench) -> tuple[str, int, int]:
    return _interface_goes(
        bench, lambda: bench.configure("link", "set", "up", bench.interface), "set", "down"
    )


def _is_deleted(bench: DaemonBench) -> tuple[str, int, int]:
    def made_again() -> None:
        bench.configure("link", "add", "dev", bench.interface, "type", "vcan")
        bench.configure("link", "set", "up", bench.interface)
        bench.restart_drive()

    return _interface_goes(bench, made_again, "delete")


def _second_master(bench: DaemonBench) -> tuple[str, int, int]:
    cycle = bench.daemon.cycle()
    bench.witness.sync()
    cycles = bench.cycles_since(cycle, "fault", within=NOTICED)
    axis = bench.daemon.until_axis("quick-stopped")
    assert axis["fault"]["name"] == "FOREIGN_SYNC"
    return "quick stop, latched; the motor stands", cycles, NOTICED


# ------------------------------------------------------------------ the processes


def _drive_stops_by_itself(bench: DaemonBench, number: signal.Signals) -> tuple[int, int]:
    """The control process gets a signal; cycles until the drive has missed its master, and those allowed."""
    allowed = int(bench.heartbeat_timeout_s / bench.period_s) + 2
    bench.witness.begin()
    os.kill(bench.daemon.pids("control")[-1], number)
    return bench.witness.cycles_until(lambda each: each.arbitration_id == EMERGENCY, allowed), allowed


def _control_goes(bench: DaemonBench, number: signal.Signals) -> tuple[str, int, int]:
    daemon = bench.daemon
    controls, services = daemon.pids("control"), daemon.pids("service")
    cycles, allowed = _drive_stops_by_itself(bench, number)
    daemon.until(lambda: len(daemon.pids("control")) > len(controls), "another control process")
    axis = daemon.until_axis("disabled")
    assert axis["power"] != "operation enabled"
    assert daemon.pids("service") == services
    return "the drive stops by itself; another control process, disabled", cycles, allowed


def _control_killed(bench: DaemonBench) -> tuple[str, int, int]:
    return _control_goes(bench, signal.SIGKILL)


def _control_hangs(bench: DaemonBench) -> tuple[str, int, int]:
    return _control_goes(bench, signal.SIGSTOP)


def _jog_runs_out(bench: DaemonBench, number: signal.Signals) -> tuple[int, int]:
    daemon = bench.daemon
    daemon.ask("stop")
    daemon.until(lambda: daemon.axis()["at_rest"], "at rest")
    daemon.ask("jog", velocity_deg_s=-SLOW_DEG_S, timeout_s=JOG_S)
    bench.witness.begin()
    os.kill(daemon.pids("service")[-1], number)
    allowed = int(JOG_S / bench.period_s) + BRAKING
    return bench.witness.cycles_until_standing(allowed), allowed


def _service_killed(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    controls, services = daemon.pids("control"), daemon.pids("service")
    cycles, allowed = _jog_runs_out(bench, signal.SIGKILL)
    daemon.until(lambda: len(daemon.pids("service")) > len(services), "another service")
    daemon.forget_lease()
    assert daemon.until_axis("enabled")["at_rest"]
    assert daemon.pids("control") == controls
    return "the jog runs out; the loop holds the axis; another service finds it enabled", cycles, allowed


def _service_hangs(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    controls, services = daemon.pids("control"), daemon.pids("service")
    cycles, allowed = _jog_runs_out(bench, signal.SIGSTOP)
    os.kill(services[-1], signal.SIGCONT)
    assert daemon.until_axis("enabled")["at_rest"]
    assert (daemon.pids("control"), daemon.pids("service")) == (controls, services)
    return "the jog runs out; the loop holds the axis; the service goes on", cycles, allowed


def _terminal_closed(bench: DaemonBench) -> tuple[str, int, int]:
    bench.witness.begin()
    bench.daemon.process.send_signal(signal.SIGHUP)
    cycles = bench.witness.cycles_until_disabled(IN_ORDER)
    assert bench.daemon.ended() == 0
    assert "emergency" not in bench.daemon.names()
    return "stopped in order, disabled, ended with status 0", cycles, IN_ORDER


def _keeper_killed(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    bench.witness.begin()
    daemon.process.kill()
    cycles = bench.witness.cycles_until_disabled(IN_ORDER)
    daemon.process.wait()
    children = (*daemon.pids("control"), *daemon.pids("service"))
    while not all(gone(pid) for pid in children):
        time.sleep(0.1)
    return "stopped in order; every process ended", cycles, IN_ORDER


NOTICED: Final = 3
"""Cycles from a command of a shell to what the loop says: one for the fault, the others for who looks."""
JOG_S: Final = 0.5
BRAKING: Final = 15
"""Cycles to brake from a slow jog, until it is seen that the motor keeps its place."""
IN_ORDER: Final = 25
"""The same, with the signal's way from process to process."""

DAEMON_ROWS: Final = (
    DaemonRow("the interface goes down, and up again", "latch; verified again, disabled, no restart",
        f"{NOTICED}", _goes_down),
    DaemonRow("the interface is deleted, and made again", "latch; verified again, disabled, no restart",
        f"{NOTICED}", _is_deleted),
    DaemonRow("SYNC of a second master", "quick stop, latched", f"{NOTICED}", _second_master),
    DaemonRow("the control process is killed (-9)", "the drive stops by itself; another process, disabled",
        "two heartbeats", _control_killed),
    DaemonRow("the control process hangs (SIGSTOP)", "the drive stops by itself; another process, disabled",
        "two heartbeats", _control_hangs),
    DaemonRow("the service is killed (-9) in a jog", "the loop goes on, the jog runs out; another service",
        "the jog's time-out", _service_killed),
    DaemonRow("the service hangs (SIGSTOP) in a jog", "the loop goes on, the jog runs out",
        "the jog's time-out", _service_hangs),
    DaemonRow("the terminal is closed (SIGHUP)", "stop in order, end", f"{IN_ORDER}", _terminal_closed,
        last=True),
    DaemonRow("the keeper is killed (-9)", "stop in order, end", f"{IN_ORDER}", _keeper_killed, last=True),
)  # fmt: skip
