"""The simulated drive in real time, on any bus: one thread waits for a frame or the drive's next event."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import can

from hdbridge.clock import Clock
from hdbridge.device.node import DriveNode
from hdbridge.errors import BusError

LONGEST_WAIT_S: Final = 0.1
"""How long ``should_stop`` may go unasked, unless a shorter time is wanted."""

PATIENCE_S: Final = 5.0
"""How long reading the bus may fail without a break: an interface that is down may come up again."""


def run(
    bus: can.BusABC,
    node: DriveNode,
    clock: Clock,
    should_stop: Callable[[], bool],
    longest_wait_s: float = LONGEST_WAIT_S,
) -> None:
    """Serve ``node``, whose bus is ``bus``, until ``should_stop`` says so.

    ``longest_wait_s`` is how long a new event of the node's may go unnoticed. While the interface fails the
    drive goes on by its own clock, so that its watchdogs stop the axis. Raises BusError when reading has
    failed for ``PATIENCE_S``.
    """
    failing_since_s: float | None = None
    while not should_stop():
        try:
            wait_s = min(node.next_event_s() - clock.now(), longest_wait_s)
            message = bus.recv(max(wait_s, 0.0))
            if message is not None:
                node.handle(message, clock.now())
            node.poll(clock.now())
            failing_since_s = None
        except can.CanError as error:
            now_s = clock.now()
            failing_since_s = now_s if failing_since_s is None else failing_since_s
            if now_s - failing_since_s > PATIENCE_S:
                raise BusError(
                    f"{bus.channel_info}: cannot be read ({error}); bring the interface up and start again"
                ) from error
            node.run_until(now_s)
            clock.sleep_until(now_s + LONGEST_WAIT_S)
