"""Shared memory region, its cells (integers that one process writes and others read), and setting slots."""

import fcntl
import mmap
import os
import threading
import zlib
from enum import IntEnum
from typing import Final, Self

from hdbridge.daemon.memory.layout import LINE, OUTER_VIEW, OuterCell, OuterView, Place
from hdbridge.errors import InputError

_STRIDE: Final = LINE // 8


class Region:
    """Mapped memfd, accessible as bytes and as int64 cells.

    It has no name in any file system, so no other process can open it, and it is freed with the last process
    that holds it, however that process ends. It is sealed against shrinking, so no access can fail later.
    """

    def __init__(self, fd: int, size: int, *, checked: bool) -> None:
        self.fd = fd
        """Descriptor to pass to another process."""
        self.checked = checked
        """True if slots have checksums."""
        self._map = mmap.mmap(fd, size)
        self.view = memoryview(self._map)
        self._cells = self.view.cast("q")

    @classmethod
    def create(cls, size: int, *, checked: bool) -> Self:
        """Creates a region, all zero."""
        fd = os.memfd_create("hdbridge", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            return cls(fd, size, checked=checked)
        except OSError:
            os.close(fd)
            raise

    def cells(self, offset: int, count: int) -> memoryview:
        """Returns ``count`` aligned int64 cells, which are read and written atomically."""
        return self._cells[offset // 8 : offset // 8 + count]

    def close(self) -> None:
        """Unmaps the memory, unless arrays of samples still refer to it, and closes the descriptor."""
        try:
            self._cells.release()
            self.view.release()
            self._map.close()
        except BufferError:
            pass  # the last reference unmaps it
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


class Cell(IntEnum):
    """State of the daemon's processes."""

    LOOP_COUNT = 0
    """Number of cycles of the loop, summed over all control processes so far."""
    SERVICE_TIME_NS = 1
    LOOP_PID = 2
    """Process id of the control process; 0 if none runs."""
    SERVICE_PID = 3
    STOP_REQUESTED = 4
    GATEWAY_TIME_NS = 5
    GATEWAY_PID = 6
    BUS_REQUESTED = 7
    """Service: 1 while it waits for the release of the bus to another program."""
    BUS_LENT = 8
    """Keeper: time at which it released the interface to another program (``time.monotonic_ns``); 0 if not
    lent."""


class Cells:
    """Integers indexed by an enumeration, each in its own cache line; access to each is atomic.

    Each is written by one process, except that the keeper clears the cells of a process that has ended.
    """

    def __init__(self, region: Region, offset: int, kind: type[IntEnum]) -> None:
        self._cells = region.cells(offset, len(kind) * _STRIDE)

    def __getitem__(self, cell: IntEnum) -> int:
        return int(self._cells[cell * _STRIDE])

    def __setitem__(self, cell: IntEnum, value: int) -> None:
        self._cells[cell * _STRIDE] = value


class OuterCells(Cells):
    """Cells of one axis that the gateway process shares with the service, by `OuterCell`."""

    def __init__(self, region: Region, place: Place) -> None:
        super().__init__(region, place.offset, OuterCell)
        self._buffer, self._at = region.view, place.offset + OuterCell.VIEW * LINE

    def show(self, view: OuterView) -> None:
        """Writes the outer master's view in one copy; `pack_into` would write zeros first."""
        self._buffer[self._at : self._at + OUTER_VIEW.size] = OUTER_VIEW.pack(*view)

    def values(self) -> tuple[float, ...]:
        """Returns the fields of `OuterView` as a plain tuple, for the cycle of the control process."""
        return OUTER_VIEW.unpack_from(self._buffer, self._at)

    @property
    def view(self) -> OuterView:
        return OuterView._make(self.values())


class SettingSlot:
    """Slot for the compensation setting of one axis, with the sides of service and loop.

    It contains the last setting sent and its number. It outlives both processes, so a starting service reads
    the setting of an earlier one.
    """

    def __init__(self, region: Region, place: Place) -> None:
        self._view = region.view
        self._offset, _, self._capacity = place
        self._sent = region.cells(self._offset - 2 * LINE, 3)  # number, length, crc
        self._used = region.cells(self._offset - LINE, 1)
        self._putting = threading.Lock()  # between threads of the service; the loop does not use it

    @property
    def number(self) -> int:
        """Number of the setting in the slot; 0 before the first, negative during a write."""
        return int(self._sent[0])

    @property
    def in_use(self) -> int:
        """Number of the setting that the loop uses; 0 if it has used none since its start."""
        return int(self._used[0])

    def put(self, data: bytes) -> int:
        """Stores a setting; returns its number, the argument of CHANGE. Raises InputError if too large."""
        if len(data) > self._capacity:
            raise InputError(
                f"the compensation has {len(data)} bytes, but the control process accepts at most "
                f"{self._capacity}: use a model with fewer effects"
            )
        with self._putting:
            number: int = abs(self._sent[0]) + 1
            self._sent[0] = -number
            self._view[self._offset : self._offset + len(data)] = data
            self._sent[1], self._sent[2] = len(data), zlib.crc32(data)
            self._sent[0] = number
        return number

    def get(self, number: int) -> bytes:
        """Returns the setting with this number. Raises InputError if it is not completely in the slot."""
        length: int = self._sent[1]
        data = bytes(self._view[self._offset : self._offset + min(max(length, 0), self._capacity)])
        whole = len(data) == length and zlib.crc32(data) == self._sent[2]
        if number <= 0 or self._sent[0] != number or not whole:
            raise InputError(f"the compensation setting number {number} is not in the slot; send it again")
        return data

    def use(self, number: int) -> None:
        """Acknowledges, on the side of the loop, that this setting is now in use."""
        self._used[0] = number
