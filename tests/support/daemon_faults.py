"""Faults that the whole daemon must survive on a real CAN stack, as rows for `docs/reliability.md`."""

import os
import signal
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Final

import pytest

from hdbridge.drive.supervision import Fault
from support.command import run_apart
from support.daemon_bench import OURS, SLOW_DEG_S, THEIRS, DaemonBench, DaemonRow
from support.running import folders_in, gone

CAN_ERR_BUSOFF: Final = 0x40
"""Bus-off bit of an error frame's identifier (linux/can/error.h)."""

# ------------------------------------------------------------------ the bus


def _is_back(bench: DaemonBench) -> None:
    """Checks that the same processes reopen the bus and verify the drive, with the axis disabled."""
    daemon = bench.daemon
    daemon.until(lambda: (daemon.state() or {}).get("bus", {}).get("up"), "the bus is opened again")
    axis = daemon.until_axis("disabled")
    assert axis["power"] != "operation enabled"


def _bus_goes(
    bench: DaemonBench,
    goes: Callable[[], None],
    comes: Callable[[], None] = lambda: None,
    pause_s: float = 2.0,
) -> tuple[str, int, int]:
    daemon = bench.daemon
    processes = daemon.pids("control"), daemon.pids("service")
    cycles = bench.reported(bench.made(goes), "bus-down", NOTICED)
    if pause_s:
        bench.stopped("latched", "BUS_DOWN")
        time.sleep(pause_s)
    comes()
    _is_back(bench)
    assert (daemon.pids("control"), daemon.pids("service")) == processes
    return "latch; opened again, verified, disabled, in the same processes", cycles, NOTICED


def _is_deleted(bench: DaemonBench) -> tuple[str, int, int]:
    def made_again() -> None:
        bench.cable.plug()
        bench.look_again()

    return _bus_goes(bench, bench.cable.unplug, made_again)


def _bus_off(bench: DaemonBench) -> tuple[str, int, int]:
    return _bus_goes(
        bench, lambda: bench.witness.send(CAN_ERR_BUSOFF, bytes(8), is_error_frame=True), pause_s=0.0
    )


def _stops(bench: DaemonBench, fault: str, end: str, how: Sequence[str]) -> tuple[str, int, int]:
    """Disturbs the frames that leave an end of the cable until the axis has stopped."""
    with ExitStack() as spoilt:
        made = bench.made(lambda: spoilt.enter_context(bench.cable.spoilt(end, *how)))
        cycles = bench.reported(made, "fault", NOTICED, Fault[fault].value, "quick stop")
        bench.stopped("quick-stopped", fault)
        time.sleep(1.0)
    return "quick stop, latched", cycles, NOTICED


def _pulled(bench: DaemonBench) -> tuple[str, int, int]:
    with bench.cable.spoilt(OURS, "loss", "100%"):
        return _stops(bench, "LOST_TPDO", THEIRS, ("loss", "100%"))


def _delayed(bench: DaemonBench) -> tuple[str, int, int]:
    # Frames arrive after the window and before the next SYNC; later ones would count for the next SYNC.
    return _stops(bench, "LOST_TPDO", THEIRS, ("delay", f"{900 * bench.period_s:.0f}ms"))


def _doubled(bench: DaemonBench) -> tuple[str, int, int]:
    bench.goes_on(60)  # faults without a reaction are reported at most once a second
    with ExitStack() as spoilt:
        made = bench.made(lambda: spoilt.enter_context(bench.cable.spoilt(THEIRS, "duplicate", "100%")))
        cycles = bench.reported(made, "fault", NOTICED, Fault.DUPLICATE_TPDO.value, "go")
        bench.goes_on()
    return "counted; the axis goes on", cycles, NOTICED


def _reordered(bench: DaemonBench) -> tuple[str, int, int]:
    with bench.cable.spoilt(THEIRS, "delay", "3ms", "reorder", "50%"):
        bench.goes_on()
    return "the axis goes on", 0, 0


def _second_master(bench: DaemonBench) -> tuple[str, int, int]:
    made = bench.made(lambda: bench.witness.send(0x080))
    cycles = bench.reported(made, "fault", NOTICED, Fault.FOREIGN_SYNC.value, "quick stop")
    bench.stopped("quick-stopped", "FOREIGN_SYNC")
    return "quick stop, latched; the motor stands", cycles, NOTICED


def _node_reset(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    processes = daemon.pids("control"), daemon.pids("service")
    made = bench.made(lambda: bench.witness.send(0x000, bytes([0x81, 0x01])))
    bench.reported(made, "fault", NOTICED, Fault.OWN_ID_ELSEWHERE.value, "quick stop")
    cycles = bench.reported(made, "fault", NOTICED, Fault.BOOT_UP.value, "latch")
    _is_back(bench)
    assert (daemon.pids("control"), daemon.pids("service")) == processes
    return "quick stop, latch; verified again, disabled", cycles, NOTICED


# ------------------------------------------------------------------ around it


def _clock_step(bench: DaemonBench) -> tuple[str, int, int]:
    if os.environ.get("SOCKETCAN_KERNEL") != "user-mode-linux":
        pytest.skip("sets the clock: only in user-mode-linux, not on this machine")
    for step_s in (-86_400.0, 86_400.0):
        time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + step_s)
        bench.goes_on(20)
    return "no effect", 0, 0


def _disk_full(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon

    def recorder() -> dict[str, object]:
        return dict((daemon.state() or {}).get("recorder") or {})

    filler = bench.disk / "filler"
    with filler.open("wb", buffering=0) as file:
        while True:
            try:
                file.write(bytes(65_536))
            except OSError:
                break
    daemon.until(lambda: recorder().get("dropped"), "the recorder drops")
    assert recorder()["note"]
    bench.goes_on(20)
    filler.unlink()
    return "the recorder drops and says so; the loop goes on", 0, 0


def _hostile(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    before = daemon.state()["cycle"]["skipped"]  # type: ignore[index]
    mute = []
    for number in range(40):
        client = socket.socket(socket.AF_UNIX)
        client.connect(str(daemon.socket))
        if number % 2:
            client.send(bytes(range(256)) * 8)
        mute.append(client)
    for body in (b"POST /api/v1/axes/article/move HTTP/1.1\r\nHost: x\r\nContent-Length: 999999999\r\n\r\n{",
                 b"GET /" + bytes(200_000)):  # fmt: skip
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(daemon.socket))
            client.settimeout(1.0)
            with suppress(OSError):
                client.sendall(body)
    bench.goes_on()
    for client in mute:
        client.close()
    skipped = daemon.state()["cycle"]["skipped"] - before  # type: ignore[index]
    return "the API goes on, and the loop; no cycle is missed", skipped, 0


def _second_daemon(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    other = daemon.folder / "other"
    other.mkdir(exist_ok=True)
    done = run_apart(daemon.folder, "run", *daemon.arguments, env=folders_in(other), status=3)
    assert "another hdbridge on this machine masters it" in done.stderr
    bench.goes_on(20)
    return "refused with exit status 3; the first goes on", 0, 0


# ------------------------------------------------------------------ the processes


def _drive_stops_by_itself(bench: DaemonBench, number: signal.Signals) -> tuple[int, int]:
    """Sends a signal to the control process; returns the number of cycles until the drive has stopped by its
    own supervision, and the number allowed.
    """
    allowed = int(bench.heartbeat_timeout_s / bench.period_s) + 2
    bench.witness.begin()
    os.kill(bench.daemon.pids("control")[-1], number)
    return bench.witness.cycles_until_own_stop(allowed), allowed


def _control_goes(bench: DaemonBench, number: signal.Signals) -> tuple[str, int, int]:
    daemon = bench.daemon
    controls, services = daemon.pids("control"), daemon.pids("service")
    cycles, allowed = _drive_stops_by_itself(bench, number)
    daemon.until(lambda: len(daemon.pids("control")) > len(controls), "another control process")
    axis = daemon.until_axis("disabled")
    assert axis["power"] != "operation enabled"
    assert daemon.pids("service") == services
    return "the drive stops on its own; another control process, disabled", cycles, allowed


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
    assert (
        daemon.until(lambda: daemon.axis().get("at_rest") and daemon.axis(), "at rest")["state"] == "enabled"
    )
    assert (daemon.pids("control"), daemon.pids("service")) == (controls, services)
    return "the jog runs out; the loop holds the axis; the service goes on", cycles, allowed


def _keeper_hangs(bench: DaemonBench) -> tuple[str, int, int]:
    daemon = bench.daemon
    processes = daemon.pids("control"), daemon.pids("service")
    daemon.process.send_signal(signal.SIGSTOP)
    bench.goes_on()
    daemon.process.send_signal(signal.SIGCONT)
    bench.goes_on(20)
    assert (daemon.pids("control"), daemon.pids("service")) == processes
    return "the axis goes on; nobody is started again", 0, 0


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
"""Maximum cycles from a shell command to the loop's report: one for the fault, two for the observer."""
JOG_S: Final = 0.5
BRAKING: Final = 15
"""Maximum cycles to brake from a slow jog, until the motor is seen to stand still."""
IN_ORDER: Final = 25
"""Maximum cycles to brake, including the time for the signal to pass between processes."""

_SAME: Final = "latch; verified again, disabled, no restart"
_BY_ITSELF: Final = "the drive stops on its own; another process, disabled"

DAEMON_ROWS: Final = (
    DaemonRow("the interface goes down, and up again", _SAME, f"{NOTICED}",
        lambda bench: _bus_goes(bench, bench.cable.down, bench.cable.up)),
    DaemonRow("the interface is deleted, and made again", _SAME, f"{NOTICED}", _is_deleted),
    DaemonRow("the controller goes bus-off (its error frame)", _SAME, f"{NOTICED}", _bus_off),
    DaemonRow("the cable is pulled, and plugged again", "quick stop, latched", f"{NOTICED}", _pulled),
    DaemonRow("every frame of the drive is lost", "quick stop, latched", f"{NOTICED}",
        partial(_stops, fault="LOST_TPDO", end=THEIRS, how=("loss", "100%")), slow=True),
    DaemonRow("every frame of the drive comes after its window", "quick stop, latched", f"{NOTICED}",
        _delayed),
    DaemonRow("every frame of the drive comes twice", "continue, count", f"{NOTICED}", _doubled, slow=True),
    DaemonRow("the drive's frames swap places within the cycle", "continue", "0", _reordered),
    DaemonRow("the transmit queue is full (ENOBUFS)", "quick stop, latched", f"{NOTICED}",
        partial(_stops, fault="TRANSMIT_FULL", end=OURS, how=("delay", "100s", "limit", "1"))),
    DaemonRow("SYNC of a second master", "quick stop, latched", f"{NOTICED}", _second_master, slow=True),
    DaemonRow("NMT reset of the drive by a second master", "quick stop, latch; verified again, disabled",
        f"{NOTICED}", _node_reset, slow=True),
    DaemonRow("a second daemon is started on the interface", "refused; the first continues", "0",
        _second_daemon, slow=True),
    DaemonRow("the wall clock is set back and forth by a day", "no effect", "0", _clock_step),
    DaemonRow("the recorder's disk is full", "the recorder drops; the loop continues", "0", _disk_full,
        slow=True),
    DaemonRow("clients silent or sending garbage", "the loop continues; no cycle is missed", "0", _hostile,
        slow=True),
    DaemonRow("the control process is killed (-9)", _BY_ITSELF, "two heartbeats",
        partial(_control_goes, number=signal.SIGKILL)),
    DaemonRow("the control process hangs (SIGSTOP)", _BY_ITSELF, "two heartbeats",
        partial(_control_goes, number=signal.SIGSTOP),
        slow=True),
    DaemonRow("the service is killed (-9) in a jog", "the loop continues, the jog runs out; another service",
        "the jog's time-out", _service_killed),
    DaemonRow("the service hangs (SIGSTOP) in a jog", "the loop continues, the jog runs out",
        "the jog's time-out", _service_hangs, slow=True),
    DaemonRow("the keeper hangs (SIGSTOP)", "the loop continues", "0", _keeper_hangs, slow=True),
    DaemonRow("the terminal is closed (SIGHUP)", "stop in order, end", f"{IN_ORDER}", _terminal_closed,
        last=True, slow=True),
    DaemonRow("the keeper is killed (-9)", "stop in order, end", f"{IN_ORDER}", _keeper_killed, last=True),
)  # fmt: skip
