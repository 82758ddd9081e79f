"""Status cells: numbers written by one process and monitored by the others."""

from enum import IntEnum
from typing import Final

from hdbridge.daemon.memory.layout import LINE, OUTER_VIEW, STATUS_OFFSET, OuterCell, OuterView, Place
from hdbridge.daemon.memory.region import Region

_STRIDE: Final = LINE // 8


class Cell(IntEnum):
    """Status cells, each in its own cache line."""

    LOOP_COUNT = 0
    LOOP_TIME_NS = 1
    SERVICE_TIME_NS = 2
    KEEPER_TIME_NS = 3
    LOOP_PID = 4
    SERVICE_PID = 5
    STOP_ASKED = 6
    GATEWAY_TIME_NS = 7
    GATEWAY_PID = 8
    BUS_WANTED = 9
    """Service: 1 while it waits for the bus to be released to another program."""
    BUS_LENT = 10
    """Keeper: when it released the interface to another program (``time.monotonic_ns``); 0 if it did not."""


_LOOP_COUNT: Final = Cell.LOOP_COUNT * _STRIDE
_LOOP_TIME: Final = Cell.LOOP_TIME_NS * _STRIDE


class Status:
    """Access to the cells by name. Reads and writes are atomic."""

    def __init__(self, region: Region) -> None:
        self._cells = region.cells(STATUS_OFFSET, len(Cell) * _STRIDE)

    @property
    def loop_count(self) -> int:
        """Turns of the loop, over all control processes so far."""
        return int(self._cells[Cell.LOOP_COUNT * _STRIDE])

    @property
    def loop_pid(self) -> int:
        """Process id of the control process; 0 if there is none."""
        return int(self._cells[Cell.LOOP_PID * _STRIDE])

    @property
    def stop_asked(self) -> int:
        """Request to end the loop: 1 after braking all axes to rest, 2 after a quick stop."""
        return int(self._cells[Cell.STOP_ASKED * _STRIDE])

    def get(self, cell: Cell) -> int:
        """Read a cell."""
        return int(self._cells[cell * _STRIDE])

    def turned(self, count: int, time_ns: int) -> None:
        """Records the end of a turn."""
        cells = self._cells
        cells[_LOOP_COUNT] = count
        cells[_LOOP_TIME] = time_ns

    def set(self, cell: Cell, value: int) -> None:
        """Writes a cell. Each has one writer, except ``STOP_ASKED``, which any process may raise."""
        self._cells[cell * _STRIDE] = value


class OuterCells:
    """The cells of one axis that gateway process and service share. To read or write one is whole."""

    def __init__(self, region: Region, place: Place) -> None:
        self._cells = region.cells(place.offset, len(OuterCell) * _STRIDE)
        self._buffer, self._at = region.view, place.offset + OuterCell.VIEW * LINE

    def __getitem__(self, cell: OuterCell) -> int:
        return int(self._cells[cell * _STRIDE])

    def __setitem__(self, cell: OuterCell, value: int) -> None:
        self._cells[cell * _STRIDE] = value

    def show(self, view: OuterView) -> None:
        """Writes the view of the outer master in one copy, unlike `pack_into`, which begins with zeros."""
        self._buffer[self._at : self._at + OUTER_VIEW.size] = OUTER_VIEW.pack(*view)

    def values(self) -> tuple[float, ...]:
        """Returns the fields of `OuterView`; in the cycle of the control process, so as a plain tuple."""
        return OUTER_VIEW.unpack_from(self._buffer, self._at)

    @property
    def view(self) -> OuterView:
        """The view of the outer master."""
        return OuterView._make(OUTER_VIEW.unpack_from(self._buffer, self._at))
