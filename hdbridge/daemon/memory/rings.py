"""Rings and queues for one producer and one consumer, without locks that a dying process could hold.

A *ring* never waits: new slots overwrite the oldest, and a slow reader gets the number it lost. A *queue* is
bounded: it refuses its producer when full. In both, a producer fills the slot and then advances the counter
in one aligned store.

No reader gets a torn slot. It copies the slot and then checks that the producer did not overwrite it
meanwhile. A slot begins and ends with its sequence number. On processors that may reorder stores it also has
a checksum.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

from hdbridge.daemon.memory.layout import LINE, TAIL_BYTES, Place
from hdbridge.daemon.memory.region import Region

RETRIES: Final = 3
"""Attempts to copy a slot before a reader counts it as lost."""
MISSES: Final = 100
"""Times that a consumer finds the next slot of a queue incomplete before it skips it."""
_CHECK: Final = struct.Struct("@I")


class _Slots:
    """Slots of one section and its two counters, each in its own cache line."""

    __slots__ = ("_buffer", "_checked", "_head", "_offset", "_size", "_slots", "_struct", "_tail")

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        assert layout.size == place.slot_bytes
        self._buffer = region.view
        self._offset, self._slots, self._size = place
        self._struct = layout
        self._checked = checked
        self._head = region.cells(place.offset - 2 * LINE, 1)
        self._tail = region.cells(place.offset - LINE, 1)

    def _fill(self, sequence: int, values: tuple[Any, ...]) -> None:
        """Writes a slot, with its checksum if enabled."""
        at = self._offset + sequence % self._slots * self._size
        self._struct.pack_into(self._buffer, at, sequence, *values, 0, sequence)
        if self._checked:
            end = at + self._size - TAIL_BYTES
            _CHECK.pack_into(self._buffer, end, zlib.crc32(self._buffer[at:end]))

    def _copy(self, sequence: int) -> tuple[Any, ...] | None:
        """Returns the values of a slot; None if its number differs or it is incomplete."""
        at = self._offset + sequence % self._slots * self._size
        data = bytes(self._buffer[at : at + self._size])
        values = self._struct.unpack(data)
        if values[0] != sequence or values[-1] != sequence:
            return None
        if self._checked and values[-2] != zlib.crc32(data[:-TAIL_BYTES]):
            return None
        return values[1:-2]


class Ring(_Slots):
    """The producer's end of a ring; `RingReader` is a consumer's."""

    __slots__ = ("_sequence",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._sequence: int = self._head[0]

    def append(self, *values: Any) -> int:
        """Adds a slot; returns its sequence number."""
        sequence = self._sequence + 1
        self._fill(sequence, values)
        self._head[0] = self._sequence = sequence
        return sequence


class RingReader(_Slots):
    """Reads the slots appended since it was created."""

    __slots__ = ("_next",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._next = self._head[0] + 1

    def read(self, most: int = 1 << 62) -> tuple[list[tuple[int, tuple[Any, ...]]], int]:
        """Returns at most ``most`` slots, oldest first, with their sequence numbers, and the number lost."""
        found: list[tuple[int, tuple[Any, ...]]] = []
        lost = 0
        end = self._head[0]
        while self._next <= end and len(found) < most:
            # The slot being written may replace the oldest.
            oldest = self._head[0] + 2 - self._slots
            if self._next < oldest:
                lost += oldest - self._next
                self._next = oldest
                continue
            values = next((each for _ in range(RETRIES) if (each := self._copy(self._next))), None)
            if self._next < self._head[0] + 2 - self._slots:
                continue  # overwritten meanwhile: counted above
            if values is None:
                lost += 1
            else:
                found.append((self._next, values))
            self._next += 1
        return found, lost


class Queue(_Slots):
    """Bounded queue with both ends; each process uses one of them."""

    __slots__ = ("_misses",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._misses = 0

    def __len__(self) -> int:
        return int(self._head[0] - self._tail[0])

    @property
    def free(self) -> int:
        """Free places in the queue."""
        return self._slots - len(self)

    def put(self, *values: Any) -> int:
        """Adds a slot, at the producer's end; returns its sequence number, or 0 if the queue is full."""
        sequence: int = self._head[0] + 1
        if sequence - self._tail[0] > self._slots:
            return 0
        self._fill(sequence, values)
        self._head[0] = sequence
        return sequence

    def peek(self) -> tuple[int, tuple[Any, ...]] | None:
        """Returns the next slot and its number, at the consumer's end; None if there is none (yet)."""
        sequence: int = self._tail[0] + 1
        if sequence > self._head[0]:
            return None
        values = self._copy(sequence)
        if values is None:
            # Not completely visible yet. If it stays so, it must not block the slots behind it.
            self._misses += 1
            if self._misses >= MISSES:
                self.drop()
            return None
        return sequence, values

    def drop(self) -> None:
        """Removes the slot that `peek` returned."""
        self._misses = 0
        self._tail[0] += 1

    def take(self) -> tuple[int, tuple[Any, ...]] | None:
        """Removes and returns the next slot; None if there is none."""
        slot = self.peek()
        if slot is not None:
            self.drop()
        return slot

    def clear(self) -> None:
        """Discards waiting slots, at the consumer's end."""
        self._tail[0] = self._head[0]
