"""Commands from the service to the loop; bounded, so that a faulty service cannot flood the loop."""

from __future__ import annotations

import threading

from hdbridge.daemon.memory.layout import COMMAND, COMMAND_SLOTS, Command, CommandKind, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Queue
from hdbridge.errors import HdbridgeError


class MailboxFullError(HdbridgeError):
    """The command was not posted, because the loop has not taken the waiting ones."""


class Mailbox:
    """Mailbox with both ends; each process uses one of them."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._queue = Queue(region, layout.commands, COMMAND, checked=checked)
        self._posting = threading.Lock()  # between threads of the service; the loop does not use it

    def post(
        self,
        kind: CommandKind,
        axis: int = -1,
        a: float = 0.0,
        b: float = 0.0,
        c: float = 0.0,
        d: float = 0.0,
        i: int = 0,
        j: int = 0,
        k: int = 0,
    ) -> int:
        """Posts a command; returns its id, used in the loop's events. Raises `MailboxFullError` if full."""
        with self._posting:
            id_ = self._queue.put(kind, axis, a, b, c, d, i, j, k)
        if not id_:
            raise MailboxFullError(
                f"the control loop has not taken the {COMMAND_SLOTS} commands that wait; it hangs or is "
                "gone: see the state of the daemon"
            )
        return id_

    def take(self) -> Command | None:
        """Takes the next command, at the loop's end; None if there is none."""
        slot = self._queue.take()
        return None if slot is None else Command(slot[0], *slot[1])

    def clear(self) -> None:
        """Discards waiting commands, at the loop's end; they were meant for an earlier loop."""
        self._queue.clear()

    def __len__(self) -> int:
        return len(self._queue)
