"""Channels for one producer and one consumer, without locks that a dying process could hold.

A *ring* never waits: new slots overwrite the oldest, and a slow reader receives the number lost. A *queue* is
bounded: it refuses items when full. In both, a producer fills the slot and then advances the counter in one
aligned store.

Readers never see a torn slot. A reader copies the slot and then checks that the producer did not overwrite it
meanwhile. A slot begins and ends with its sequence number. On processors that may reorder stores, it also has
a checksum. `Format` converts between items and slots.
"""

import struct
import threading
import zlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from hdbridge.daemon.memory.cells import Region
from hdbridge.daemon.memory.layout import (
    COMMAND,
    COMMAND_SLOTS,
    EVENT,
    FRAME,
    KNOT,
    LINE,
    TAIL_BYTES,
    TEXT_BYTES,
    Command,
    CommandKind,
    Event,
    EventKind,
    Knot,
    OuterKnot,
    Place,
    RelayedFrame,
    sample_dtype,
    sample_struct,
)
from hdbridge.errors import HdbridgeError

SampleArray = npt.NDArray[np.void]
"""Samples with the dtype `sample_dtype`, shape (n,)."""
RETRIES: Final = 3
"""Number of attempts to copy the new slots before a reader counts incomplete slots as lost."""
MISSES: Final = 100
"""Number of times that a consumer finds the next slot of a queue incomplete before skipping it."""
_CHECK: Final = struct.Struct("@I")
_KINDS: Final = {int(kind): kind for kind in EventKind}

T = TypeVar("T")


class Format(NamedTuple, Generic[T]):
    """Conversion of items to the values of a slot and back, by sequence number and values."""

    struct: struct.Struct
    pack: Callable[[T], Sequence[Any]]
    unpack: Callable[[int, tuple[Any, ...]], T]


def _pack_event(event: Event) -> tuple[Any, ...]:
    text = event.text.encode("utf-8", "replace")[:TEXT_BYTES]
    return (*event[1:-1], len(text), text)


def _unpack_event(sequence: int, values: tuple[Any, ...]) -> Event:
    cycle, time_ns, axis, kind, id_, code, length, text = values
    # Truncation may have split the last character.
    text = text[:length].decode("utf-8", "ignore")
    return Event(sequence, cycle, time_ns, axis, _KINDS[kind], id_, code, text)


EVENTS: Final[Format[Event]] = Format(EVENT, _pack_event, _unpack_event)
"""Format of events; a long text is truncated."""
FRAMES: Final[Format[RelayedFrame]] = Format(
    FRAME,
    lambda frame: (frame.time_ns, frame.can_id, len(frame.data), frame.data),
    lambda _, values: RelayedFrame(values[0], values[1], values[3][: values[2]]),
)
COMMANDS: Final[Format[Command]] = Format(
    COMMAND, lambda command: command[1:], lambda sequence, values: Command(sequence, *values)
)
KNOTS: Final[Format[Knot]] = Format(KNOT, lambda knot: knot, lambda _, values: Knot(*values))
FOLLOWED: Final[Format[OuterKnot]] = Format(
    KNOT, lambda knot: knot, lambda _, values: tuple.__new__(OuterKnot, values)
)


def samples_of(axes: int) -> Format[Sequence[float]]:
    """Returns the format of samples: the fields before ``axes``, then those of `layout.Axis` of all axes."""
    return Format(sample_struct(axes), lambda values: values, lambda _, values: values)


def joined_samples(batches: Sequence[SampleArray]) -> SampleArray:
    """Returns the concatenated batches, joined as plain bytes, which is four times faster than by field."""
    plain = np.dtype((np.void, batches[0].dtype.itemsize))
    return np.concatenate([each.view(plain) for each in batches]).view(batches[0].dtype)


class _Slots(Generic[T]):
    """Slots of one section and its two counters, each in its own cache line."""

    def __init__(self, region: Region, place: Place, form: Format[T]) -> None:
        assert form.struct.size == place.slot_bytes
        self._buffer = region.view
        self._checked = region.checked
        self._offset, self._slots, self._size = place
        self._struct, self._pack, self._unpack = form
        self._head = region.cells(place.offset - 2 * LINE, 1)
        self._tail = region.cells(place.offset - LINE, 1)

    def _fill(self, sequence: int, item: T) -> None:
        """Writes a slot, with its checksum if enabled."""
        at = self._offset + sequence % self._slots * self._size
        self._struct.pack_into(self._buffer, at, sequence, *self._pack(item), 0, sequence)
        if self._checked:
            end = at + self._size - TAIL_BYTES
            _CHECK.pack_into(self._buffer, end, zlib.crc32(self._buffer[at:end]))


class Ring(_Slots[T]):
    """Producer's side of a ring; `RingReader` is a consumer's side."""

    def __init__(self, region: Region, place: Place, form: Format[T]) -> None:
        super().__init__(region, place, form)
        self._sequence: int = self._head[0]

    def append(self, item: T) -> None:
        sequence = self._sequence + 1
        self._fill(sequence, item)
        self._head[0] = self._sequence = sequence


class RingReader(_Slots[T]):
    """Reads the items appended since its creation or its last `read`."""

    def __init__(self, region: Region, place: Place, form: Format[T]) -> None:
        super().__init__(region, place, form)
        rows = np.frombuffer(self._buffer, np.uint8, self._slots * self._size, self._offset)
        self._rows = rows.reshape(self._slots, self._size)
        self._marks = np.dtype({
            "names": ["sequence", "check", "last"],
            "formats": [np.uint64, np.uint32, np.uint64],
            "offsets": [0, self._size - TAIL_BYTES, self._size - TAIL_BYTES // 2],
            "itemsize": self._size,
        })  # fmt: skip
        self._next = self._head[0] + 1

    def read(self) -> tuple[list[T], int]:
        """Returns the new items, oldest first, and the number lost."""
        rows, lost = self.rows()
        values = self._struct.iter_unpack(rows.tobytes())
        return [self._unpack(each[0], each[1:-2]) for each in values], lost

    def rows(self) -> tuple[npt.NDArray[np.uint8], int]:
        """Returns copies of the new slots, shape (n, size), and the number lost before them.

        Items that are overwritten before they are read are lost.
        """
        first = self._next
        end: int = self._head[0]
        if end < first:
            return self._rows[:0], 0
        self._next = end + 1
        # The slot after the newest may be in progress, and it replaces the oldest.
        kept = self._whole(max(first, end + 2 - self._slots), end)
        return kept, end + 1 - first - len(kept)

    def _whole(self, first: int, end: int) -> npt.NDArray[np.uint8]:
        """Returns the complete slots with these numbers."""
        wanted = np.arange(first, end + 1)
        for _ in range(RETRIES):
            rows = self._rows[wanted % self._slots]
            # Slots overwritten during the copy are lost; those after them are complete.
            overwritten = self._head[0] + 2 - self._slots - first
            if overwritten > 0:
                first += overwritten
                rows, wanted = rows[overwritten:], wanted[overwritten:]
            marks = rows.view(self._marks)[:, 0]
            whole = (marks["sequence"] == wanted) & (marks["last"] == wanted)
            if self._checked:
                whole &= marks["check"] == [zlib.crc32(each[:-TAIL_BYTES]) for each in rows]
            if whole.all():
                break
        kept: npt.NDArray[np.uint8] = rows[whole]
        return kept


class SampleReader(RingReader[Sequence[float]]):
    """Reads samples as arrays."""

    def __init__(self, region: Region, place: Place, axes: int) -> None:
        super().__init__(region, place, samples_of(axes))
        self._dtype = sample_dtype(axes)

    def read(self) -> tuple[SampleArray, int]:  # type: ignore[override]
        """Returns the new samples, oldest first, and the number lost before them."""
        rows, lost = self.rows()
        return rows.view(self._dtype)[:, 0], lost


class Queue(_Slots[T]):
    """Bounded queue with the sides of producer and consumer; each process uses one side."""

    def __init__(self, region: Region, place: Place, form: Format[T]) -> None:
        super().__init__(region, place, form)
        self._misses = 0
        self._producing = threading.Lock()  # between threads of the producer; the loop only consumes

    def __len__(self) -> int:
        return int(self._head[0] - self._tail[0])

    def add(self, item: T) -> int:
        """Adds an item, on the producer's side; returns its sequence number, or 0 if the queue is full."""
        with self._producing:
            sequence: int = self._head[0] + 1
            if sequence - self._tail[0] > self._slots:
                return 0
            self._fill(sequence, item)
            self._head[0] = sequence
            return sequence

    def put(self, items: Iterable[T]) -> int:
        """Adds items in order while there is space; returns the number added."""
        added = 0
        for item in items:
            if not self.add(item):
                break
            added += 1
        return added

    def peek(self) -> T | None:
        """Returns the next item, on the consumer's side; None if the channel is empty."""
        sequence: int = self._tail[0] + 1
        if sequence > self._head[0]:
            return None
        values = self._copy(sequence)
        if values is None:
            # Not completely visible yet. If this persists, the slot must not block those behind it.
            self._misses += 1
            if self._misses >= MISSES:
                self.drop()
            return None
        return self._unpack(sequence, values)

    def _copy(self, sequence: int) -> tuple[Any, ...] | None:
        """Returns the values of a slot; None if it is incomplete."""
        at = self._offset + sequence % self._slots * self._size
        data = bytes(self._buffer[at : at + self._size]) if self._checked else b""
        values = self._struct.unpack(data) if data else self._struct.unpack_from(self._buffer, at)
        if values[0] != sequence or values[-1] != sequence:
            return None
        if data and values[-2] != zlib.crc32(data[:-TAIL_BYTES]):
            return None
        return values[1:-2]

    def drop(self) -> None:
        """Removes the item that `peek` returned."""
        self._misses = 0
        self._tail[0] += 1

    def take(self) -> T | None:
        """Removes and returns the next item; None if the channel is empty."""
        item = self.peek()
        if item is not None:
            self.drop()
        return item

    def clear(self) -> None:
        """Discards the waiting items, on the consumer's side, because they were meant for an earlier loop."""
        self._tail[0] = self._head[0]


class MailboxFullError(HdbridgeError):
    """The command was not posted, because the loop has not taken the waiting commands."""


class Mailbox(Queue[Command]):
    """Commands from the service to the loop; bounded, so that a faulty service cannot flood the loop."""

    def post(self, kind: CommandKind, axis: int = -1, **fields: float) -> int:
        """Posts a command with the fields a to k; returns its id, used in the loop's events.

        Raises `MailboxFullError` if the queue is full.
        """
        id_ = self.add(Command(0, kind, axis, **fields))  # type: ignore[arg-type]
        if not id_:
            raise MailboxFullError(
                f"the control loop has not taken the {COMMAND_SLOTS} commands that wait; it hangs or is "
                "gone: see the state of the daemon"
            )
        return id_
