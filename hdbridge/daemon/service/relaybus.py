"""A python-can bus whose frames are relayed by the control process, which has the real bus.

The service's SDO clients and boot-up run on it unchanged. It rejects frames that only the control process
may send: SYNC, set-points and the master's heartbeat. The control process sends at most one relayed frame
per cycle, and refuses NMT commands and SDO downloads to an enabled axis.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Container
from typing import TYPE_CHECKING, Final

import can

from hdbridge.daemon.memory import RelayedFrame
from hdbridge.drive import objects
from hdbridge.errors import DaemonError

if TYPE_CHECKING:
    from hdbridge.daemon.service.core import Core

POLL_S: Final = 0.001
"""Interval between checks for a frame; shorter than any cycle."""
_FUNCTION: Final = 0x780
_NODE: Final = 0x7F
_FROM_NODES: Final = frozenset({objects.COB_EMCY, objects.COB_SDO_ANSWER, objects.COB_HEARTBEAT})


class RelayBus(can.BusABC):
    """The bus of one axis for blocking code; `recv` waits on the service's clock.

    ``nodes`` are those of the axis: the drive, and an encoder with its own node. One thread uses it;
    `interrupt` may be called from any.
    """

    def __init__(self, core: Core, nodes: Container[int], name: str) -> None:
        super().__init__(channel=name)
        self.channel_info = name
        self._clock = core.timing.clock
        self._core = core
        self._outgoing = core.memory.outgoing
        self._incoming = core.memory.incoming_reader()
        self._nodes = nodes
        self._waiting: deque[RelayedFrame] = deque()
        self._interrupted = threading.Event()
        self._reason = ""

    def interrupt(self, reason: str) -> None:
        """Makes the present operation fail at its next wait, once, with ``reason``."""
        self._reason = reason
        self._interrupted.set()

    def begin(self) -> None:
        """Begins another operation; discards an interruption of the one before."""
        self._interrupted.clear()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame. Drops the master's heartbeat, which the control process sends."""
        self._core.refuse(None)
        can_id = msg.arbitration_id
        function, node = can_id & _FUNCTION, can_id & _NODE
        if function == objects.COB_HEARTBEAT:
            return
        to_node = function == objects.COB_SDO_REQUEST and node in self._nodes
        nmt = can_id == objects.COB_NMT and len(msg.data) == 2 and msg.data[1] in self._nodes
        if not (to_node or nmt):
            raise can.CanOperationError(f"{can_id:03X}h is not for the service to send")
        if not self._outgoing.add(RelayedFrame(int(1e9 * self._clock.now()), can_id, bytes(msg.data))):
            raise can.CanOperationError("the control process takes no frames: it hangs or is gone")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        clock = self._clock
        deadline_s = clock.now() + (timeout or 0.0)
        while True:
            if self._interrupted.is_set():
                self._interrupted.clear()
                raise DaemonError(self._reason)
            frame = self._next()
            if frame is not None:
                message = can.Message(
                    timestamp=frame.time_ns / 1e9,
                    arbitration_id=frame.can_id,
                    is_extended_id=False,
                    data=frame.data,
                )
                return message, True
            now_s = clock.now()
            if now_s >= deadline_s and timeout is not None:
                return None, True
            clock.sleep_until(min(now_s + POLL_S, deadline_s) if timeout is not None else now_s + POLL_S)

    def _next(self) -> RelayedFrame | None:
        """Returns the next frame from one of the axis's nodes."""
        if not self._waiting:
            frames, _ = self._incoming.read()
            self._waiting.extend(frames)
        while self._waiting:
            frame = self._waiting.popleft()
            if frame.can_id & _FUNCTION in _FROM_NODES and frame.can_id & _NODE in self._nodes:
                return frame
        return None
