"""SDO access to one axis's drive through the control process: boot, verify, prepare, home, read, write.

All methods block and run in worker threads. A drive serves one request at a time; a request to a busy drive
waits for `BUSY_S`. The control process has listened for other masters before its first frame, so this module
does not. The SDO clients and the boot-up run unchanged on `RelayBus`.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Final

import can

from hdbridge.axis import AxisConfig
from hdbridge.client import messages
from hdbridge.daemon.loop.relay import refusal_reason
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import RelayedFrame
from hdbridge.daemon.service.core import Arguments, Core
from hdbridge.drive import objects
from hdbridge.drive.drive import Drive, Positions
from hdbridge.drive.states import State
from hdbridge.drive.values import Object, Value, find_object
from hdbridge.errors import DaemonError, InputError, RefusedError

POLL_S: Final = 0.001
"""Interval between checks for a frame, shorter than any cycle."""
_FROM_NODES: Final = frozenset({objects.COB_EMCY, objects.COB_SDO_ANSWER, objects.COB_HEARTBEAT})
BUSY_S = 3.0
"""Maximum wait for a drive that is busy with another request."""


class RelayBus(can.BusABC):
    """Bus of one axis for blocking code, relayed by the control process; `recv` waits on its clock.

    It rejects frames that only the control process may send: SYNC, set-points and the master's heartbeat. The
    control process sends at most one relayed frame per cycle, and refuses NMT commands and SDO downloads to
    an enabled axis.

    ``nodes`` are those of the axis: the drive, and an encoder with its own node. Used by one thread;
    `interrupt` may be called from any thread.
    """

    def __init__(self, core: Core, nodes: Iterable[int], name: str) -> None:
        super().__init__(channel=name)
        self.channel_info = name
        self._clock = core.timing.clock
        self._core = core
        self._outgoing = core.memory.outgoing
        self._incoming = core.memory.incoming_reader()
        self._nodes = dict.fromkeys(nodes, AxisState.DISABLED)  # the loop knows the actual states
        self._identifiers = {base + node for node in self._nodes for base in _FROM_NODES}
        self._waiting: deque[RelayedFrame] = deque()
        self._interruption = ""
        """Reason with which the current operation is to fail; empty if it is not to fail."""

    def interrupt(self, reason: str) -> None:
        """Makes the current operation fail once, at its next wait, with this reason.

        An empty reason withdraws an interruption that has not taken effect yet.
        """
        self._interruption = reason

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame. Drops the master's heartbeat, which the control process sends."""
        self._core.refuse(None)
        can_id, data = msg.arbitration_id, bytes(msg.data)
        if objects.COB_HEARTBEAT <= can_id <= objects.COB_HEARTBEAT + 0x7F:
            return
        if (reason := refusal_reason(can_id, data, self._nodes)) is not None:
            raise can.CanOperationError(reason)
        if not self._outgoing.add(RelayedFrame(int(1e9 * self._clock.now()), can_id, data)):
            raise can.CanOperationError("the control process accepts no frames: it hangs or has ended")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        clock = self._clock
        deadline_s = math.inf if timeout is None else clock.now() + timeout
        while True:
            if reason := self._interruption:
                self._interruption = ""
                raise DaemonError(reason)
            if (frame := self._next()) is not None:
                message = can.Message(
                    timestamp=frame.time_ns / 1e9,
                    arbitration_id=frame.can_id,
                    is_extended_id=False,
                    data=frame.data,
                )
                return message, True
            now_s = clock.now()
            if now_s >= deadline_s:
                return None, True
            clock.sleep_until(min(now_s + POLL_S, deadline_s))

    def _next(self) -> RelayedFrame | None:
        """Returns the next frame from one of the axis's nodes."""
        if not self._waiting:
            frames, _ = self._incoming.read()
            self._waiting.extend(frames)
        while self._waiting:
            frame = self._waiting.popleft()
            if frame.can_id in self._identifiers:
                return frame
        return None


class Commissioning:
    """Drive of one axis, as seen by the service."""

    def __init__(self, axis: AxisConfig, core: Core) -> None:
        self._bus = RelayBus(core, axis.nodes, f"{axis.bus.interface}:{axis.bus.channel}")
        self.drive = Drive(self._bus, axis, core.timing.clock, force=True)
        self._busy = threading.Lock()
        self._doing = ""

    def verify(self, *, clear_fault: bool = False) -> Arguments:
        """Boots the drive and compares it with the axis file; power is off afterwards.

        ``clear_fault`` also resets a fault of the drive, to which the control process sends nothing. Raises
        like `Drive.boot`.
        """
        with self._request("it is being booted"):
            self.drive.boot()
            if clear_fault and self.drive.state() is State.FAULT:
                self.drive.fault_reset()
            return self._seeds(self.drive.read_positions())

    def take_over(self) -> None:
        """Compares a drive under control of the control process with the axis file, without writing."""
        with self._request("it is being compared with its axis file"):
            self.drive.take_over()

    def abandon_homing(self) -> None:
        """Stops a drive that was lent to an earlier service, and switches its power off."""
        with self._request("it is being stopped"):
            if self.drive.state() is State.OPERATION_ENABLED:
                self.drive.quick_stop()
            self.drive.disable()

    def prepare(self) -> Arguments:
        """Prepares the drive for being enabled by the control process. Raises like `Drive.enable`."""
        with self._request("it is being prepared"):
            return self._seeds(self.drive.prepare())

    def rest(self) -> None:
        """Ends the drive's monitoring of the master; power is off already."""
        with self._request("it is being switched off"):
            self.drive.disable()

    def home(self, run: messages.Home, check: Callable[[], None]) -> Arguments:
        """Homes a drive that the control process has lent; power is off afterwards.

        ``check`` raises if the axis was stopped since homing was requested. Raises like `Drive.home`; even
        then, the axis stops and its power is off if the drive answers.
        """
        with self._request("it is being homed"):
            check()  # an `interrupt` before this request is lost; a later one ends it
            try:
                positions = self.drive.home(**run.model_dump())
            finally:
                self.drive.disable()
            return self._seeds(positions)

    def interrupt(self, reason: str) -> None:
        """Interrupts the current request with this reason; a homing axis stops. Thread-safe."""
        if self._busy.locked():
            self._bus.interrupt(reason)

    def read(self, object_: str) -> tuple[Object, Value]:
        """Reads an object by its number or its EDS name."""
        wanted = find_object(object_, self.drive.sdo.od)
        if not wanted.readable:
            raise InputError(f"{wanted}: is write-only in the EDS")
        with self._request(f"{object_} is being read"):
            return wanted, wanted.decode(self.drive.sdo.read_bytes(wanted.index, wanted.sub))

    def write(self, object_: str, text: str) -> Object:
        """Writes an object; the control process refuses this while the axis is enabled."""
        wanted = find_object(object_, self.drive.sdo.od)
        if not wanted.writable:
            raise InputError(f"{wanted}: is read-only in the EDS")
        data = wanted.encode(text)
        with self._request(f"{object_} is being written"):
            self.drive.sdo.write_bytes(wanted.index, wanted.sub, data)
        return wanted

    def close(self) -> None:
        """Closes the relay bus; the drive stays as it is."""
        self._bus.shutdown()

    def _seeds(self, positions: Positions) -> Arguments:
        """Returns counts and statusword, the arguments of VERIFIED, HOMED and ENABLE."""
        self.drive.state()
        statusword = self.drive.image.statusword or 0
        return Arguments(i=positions.motor_counts, j=positions.load_counts, k=statusword)

    @contextmanager
    def _request(self, doing: str) -> Iterator[None]:
        if not self._busy.acquire(timeout=BUSY_S):
            raise RefusedError(f"the drive of axis '{self.drive.axis.name}' is busy: {self._doing}")
        self._doing = doing
        self._bus.interrupt("")
        try:
            yield
        finally:
            self._busy.release()
