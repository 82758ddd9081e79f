"""CAN frames between the loop, which has the bus, and the service, which has SDO to do."""

from __future__ import annotations

import threading
from typing import NamedTuple

from hdbridge.daemon.memory.layout import FRAME, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Queue, Ring, RingReader


class RelayedFrame(NamedTuple):
    """A data frame with an 11-bit identifier."""

    time_ns: int
    """When it was received or queued, on the loop's clock."""
    can_id: int
    data: bytes


class IncomingWriter:
    """The loop's end: what it received and does not use up itself."""

    __slots__ = ("_append",)

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._append = Ring(region, layout.incoming, FRAME, checked=checked).append

    def put(self, time_ns: int, can_id: int, data: bytes) -> None:
        """Pass a frame on."""
        self._append(time_ns, can_id, len(data), data)


class IncomingReader:
    """Gives the frames that came since it was made, or since its last `read`."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._ring = RingReader(region, layout.incoming, FRAME, checked=checked)

    def read(self) -> tuple[list[RelayedFrame], int]:
        """The new frames, oldest first, and how many were lost."""
        slots, lost = self._ring.read()
        return [RelayedFrame(time, can_id, data[:n]) for _, (time, can_id, n, data) in slots], lost


class Outgoing:
    """Frames that the service wants sent; the loop sends at most one a cycle."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._queue = Queue(region, layout.outgoing, FRAME, checked=checked)
        self._producing = threading.Lock()  # of the service's own threads; the loop knows nothing of it

    def put(self, time_ns: int, can_id: int, data: bytes) -> bool:
        """Queue a frame; False, and it is not queued, where there is no room."""
        with self._producing:
            return self._queue.put(time_ns, can_id, len(data), data) > 0

    def take(self) -> RelayedFrame | None:
        """The loop's end: the next frame."""
        slot = self._queue.take()
        if slot is None:
            return None
        time_ns, can_id, length, data = slot[1]
        return RelayedFrame(time_ns, can_id, data[:length])

    def clear(self) -> None:
        """The loop's end: throw away what waits."""
        self._queue.clear()
