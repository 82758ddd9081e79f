"""The points of a streamed set-point, one queue per axis."""

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
        """How many more it takes."""
        return self._queue.free

    def put(self, knots: Iterable[Knot]) -> int:
        """Add knots in this order as long as there is room; how many were taken."""
        taken = 0
        for knot in knots:
            if not self._queue.put(*knot):
                break
            taken += 1
        return taken

    def peek(self) -> Knot | None:
        """The loop's end: the next knot."""
        slot = self._queue.peek()
        return None if slot is None else Knot(*slot[1])

    def drop(self) -> None:
        """The loop's end: make an end of the knot that `peek` gave."""
        self._queue.drop()

    def clear(self) -> None:
        """The loop's end: throw away what waits."""
        self._queue.clear()

    def __len__(self) -> int:
        return len(self._queue)
