"""Single numbers that one process writes and the others look at: who is alive, and since when."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from hdbridge.daemon.memory.layout import LINE, STATUS_OFFSET
from hdbridge.daemon.memory.region import Region

_STRIDE: Final = LINE // 8


class Cell(IntEnum):
    """The cells, each in a cache line of its own."""

    LOOP_COUNT = 0
    LOOP_TIME_NS = 1
    SERVICE_TIME_NS = 2
    KEEPER_TIME_NS = 3
    LOOP_PID = 4
    SERVICE_PID = 5
    STOP_ASKED = 6


_LOOP_COUNT: Final = Cell.LOOP_COUNT * _STRIDE
_LOOP_TIME: Final = Cell.LOOP_TIME_NS * _STRIDE


class Status:
    """The cells by name. To read or write one is whole."""

    __slots__ = ("_cells",)

    def __init__(self, region: Region) -> None:
        self._cells = region.cells(STATUS_OFFSET, len(Cell) * _STRIDE)

    @property
    def loop_count(self) -> int:
        """Turns of the loop, of all control processes so far."""
        return int(self._cells[Cell.LOOP_COUNT * _STRIDE])

    @property
    def loop_time_ns(self) -> int:
        """When the loop's last turn was over, ``time.monotonic_ns``; 0 before the first."""
        return int(self._cells[Cell.LOOP_TIME_NS * _STRIDE])

    @property
    def service_time_ns(self) -> int:
        """When the service was last seen alive, ``time.monotonic_ns``."""
        return int(self._cells[Cell.SERVICE_TIME_NS * _STRIDE])

    @property
    def keeper_time_ns(self) -> int:
        """When the keeper was last seen alive, ``time.monotonic_ns``."""
        return int(self._cells[Cell.KEEPER_TIME_NS * _STRIDE])

    @property
    def loop_pid(self) -> int:
        """Process number of the control process; it changes when another takes its place."""
        return int(self._cells[Cell.LOOP_PID * _STRIDE])

    @property
    def service_pid(self) -> int:
        """Process number of the service."""
        return int(self._cells[Cell.SERVICE_PID * _STRIDE])

    @property
    def stop_asked(self) -> int:
        """Somebody wants the loop to end: 1 after it has stopped all axes in order, 2 after a quick stop."""
        return int(self._cells[Cell.STOP_ASKED * _STRIDE])

    def turned(self, count: int, time_ns: int) -> None:
        """The loop's turn is over."""
        cells = self._cells
        cells[_LOOP_COUNT] = count
        cells[_LOOP_TIME] = time_ns

    def set(self, cell: Cell, value: int) -> None:
        """Write a cell; each has one writer (``STOP_ASKED``: anybody, and never back)."""
        self._cells[cell * _STRIDE] = value
