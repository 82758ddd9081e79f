"""Commands from the service to the loop: bounded, so that a service that runs wild cannot fill the loop."""

from __future__ import annotations

import threading

from hdbridge.daemon.memory.layout import COMMAND, COMMAND_SLOTS, Command, CommandKind, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Queue
from hdbridge.errors import HdbridgeError


class MailboxFullError(HdbridgeError):
    """The loop has not taken the commands that wait; this one was not posted."""


class Mailbox:
    """Both ends of the mailbox; each process uses one of them."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._queue = Queue(region, layout.commands, COMMAND, checked=checked)
        self._posting = threading.Lock()  # of the service's own threads; the loop knows nothing of it

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
        """Post a command; its id, by which the loop's events name it. `MailboxFullError` where no room is."""
        with self._posting:
            id_ = self._queue.put(kind, axis, a, b, c, d, i, j, k)
        if not id_:
            raise MailboxFullError(
                f"the control loop has not taken the {COMMAND_SLOTS} commands that wait; it hangs or is "
                "gone: see the state of the daemon"
            )
        return id_

    def take(self) -> Command | None:
        """The loop's end: the next command."""
        slot = self._queue.take()
        return None if slot is None else Command(slot[0], *slot[1])

    def clear(self) -> None:
        """The loop's end: throw away what waits: a loop that begins does, it was meant for another."""
        self._queue.clear()

    def __len__(self) -> int:
        return len(self._queue)
