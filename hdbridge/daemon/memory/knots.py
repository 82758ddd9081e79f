"""Queues of the knots of streamed set-points, one per axis."""

from __future__ import annotations

from collections.abc import Iterable

from hdbridge.daemon.memory.layout import KNOT, Knot, Place
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Queue


class KnotQueue:
    """Both ends of one axis's queue; each process uses one of them."""

    def __init__(self, region: Region, place: Place, *, checked: bool) -> None:
        self._queue = Queue(region, place, KNOT, checked=checked)

    @property
    def free(self) -> int:
        """Free places in the queue."""
        return self._queue.free

    def put(self, knots: Iterable[Knot]) -> int:
        """Adds knots in order while there is space; returns the number added."""
        taken = 0
        for knot in knots:
            if not self._queue.put(*knot):
                break
            taken += 1
        return taken

    def peek(self) -> Knot | None:
        """Returns the next knot, at the loop's end, without removing it; None if there is none."""
        slot = self._queue.peek()
        return None if slot is None else Knot(*slot[1])

    def drop(self) -> None:
        """Removes the knot that `peek` returned."""
        self._queue.drop()

    def clear(self) -> None:
        """Discards waiting knots, at the loop's end."""
        self._queue.clear()

    def __len__(self) -> int:
        return len(self._queue)
