"""Rings and queues for one producer and one consumer, without locks that a dying process could keep.

A *ring* never waits: the newest slots overwrite the oldest, and a reader that was too slow is told how many
it has lost. A *queue* is bounded: its producer is refused when it is full. In both a producer fills the slot
and only then counts it, in one aligned store.

No reader gets a torn slot. It copies, then looks whether the producer may have been there meanwhile. The
sequence number stands first and last in a slot. Where the processor lets stores be seen in another order a
checksum stands in it as well.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

from hdbridge.daemon.memory.layout import LINE, TAIL_BYTES, Place
from hdbridge.daemon.memory.region import Region

RETRIES: Final = 3
"""Copies of a slot that a reader makes before it gives a spoilt one up."""
MISSES: Final = 100
"""How often a consumer finds the next slot of a queue spoilt before it passes it over."""
_CHECK: Final = struct.Struct("@I")


class _Slots:
    """The slots of one section and its two counters, each in a cache line of its own."""

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
        """Write a slot, and its checksum where there is one."""
        at = self._offset + sequence % self._slots * self._size
        self._struct.pack_into(self._buffer, at, sequence, *values, 0, sequence)
        if self._checked:
            end = at + self._size - TAIL_BYTES
            _CHECK.pack_into(self._buffer, end, zlib.crc32(self._buffer[at:end]))

    def _copy(self, sequence: int) -> tuple[Any, ...] | None:
        """The values of a slot; None where it does not hold that number, or not wholly."""
        at = self._offset + sequence % self._slots * self._size
        data = bytes(self._buffer[at : at + self._size])
        values = self._struct.unpack(data)
        if values[0] != sequence or values[-1] != sequence:
            return None
        if self._checked and values[-2] != zlib.crc32(data[:-TAIL_BYTES]):
            return None
        return values[1:-2]


class Ring(_Slots):
    """The producer's end of a ring; `reader` makes a consumer's."""

    __slots__ = ("_sequence",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._sequence: int = self._head[0]

    def append(self, *values: Any) -> int:
        """Add a slot; its sequence number."""
        sequence = self._sequence + 1
        self._fill(sequence, values)
        self._head[0] = self._sequence = sequence
        return sequence


class RingReader(_Slots):
    """Reads what has been appended since it was made."""

    __slots__ = ("_next",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._next = self._head[0] + 1

    def read(self, most: int = 1 << 62) -> tuple[list[tuple[int, tuple[Any, ...]]], int]:
        """At most so many slots, oldest first, each with its sequence number; and how many were lost."""
        found: list[tuple[int, tuple[Any, ...]]] = []
        lost = 0
        end = self._head[0]
        while self._next <= end and len(found) < most:
            # The one that is being written may lie where the oldest did.
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
    """Both ends of a bounded queue; each process uses one of them."""

    __slots__ = ("_misses",)

    def __init__(self, region: Region, place: Place, layout: struct.Struct, *, checked: bool) -> None:
        super().__init__(region, place, layout, checked=checked)
        self._misses = 0

    def __len__(self) -> int:
        return int(self._head[0] - self._tail[0])

    @property
    def free(self) -> int:
        """How many more it takes."""
        return self._slots - len(self)

    def put(self, *values: Any) -> int:
        """Add a slot at the producer's end; its sequence number, or 0 where the queue is full."""
        sequence: int = self._head[0] + 1
        if sequence - self._tail[0] > self._slots:
            return 0
        self._fill(sequence, values)
        self._head[0] = sequence
        return sequence

    def peek(self) -> tuple[int, tuple[Any, ...]] | None:
        """The next slot at the consumer's end, with its sequence number; None where there is none (yet)."""
        sequence: int = self._tail[0] + 1
        if sequence > self._head[0]:
            return None
        values = self._copy(sequence)
        if values is None:
            # Not visible as a whole yet. One that stays so must not hold up those behind it.
            self._misses += 1
            if self._misses >= MISSES:
                self.drop()
            return None
        return sequence, values

    def drop(self) -> None:
        """Make an end of the slot that `peek` gave."""
        self._misses = 0
        self._tail[0] += 1

    def take(self) -> tuple[int, tuple[Any, ...]] | None:
        """The next slot as `peek` gives it, with an end made of it."""
        slot = self.peek()
        if slot is not None:
            self.drop()
        return slot

    def clear(self) -> None:
        """Throw away what waits, at the consumer's end."""
        self._tail[0] = self._head[0]
