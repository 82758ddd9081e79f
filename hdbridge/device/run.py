"""Runs nodes in real time on any bus: one thread waits for a frame or the next event of a node."""

import time
from collections.abc import Callable
from typing import Final, Protocol

import can

from hdbridge.clock import Clock
from hdbridge.errors import BusError

LONGEST_WAIT_S: Final = 0.1
"""Default maximum interval between calls of ``should_stop``."""

PATIENCE_S: Final = 5.0
"""Time for which read failures are tolerated, because an interface that is down may come up again; s."""


class Served(Protocol):
    """A `DriveNode`, or several of them on one bus."""

    def handle(self, message: can.Message, now_s: float) -> None: ...
    def poll(self, now_s: float) -> None: ...
    def run_until(self, now_s: float) -> None: ...
    def next_event_s(self) -> float: ...
    def bus_failed(self) -> None: ...


class Server:
    """Serves a node on a bus whose interface may fail."""

    def __init__(self, bus: can.BusABC, node: Served, clock: Clock) -> None:
        self._bus, self._node, self._clock = bus, node, clock
        self._failing_since_s: float | None = None

    def poll(self, wait_s: float | None = None) -> bool:
        """Waits for a frame for up to ``wait_s`` and handles everything due; False if reading failed.

        A failure of the interface stops the axis as selected by 6007h, and the node continues on its own
        clock. Raises BusError when reading has failed for ``PATIENCE_S``.
        """
        node, now = self._node, self._clock.now
        try:
            if wait_s is not None and (message := self._bus.recv(wait_s)) is not None:
                node.handle(message, now() - _age_s(message))
            node.poll(now())
        except can.CanError as error:
            now_s = now()
            if self._failing_since_s is None:
                self._failing_since_s = now_s
                node.bus_failed()
            if now_s - self._failing_since_s > PATIENCE_S:
                raise BusError(
                    f"{self._bus.channel_info}: cannot be read ({error}); bring the interface up and start "
                    "again"
                ) from error
            node.run_until(now_s)
            return False
        self._failing_since_s = None
        return True


def run(
    bus: can.BusABC,
    node: Served,
    clock: Clock,
    should_stop: Callable[[], bool],
    longest_wait_s: float = LONGEST_WAIT_S,
) -> None:
    """Serves ``node``, whose bus is ``bus``, until ``should_stop`` returns True.

    ``longest_wait_s`` is the maximum delay until a new event of the node is noticed. Raises BusError like
    `Server.poll`.
    """
    server = Server(bus, node, clock)
    while not should_stop():
        wait_s = min(node.next_event_s() - clock.now(), longest_wait_s)
        if not server.poll(max(wait_s, 0.0)):
            clock.sleep_until(clock.now() + LONGEST_WAIT_S)


def _age_s(message: can.Message) -> float:
    """Returns the time that a frame waited for this process, s, from its SocketCAN time stamp; else 0.

    The stamp is wall-clock time. A negative difference, or one longer than ``LONGEST_WAIT_S``, comes from a
    step of that clock and is ignored.
    """
    age_s = time.time() - message.timestamp
    return age_s if 0.0 < age_s < LONGEST_WAIT_S else 0.0
