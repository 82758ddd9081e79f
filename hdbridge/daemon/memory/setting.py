"""The compensation setting of one axis: written by the service, acknowledged by the loop."""

import threading
import zlib

from hdbridge.daemon.memory.layout import LINE, Place
from hdbridge.daemon.memory.region import Region
from hdbridge.errors import InputError


class SettingSlot:
    """Slot of one axis with both ends. It contains the last setting sent, under its number.

    It outlives both processes: a starting service reads the setting that an earlier one sent.
    """

    def __init__(self, region: Region, place: Place) -> None:
        self._view = region.view
        self._offset, _, self._capacity = place
        self._sent = region.cells(self._offset - 2 * LINE, 3)  # number, length, crc
        self._used = region.cells(self._offset - LINE, 1)
        self._putting = threading.Lock()  # between threads of the service; the loop does not use it

    @property
    def number(self) -> int:
        """Number of the setting in the slot; 0 before the first, negative while one is being written."""
        return int(self._sent[0])

    @property
    def in_use(self) -> int:
        """Number of the setting that the loop uses; 0 if it has taken none since it started."""
        return int(self._used[0])

    def put(self, data: bytes) -> int:
        """Store a setting; returns its number, which is the argument of CHANGE. InputError if too large."""
        if len(data) > self._capacity:
            raise InputError(
                f"the compensation takes {len(data)} bytes, the control process takes at most "
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
        """Returns the setting with this number. Raises InputError if the slot does not contain all of it."""
        length: int = self._sent[1]
        data = bytes(self._view[self._offset : self._offset + min(max(length, 0), self._capacity)])
        whole = len(data) == length and zlib.crc32(data) == self._sent[2]
        if number <= 0 or self._sent[0] != number or not whole:
            raise InputError(f"the compensation setting number {number} is not in the slot; send it again")
        return data

    def use(self, number: int) -> None:
        """Acknowledges, at the loop's end, that this setting is in use from now on."""
        self._used[0] = number
