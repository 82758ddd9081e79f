"""CAN frames between the loop, which has the bus, and the service, which needs it for SDO."""

from __future__ import annotations

import threading
from typing import NamedTuple

from hdbridge.daemon.memory.layout import FRAME, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Queue, Ring, RingReader


class RelayedFrame(NamedTuple):
    """A data frame with an 11-bit identifier."""

    time_ns: int
    """Time of reception or queuing, on the loop's clock."""
    can_id: int
    data: bytes


class IncomingWriter:
    """The loop's end: received frames that the loop does not process itself."""

    __slots__ = ("_append",)

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._append = Ring(region, layout.incoming, FRAME, checked=checked).append

    def put(self, time_ns: int, can_id: int, data: bytes) -> None:
        """Passes a frame to the service."""
        self._append(time_ns, can_id, len(data), data)


class IncomingReader:
    """Reads the frames since it was created or since its last `read`."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._ring = RingReader(region, layout.incoming, FRAME, checked=checked)

    def read(self) -> tuple[list[RelayedFrame], int]:
        """Returns the new frames, oldest first, and the number lost."""
        slots, lost = self._ring.read()
        return [RelayedFrame(time, can_id, data[:n]) for _, (time, can_id, n, data) in slots], lost


class Outgoing:
    """Frames for the bus from the service; the loop sends at most one per cycle."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._queue = Queue(region, layout.outgoing, FRAME, checked=checked)
        self._producing = threading.Lock()  # between threads of the service; the loop does not use it

    def put(self, time_ns: int, can_id: int, data: bytes) -> bool:
        """Queues a frame; returns False if the queue is full."""
        with self._producing:
            return self._queue.put(time_ns, can_id, len(data), data) > 0

    def take(self) -> RelayedFrame | None:
        """Takes the next frame, at the loop's end; None if there is none."""
        slot = self._queue.take()
        if slot is None:
            return None
        time_ns, can_id, length, data = slot[1]
        return RelayedFrame(time_ns, can_id, data[:length])

    def clear(self) -> None:
        """Discards waiting frames, at the loop's end."""
        self._queue.clear()
