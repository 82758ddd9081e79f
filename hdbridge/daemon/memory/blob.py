"""One slot for something large: the pickled compensation that the loop is to change to."""

from __future__ import annotations

import zlib

from hdbridge.daemon.memory.layout import LINE, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.errors import InputError


class Blob:
    """Both ends of the slot. It holds one thing at a time: the newest, under its number."""

    def __init__(self, region: Region, layout: Layout) -> None:
        self._view = region.view
        self._offset, _, self._room = layout.blob
        self._cells = region.cells(self._offset - 2 * LINE, 3)  # number, length, crc

    @property
    def number(self) -> int:
        """Of what is there; 0 where nothing is, negative while it is being stored."""
        return int(self._cells[0])

    def put(self, data: bytes) -> int:
        """Store ``data``; its number, for the command that tells the loop of it. InputError if too large."""
        if len(data) > self._room:
            raise InputError(
                f"the compensation takes {len(data)} bytes, the control process takes at most {self._room}: "
                "use a model with fewer effects or smaller tables"
            )
        number: int = abs(self._cells[0]) + 1
        self._cells[0] = -number  # what is there is being overwritten
        self._view[self._offset : self._offset + len(data)] = data
        self._cells[1], self._cells[2] = len(data), zlib.crc32(data)
        self._cells[0] = number
        return number

    def get(self, number: int) -> bytes:
        """What was stored under that number. InputError where it is not (or no longer) there as a whole."""
        length: int = self._cells[1]
        data = bytes(self._view[self._offset : self._offset + length]) if 0 <= length <= self._room else b""
        if self._cells[0] != number or len(data) != length or zlib.crc32(data) != self._cells[2]:
            raise InputError(f"the compensation number {number} was overwritten by another; send it again")
        return data
