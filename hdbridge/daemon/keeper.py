"""The keeper: starts, monitors and ends the daemon's processes, and does nothing else.

It owns the resources that must outlive a child: shared memory, listening sockets, lock of the CAN interface.

    a child is        the keeper
    ----------------  ----------------------------------------------------------------------------------
    control, dead     restarts it, even after a SIGTERM to it alone; its axes come up disabled. If it dies
                      too often in a minute, the keeper ends the daemon
    control, hung     kills it after `Times.hung_s`; the bus is silent, so the drives have stopped already
    service, dead     restarts it after increasing delays; the control loop continues
    service, hung     kills it after `Times.service_hung_s`
    gateway           same as the service; its axes brake and lose power because their set-points end

The bus can be lent to another program of this computer. On the service's request the control process stops
its axes and ends, and the keeper releases the lock of the interface. The program that acquires the lock has
the bus. When the lock is free again, the keeper acquires it and starts a control process, whose axes come up
disabled.

If a child cannot start (the bus cannot be opened, a folder cannot be written), the daemon ends with that
child's exit status.
"""

import logging
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType
from typing import Final, Self

from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.start import Start
from hdbridge.drive.interfacelock import InterfaceLock
from hdbridge.errors import BusInUseError, HdbridgeError

_log = logging.getLogger(__name__)
TICK_S: Final = 0.25
_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
_ERRORS: Final = range(2, 16)
"""Exit statuses of an `HdbridgeError`. The child has reported the error, and a restart would only repeat
it."""
_MAX_START_ATTEMPTS: Final = 3
PATIENCE_S: Final = 1.0
"""Maximum wait if the service manager's queue is full, for messages that must not be lost."""


@dataclass(frozen=True, slots=True)
class Programs:
    """Programs of the children; replaced in tests."""

    control: Sequence[str] = ("-m", "hdbridge.daemon.loop.process")
    service: Sequence[str] = ("-m", "hdbridge.daemon.serve")
    gateway: Sequence[str] = ("-m", "hdbridge.daemon.gateway.process")


@dataclass(frozen=True, slots=True)
class Times:
    """Time-outs of the keeper, seconds."""

    begin_s: float = 60.0
    """Maximum duration of a child's start-up."""
    hung_s: float = 5.0
    """Maximum time without a completed cycle of the control process; the drives' own watchdogs act much
    earlier."""
    service_hung_s: float = 30.0
    """Maximum time without a heartbeat of the service process."""
    gateway_hung_s: float = 5.0
    """Maximum time without a heartbeat of the gateway process."""
    stop_s: float = 30.0
    """Maximum time for the control process to brake all axes and exit."""
    service_stop_s: float = 10.0
    """Maximum time for service and gateway to exit after the control process."""
    collected_s: float = 10.0
    """Maximum time until the program that asked for the bus acquires its lock."""


SIMULATED: Final = Times(begin_s=600.0, gateway_hung_s=120.0, stop_s=300.0, service_stop_s=120.0)
"""Time-outs with simulated drives, long enough for a busy computer."""


class Child(subprocess.Popen[bytes]):
    """A child process, from its start to its end."""

    def __init__(self, program: Sequence[str], start_fd: int, handed: Sequence[int], now_s: float) -> None:
        """Runs ``program`` in this interpreter, with the number of ``start_fd`` as its argument.

        The child also inherits the descriptors in ``handed``. It has its own session, so signals of the
        terminal reach only the keeper.
        """
        self.started_s = now_s
        super().__init__(
            [sys.executable, "-P", *program, str(start_fd)],
            pass_fds=(start_fd, *handed),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.pidfd = os.pidfd_open(self.pid)
        """Descriptor that becomes readable when the process has ended."""

    @property
    def end_description(self) -> str:
        """Exit status or signal of the ended process in words."""
        if self.returncode >= 0:
            return f"exit status {self.returncode}"
        with suppress(ValueError):
            return f"ended by {signal.Signals(-self.returncode).name}"
        return f"ended by signal {-self.returncode}"

    def close(self) -> None:
        """Kills the process if it still runs, and closes the descriptor."""
        self.kill()
        self.wait()
        os.close(self.pidfd)


class Budget:
    """Maximum number of events within a sliding time window."""

    def __init__(self, most: int, window_s: float) -> None:
        self._most, self._window_s = most, window_s
        self._times: deque[float] = deque()

    def spend(self, now_s: float) -> bool:
        """Counts an event; returns False if the window's budget is exhausted."""
        while self._times and now_s - self._times[0] >= self._window_s:
            self._times.popleft()
        if len(self._times) >= self._most:
            return False
        self._times.append(now_s)
        return True


class BackOff:
    """Exponential back-off: the delay doubles with each failure up to a maximum; a long run resets it."""

    def __init__(self, first_s: float, longest_s: float, well_after_s: float) -> None:
        self._first_s, self._longest_s, self._well_after_s = first_s, longest_s, well_after_s
        self._next_s = first_s

    def delay_s(self, lived_s: float) -> float:
        """Returns the delay before the restart of a process that ran for ``lived_s``."""
        if lived_s >= self._well_after_s:
            self._next_s = self._first_s
        delay_s, self._next_s = self._next_s, min(2.0 * self._next_s, self._longest_s)
        return delay_s


class Heartbeat:
    """Hang detection: counts consecutive checks at which a process's counter has not advanced.

    It uses no clock, so a monitor that was itself suspended does not report others as hung.
    """

    def __init__(self) -> None:
        self._last = 0
        self.misses = 0
        """Number of consecutive checks without an advance."""
        self.begun = False
        """True if the counter has advanced since the restart."""

    def check(self, value: int) -> bool:
        """Returns True if the counter has advanced since the last check."""
        advanced = value != self._last
        self._last = value
        self.misses = 0 if advanced else self.misses + 1
        self.begun = self.begun or advanced
        return advanced

    def restart(self, value: int) -> None:
        """Restarts the detection for a restarted process; ``value`` is the current value of its counter."""
        self._last, self.misses, self.begun = value, 0, False


class Notifier:
    """Notifies the service manager (sd_notify), if there is one. Errors are ignored."""

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """``address`` is the manager's socket; an address that begins with @ is abstract."""
        self.watchdog_s = watchdog_s
        """Watchdog time-out of the manager; None without a watchdog."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._status = ""

    @classmethod
    def of_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Self:
        """Returns a notifier from environment variables; removes these, so that children do not notify."""
        address = environment.pop("NOTIFY_SOCKET", None)
        period_us = environment.pop("WATCHDOG_USEC", "")
        meant = environment.pop("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return cls(address, int(period_us) / 1e6 if period_us.isdigit() and meant else None)

    def ready(self) -> None:
        """Reports that the daemon is ready."""
        self._send("READY=1", PATIENCE_S)

    def alive(self) -> None:
        """Sends a heartbeat to the service manager's watchdog."""
        if self.watchdog_s is not None:
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Reports that the daemon is stopping."""
        self._send("STOPPING=1", PATIENCE_S)

    def status(self, words: str) -> None:
        """Sets the line in ``systemctl status``, if it has changed."""
        if words != self._status and self._send(f"STATUS={words}"):
            self._status = words

    def _send(self, line: str, patience_s: float = 0.0) -> bool:
        """Sends a message; returns False if the manager did not accept it within ``patience_s``."""
        if self._address is None:
            return True
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(patience_s)
            sender.sendto(line.encode(), self._address)
            return True
        return False


@dataclass(slots=True)
class _Process:
    """Process of the daemon, with its present child."""

    name: str
    program: Sequence[str]
    alive: Cell
    """Cell that it advances while it runs."""
    begun: Cell
    """Cell to which it writes its id when it is ready."""
    hung_s: float
    listening: tuple[int, ...] = ()
    child: Child | None = None
    due_s: float | None = None
    """Time of its next start; None if it runs or is not to be started."""
    restarts: int = 0
    heartbeat: Heartbeat = field(default_factory=Heartbeat)
    back_off: BackOff = field(default_factory=lambda: BackOff(0.5, 30.0, 60.0))


class Loan:
    """Loan of the bus to another program: requested, then begun, and over when the lock is free again."""

    def __init__(self, lock: InterfaceLock, collected_s: float) -> None:
        """``collected_s`` is the maximum time until the borrower acquires the lock."""
        self._lock, self._collected_s = lock, collected_s
        self.requested_s: float | None = None
        self._closings: int | None = None
        self._begun_s = 0.0
        self._collected = False

    def begin(self, now_s: float) -> None:
        """Begins the loan by releasing the lock."""
        self._begun_s, self._collected = now_s, False
        self._lock.release()
        with suppress(OSError):  # without it, a short loan lasts as long as one that nobody uses
            self._closings = self._lock.watch_closing()

    def is_over(self, now_s: float) -> bool:
        """Reacquires the lock when the borrower has released it or did not come; returns True on success."""
        if self._closings is not None:
            with suppress(BlockingIOError):
                self._collected |= bool(os.read(self._closings, 4096))
        if not self._collected and now_s - self._begun_s < self._collected_s:
            return False
        try:
            self._lock.acquire()
        except BusInUseError:
            return False
        self.requested_s = None
        if self._closings is not None:
            os.close(self._closings)
            self._closings = None
        return True


class Keeper:
    """Starts, monitors and ends the processes of one machine."""

    def __init__(
        self,
        start: Start,
        memory: Memory,
        listeners: Sequence[socket.socket],
        notifier: Notifier,
        programs: Programs = Programs(),
        times: Times = Times(),
        lock: InterfaceLock | None = None,
    ) -> None:
        """``lock`` is the acquired lock of the CAN interface; None for a bus that cannot be lent."""
        self._start, self._memory, self._listeners = start, memory, listeners
        self._notifier, self._programs, self._times = notifier, programs, times
        self._budget = Budget(start.machine.limits.restarts_per_minute, 60.0)
        self._loan = Loan(lock, times.collected_s) if lock is not None else None
        self._control = _Process("control", programs.control, Cell.LOOP_COUNT, Cell.LOOP_PID, times.hung_s)
        api = tuple(each.fileno() for each in listeners)
        service = programs.service, Cell.SERVICE_TIME_NS, Cell.SERVICE_PID, times.service_hung_s, api
        gateway = programs.gateway, Cell.GATEWAY_TIME_NS, Cell.GATEWAY_PID, times.gateway_hung_s
        self._helpers = [_Process("service", *service)]
        if start.machine.gateway is not None:
            self._helpers.append(_Process("gateway", *gateway))
        self._processes = [self._control, *self._helpers]
        self._ready = False
        self._status = 0
        """Exit status of the daemon."""
        self._signals = self._handled = 0
        self._stopping_since_s: float | None = None
        self._helpers_terminated_s: float | None = None
        self._alive_sent_s = 0.0
        self._selector = selectors.DefaultSelector()

    def run(self) -> int:
        """Runs until a signal ends it or it cannot continue; returns the exit status."""
        with ExitStack() as stack:
            stack.callback(self._selector.close)
            stack.enter_context(self._deferred_signals())
            stack.callback(self._end_all)
            for process in self._processes:
                self._begin(process, time.monotonic())
            while any(each.child is not None or each.due_s is not None for each in self._processes):
                for key, _ in self._selector.select(TICK_S):
                    if key.data is not None:
                        key.data()
                self._turn(time.monotonic())
        return self._status

    def _turn(self, now_s: float) -> None:
        self._handle_signals(now_s)
        for process in self._processes:
            if process.child is not None and process.child.poll() is not None:
                self._ended(process, process.child, now_s)
        if self._stopping_since_s is not None:
            self._continue_stopping(self._stopping_since_s, now_s)
            return
        for process in self._processes:
            if process.due_s is not None and now_s >= process.due_s:
                self._begin(process, now_s)
        if self._loan is not None:
            self._lend(self._loan, now_s)
        self._supervise(now_s)

    # ------------------------------------------------------------------ children

    def _begin(self, process: _Process, now_s: float) -> None:
        """Starts the child of a process."""
        fd = self._start.hand_over(api_fds=process.listening)
        try:
            child = Child(process.program, fd, (self._memory.fd, *process.listening), now_s)
        finally:
            os.close(fd)
        process.child, process.due_s = child, None
        process.heartbeat.restart(self._memory.status[process.alive])
        self._selector.register(child.pidfd, selectors.EVENT_READ)
        _log.info(f"{process.name} process started", {"pid": child.pid, "restarts": process.restarts})

    def _forget(self, process: _Process) -> None:
        if process.child is not None:
            self._selector.unregister(process.child.pidfd)
            process.child.close()
            process.child = None

    def _ended(self, process: _Process, child: Child, now_s: float) -> None:
        """Schedules the restart of an ended process, or ends the daemon if it cannot start or keeps dying."""
        cells, status, how = self._memory.status, child.returncode, child.end_description
        is_control, lived_s = process is self._control, now_s - child.started_s
        self._forget(process)
        cells[Cell.LOOP_PID if is_control else process.alive] = 0
        if process.alive is Cell.GATEWAY_TIME_NS:
            self._memory.forget_gateway()
        if self._stopping_since_s is not None:
            if is_control:
                self._status = self._status or max(status, 0)
            return
        if is_control and self._loan is not None and self._loan.requested_s is not None:
            self._loan.begin(now_s)
            cells[Cell.BUS_LENT] = time.monotonic_ns()
            _log.info("the bus is lent", {"how": how})
            return
        _log.error(f"{process.name} process died", {"how": how, "lived_s": round(lived_s, 1)})
        process.restarts += 1
        known = status if status in _ERRORS else HdbridgeError.exit_status
        if is_control:
            hopeless = status in _ERRORS and not cells[Cell.LOOP_COUNT]
        else:
            hopeless = not self._ready and (status in _ERRORS or process.restarts >= _MAX_START_ATTEMPTS)
        if hopeless:
            self._stop(now_s, known, f"the {process.name} process cannot start ({how})")
        elif not is_control:
            process.due_s = now_s + process.back_off.delay_s(lived_s)
        elif self._budget.spend(now_s):
            process.due_s = now_s
        else:
            self._stop(now_s, known, "the control process keeps dying")

    def _lend(self, loan: Loan, now_s: float) -> None:
        """Ends the control process if a loan is requested; starts a new one when the bus is free again."""
        status = self._memory.status
        if loan.requested_s is None:
            if status[Cell.BUS_REQUESTED] and self._control.child is not None:
                loan.requested_s = now_s
                status[Cell.STOP_REQUESTED] = 1
        elif self._control.child is not None:
            self._kill_moving(self._control.child, loan.requested_s, now_s)
        elif loan.is_over(now_s):
            _log.info("the bus is taken back")
            for cell in (Cell.BUS_LENT, Cell.STOP_REQUESTED):
                status[cell] = 0
            self._begin(self._control, now_s)

    def _supervise(self, now_s: float) -> None:
        """Kills hung children; reports readiness, heartbeat and status to the service manager."""
        status = self._memory.status
        axes = ", ".join(axis.name for axis in self._start.machine.axes)
        running = False
        for process in self._processes:
            running |= process.heartbeat.check(status[process.alive]) and process is self._control
            self._kill_hung(process)
        serving = all(each.child and status[each.begun] == each.child.pid for each in self._helpers)
        if not self._ready and serving and self._control.heartbeat.begun:
            self._ready = True
            self._notifier.ready()
            machine, names = self._start.machine, [each.getsockname() for each in self._listeners]
            addresses = [each if isinstance(each, str) else f"{each[0]}:{each[1]}" for each in names]
            about = {"machine": machine.name, "axes": axes, "api": ", ".join(addresses)}
            _log.info("ready", about)
        running |= bool(status[Cell.BUS_LENT])
        if running and now_s - self._alive_sent_s >= (self._notifier.watchdog_s or 0.0) / 4.0:
            self._alive_sent_s = now_s
            self._notifier.alive()
        restarts = ", ".join(
            f"{each.name} restarted {each.restarts} times" for each in self._processes if each.restarts
        )
        words = f"holds {axes}" if self._ready else "begins"
        self._notifier.status(f"{words}; {restarts}" if restarts else words)

    def _kill_hung(self, process: _Process) -> None:
        child, heartbeat = process.child, process.heartbeat
        limit_s = process.hung_s if heartbeat.begun else self._times.begin_s
        if child is not None and heartbeat.misses * TICK_S >= limit_s:
            _log.error("process hangs", {"pid": child.pid, "for_s": heartbeat.misses * TICK_S})
            child.kill()

    def _kill_moving(self, control: Child, since_s: float, now_s: float) -> bool:
        """Kills a control process that was to stop ``since_s`` if it is overdue; returns True if it is."""
        if now_s - since_s <= self._times.stop_s:
            return False
        _log.error("the axes do not come to rest", {"after_s": self._times.stop_s})
        control.kill()
        return True

    # ------------------------------------------------------------------ the end

    def _handle_signals(self, now_s: float) -> None:
        """Handles signals: the first brakes to rest, the second quick-stops, the third kills all children."""
        while self._handled < self._signals:
            self._handled += 1
            if self._handled == 1:
                self._stop(now_s, 0, "a signal requested it")
            elif self._handled == 2:
                self._memory.status[Cell.STOP_REQUESTED] = 2
            else:
                self._end_all()

    def _stop(self, now_s: float, status: int, why: str) -> None:
        """Brakes the axes and ends the daemon; the service ends last, so that it records the stop."""
        if self._stopping_since_s is not None:
            return
        self._stopping_since_s, self._status = now_s, status
        for process in self._processes:
            process.due_s = None
        _log.info("stopping", {"why": why})
        self._notifier.stopping()
        self._memory.status[Cell.STOP_REQUESTED] = 1

    def _continue_stopping(self, since_s: float, now_s: float) -> None:
        if self._control.child is not None:
            if self._kill_moving(self._control.child, since_s, now_s):
                self._status = self._status or HdbridgeError.exit_status
            return
        number, terminated_s = signal.SIGTERM, self._helpers_terminated_s
        if terminated_s is None:
            self._helpers_terminated_s = now_s
        elif now_s - terminated_s > self._times.service_stop_s:
            number = signal.SIGKILL
        else:
            return
        for helper in self._helpers:
            if helper.child is not None:
                if number is signal.SIGKILL:
                    _log.error(f"the {helper.name} does not end", {"after_s": self._times.service_stop_s})
                helper.child.send_signal(number)

    def _end_all(self) -> None:
        for process in self._processes:
            self._forget(process)
            process.due_s = None

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
