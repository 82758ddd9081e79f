"""The keeper: starts, monitors and ends the daemon's processes, and does nothing else.

It holds what must outlive a child: the shared memory, the listening sockets, the lock of the CAN interface.

    a child is        the keeper
    ----------------  ----------------------------------------------------------------------------------
    control, dead     restarts it; its axes come up disabled. If it dies too often in a minute, or by
                      SIGTERM from somebody else, the keeper ends the daemon
    control, hung     kills it after `Times.hung_s`; the bus is silent, so the drives have stopped already
    service, dead     restarts it after increasing delays; the loop continues
    service, hung     kills it after `Times.service_hung_s`
    gateway           as the service; its axes brake and lose power because their set-points end

If a child cannot start (the bus cannot be opened, a folder cannot be written), the daemon ends with that
child's exit status.
"""

from __future__ import annotations

import logging
import os
import selectors
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Final

from hdbridge.daemon.child import Child
from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.notify import Notifier
from hdbridge.daemon.patience import BackOff, Budget, Pulse
from hdbridge.daemon.start import Start
from hdbridge.errors import HdbridgeError

_log = logging.getLogger(__name__)
TICK_S: Final = 0.25
_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
_ERRORS: Final = range(2, 16)
"""Exit statuses of an `HdbridgeError`. The child has reported the error, and a restart would only repeat
it."""
_FIRST_ATTEMPTS: Final = 3


@dataclass(frozen=True, slots=True)
class Programs:
    """Programs of the children; tests substitute others."""

    control: Sequence[str] = ("-m", "hdbridge.daemon.loop.process")
    service: Sequence[str] = ("-m", "hdbridge.daemon.serve")
    gateway: Sequence[str] = ("-m", "hdbridge.daemon.gateway.process")


@dataclass(frozen=True, slots=True)
class Times:
    """Time-outs of the keeper, seconds."""

    begin_s: float = 60.0
    """Start of a child."""
    hung_s: float = 5.0
    """A turn of the control process; the drives' own watchdogs act long before."""
    service_hung_s: float = 30.0
    """A sign of life of the service."""
    gateway_hung_s: float = 5.0
    """A sign of life of the gateway."""
    stop_s: float = 30.0
    """Braking of all axes by the control process."""
    service_stop_s: float = 10.0
    """End of the service after that."""


SIMULATED: Final = Times(begin_s=600.0, gateway_hung_s=120.0, stop_s=300.0, service_stop_s=120.0)
"""Time-outs with simulated drives, long enough for a busy computer."""


@dataclass(slots=True)
class _Helper:
    """A process in addition to the control process; restarted after increasing delays, whatever ended it."""

    name: str
    program: Sequence[str]
    listening: tuple[int, ...]
    alive: Cell
    """Cell with the time of its last sign of life."""
    begun: Cell
    """Cell with its process id."""
    hung_s: float
    child: Child | None = None
    due_s: float | None = None
    pulse: Pulse = field(default_factory=Pulse)
    back_off: BackOff = field(default_factory=lambda: BackOff(0.5, 30.0, 60.0))


class Keeper:
    """Keeper of the processes of one machine."""

    def __init__(
        self,
        start: Start,
        memory: Memory,
        listeners: Sequence[socket.socket],
        notifier: Notifier,
        programs: Programs = Programs(),
        times: Times = Times(),
    ) -> None:
        self._start, self._memory, self._listeners = start, memory, listeners
        self._notifier, self._programs, self._times = notifier, programs, times
        self._budget = Budget(start.machine.limits.restarts_per_minute, 60.0)
        self._turns = Pulse()
        self._control: Child | None = None
        api = tuple(each.fileno() for each in listeners)
        self._helpers = [
            _Helper(
                "service", programs.service, api, Cell.SERVICE_TIME_NS, Cell.SERVICE_PID, times.service_hung_s
            )
        ]
        if start.machine.gateway is not None:
            self._helpers.append(
                _Helper(
                    "gateway",
                    programs.gateway,
                    (),
                    Cell.GATEWAY_TIME_NS,
                    Cell.GATEWAY_PID,
                    times.gateway_hung_s,
                )
            )
        self._restarts = {"control": 0, **{each.name: 0 for each in self._helpers}}
        self._ready = False
        self._status = 0
        """Exit status of the daemon."""
        self._signals = self._heeded = 0
        self._stopping_since_s: float | None = None
        self._helpers_told_s: float | None = None
        self._fed_s = 0.0
        self._selector = selectors.DefaultSelector()

    def run(self) -> int:
        """Runs until a signal ends it or it cannot continue; returns the exit status."""
        with ExitStack() as stack:
            stack.callback(self._selector.close)
            stack.enter_context(self._deferred_signals())
            stack.callback(self._end_all)
            now_s = time.monotonic()
            self._start_control(now_s)
            for helper in self._helpers:
                self._start_helper(helper, now_s)
            while self._control is not None or any(
                each.child is not None or each.due_s is not None for each in self._helpers
            ):
                for key, _ in self._selector.select(TICK_S):
                    if key.data is not None:
                        key.data()
                self._turn(time.monotonic())
        return self._status

    def _turn(self, now_s: float) -> None:
        self._memory.status.set(Cell.KEEPER_TIME_NS, time.monotonic_ns())
        self._heed_signals(now_s)
        if self._control is not None and self._control.ended is not None:
            self._control_ended(self._control, now_s)
        for helper in self._helpers:
            if helper.child is not None and helper.child.ended is not None:
                self._helper_ended(helper, helper.child, now_s)
        if self._stopping_since_s is not None:
            self._go_on_stopping(now_s)
            return
        for helper in self._helpers:
            if helper.due_s is not None and now_s >= helper.due_s:
                self._start_helper(helper, now_s)
        self._look_after(now_s)

    # ------------------------------------------------------------------ children

    def _start_control(self, now_s: float) -> None:
        self._control = self._started(self._programs.control, "control", (), now_s)
        self._turns.restart(self._memory.status.loop_count)

    def _start_helper(self, helper: _Helper, now_s: float) -> None:
        helper.due_s = None
        self._memory.status.set(helper.alive, 0)
        helper.child = self._started(helper.program, helper.name, helper.listening, now_s)
        helper.pulse.restart(0)

    def _started(self, program: Sequence[str], name: str, listening: tuple[int, ...], now_s: float) -> Child:
        fd = self._start.hand_over(restarts=self._restarts[name], api_fds=listening)
        try:
            child = Child(program, fd, (self._memory.fd, *listening), now_s)
        finally:
            os.close(fd)
        self._selector.register(child.pidfd, selectors.EVENT_READ)
        _log.info(f"{name} process started", {"pid": child.pid, "restarts": self._restarts[name]})
        return child

    def _forget(self, child: Child) -> None:
        self._selector.unregister(child.pidfd)
        child.close()

    def _control_ended(self, child: Child, now_s: float) -> None:
        status, how = child.ended, child.how
        assert status is not None
        self._forget(child)
        self._control = None
        if self._stopping_since_s is not None:
            self._status = self._status or max(status, 0)
            return
        _log.error("control process died", {"how": how, "lived_s": round(now_s - child.started_s, 1)})
        known = status if status in _ERRORS else HdbridgeError.exit_status
        if status in _ERRORS and not self._memory.status.loop_count:
            self._stop(now_s, known, f"the control process cannot begin ({how})")
        elif not self._budget.spend(now_s):
            self._stop(now_s, known, "the control process dies again and again")
        else:
            self._restarts["control"] += 1
            self._start_control(now_s)

    def _helper_ended(self, helper: _Helper, child: Child, now_s: float) -> None:
        name, status, how = helper.name, child.ended, child.how
        assert status is not None
        self._forget(child)
        helper.child = None
        if self._stopping_since_s is not None:
            return
        lived_s = now_s - child.started_s
        _log.error(f"{name} process died", {"how": how, "lived_s": round(lived_s, 1)})
        self._restarts[name] += 1
        if not self._ready and (status in _ERRORS or self._restarts[name] >= _FIRST_ATTEMPTS):
            known = status if status in _ERRORS else HdbridgeError.exit_status
            self._stop(now_s, known, f"the {name} cannot begin ({how})")
        else:
            helper.due_s = now_s + helper.back_off.delay_s(lived_s)

    def _look_after(self, now_s: float) -> None:
        """Kills hung children; reports readiness, sign of life and status to the service manager."""
        status = self._memory.status
        running = self._turns.look(status.loop_count)
        self._kill_hung(self._control, self._turns, self._times.hung_s)
        serving = True
        for helper in self._helpers:
            helper.pulse.look(status.get(helper.alive))
            self._kill_hung(helper.child, helper.pulse, helper.hung_s)
            serving &= helper.child is not None and status.get(helper.begun) == helper.child.pid
        if not self._ready and self._turns.begun and serving:
            self._ready = True
            self._notifier.ready()
            _log.info("ready", self._facts())
        if running and now_s - self._fed_s >= (self._notifier.watchdog_s or 0.0) / 4.0:
            self._fed_s = now_s
            self._notifier.alive()
        restarts = ", ".join(f"{name} restarted {n} times" for name, n in self._restarts.items() if n)
        axes = ", ".join(axis.name for axis in self._start.machine.axes)
        words = f"holds {axes}" if self._ready else "begins"
        self._notifier.status(f"{words}; {restarts}" if restarts else words)

    def _kill_hung(self, child: Child | None, pulse: Pulse, limit_s: float) -> None:
        if child is not None and pulse.misses * TICK_S >= (limit_s if pulse.begun else self._times.begin_s):
            _log.error("process hangs", {"pid": child.pid, "for_s": pulse.misses * TICK_S})
            child.send(signal.SIGKILL)

    def _facts(self) -> dict[str, object]:
        machine = self._start.machine
        return {
            "machine": machine.name,
            "axes": ", ".join(axis.name for axis in machine.axes),
            "api": ", ".join(_address(each) for each in self._listeners),
        }

    # ------------------------------------------------------------------ the end

    def _heed_signals(self, now_s: float) -> None:
        """Handles signals: the first brakes to rest, the second quick-stops, the third ends everything."""
        while self._heeded < self._signals:
            self._heeded += 1
            if self._heeded == 1:
                self._stop(now_s, 0, "asked to")
            elif self._heeded == 2:
                self._memory.status.set(Cell.STOP_ASKED, 2)
            else:
                self._end_all()

    def _stop(self, now_s: float, status: int, why: str) -> None:
        """Brakes the axes and ends; the service ends last, so that it records the stop."""
        if self._stopping_since_s is not None:
            return
        self._stopping_since_s, self._status = now_s, status
        for helper in self._helpers:
            helper.due_s = None
        _log.info("stopping", {"why": why})
        self._notifier.stopping()
        self._memory.status.set(Cell.STOP_ASKED, 1)

    def _go_on_stopping(self, now_s: float) -> None:
        assert self._stopping_since_s is not None
        if self._control is not None:
            if now_s - self._stopping_since_s > self._times.stop_s:
                _log.error("the axes do not come to rest", {"after_s": self._times.stop_s})
                self._status = self._status or HdbridgeError.exit_status
                self._control.send(signal.SIGKILL)
            return
        remaining = [each for each in self._helpers if each.child is not None]
        number = signal.SIGTERM
        if self._helpers_told_s is None:
            self._helpers_told_s = now_s
        elif now_s - self._helpers_told_s > self._times.service_stop_s:
            number = signal.SIGKILL
        else:
            return
        for helper in remaining:
            assert helper.child is not None
            if number is signal.SIGKILL:
                _log.error(f"the {helper.name} does not end", {"after_s": self._times.service_stop_s})
            helper.child.send(number)

    def _end_all(self) -> None:
        for child in (self._control, *(each.child for each in self._helpers)):
            if child is not None:
                self._forget(child)
        self._control = None
        for helper in self._helpers:
            helper.child = helper.due_s = None

    @contextmanager
    def _deferred_signals(self) -> Iterator[None]:
        """Counts signals and wakes the keeper; signals ignored from the start (nohup) stay ignored."""
        reader, writer = socket.socketpair()
        with reader, writer:
            for each in (reader, writer):
                each.setblocking(False)
            woken = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            self._selector.register(reader, selectors.EVENT_READ, lambda: reader.recv(4096))

            def note(_number: int, _frame: FrameType | None) -> None:
                self._signals += 1

            before = {
                number: signal.signal(number, note)
                for number in _SIGNALS
                if number is signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN
            }
            try:
                yield
            finally:
                for number, handler in before.items():
                    signal.signal(number, handler)
                signal.set_wakeup_fd(woken)


def _address(listener: socket.socket) -> str:
    name = listener.getsockname()
    return name if isinstance(name, str) else f"{name[0]}:{name[1]}"
