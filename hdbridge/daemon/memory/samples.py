"""Ring of samples: the loop writes one packed slot per cycle, readers get arrays of them."""

import struct
import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hdbridge.daemon.memory.channels import RETRIES
from hdbridge.daemon.memory.layout import (
    LINE,
    SAMPLES_KEPT,
    TAIL_BYTES,
    Layout,
    sample_dtype,
    sample_struct,
    slot_dtype,
)
from hdbridge.daemon.memory.region import Region

SampleArray = npt.NDArray[np.void]
"""Samples with the dtype `sample_dtype`, shape (n,)."""
_CHECK: Final = struct.Struct("@I")


def joined_samples(batches: Sequence[SampleArray]) -> SampleArray:
    """Returns the concatenated batches, joined as plain bytes, which is four times faster than by field."""
    plain = np.dtype((np.void, batches[0].dtype.itemsize))
    return np.concatenate([each.view(plain) for each in batches]).view(batches[0].dtype)


class SampleWriter:
    """The loop's end. It packs plain numbers without numpy, in a third of the time."""

    def __init__(self, region: Region, layout: Layout) -> None:
        packed = sample_struct(layout.axes)
        assert packed.size == layout.samples.slot_bytes == slot_dtype(layout.axes).itemsize
        self._buffer = region.view
        self._offset, _, self._size = layout.samples
        self._pack_into = packed.pack_into
        self._head = region.cells(self._offset - 2 * LINE, 1)
        self._sequence: int = self._head[0]
        self._checked = region.checked

    def write(
        self,
        cycle: int,
        time_ns: int,
        late_us: float,
        busy_us: float,
        bus_load: float,
        skipped: int,
        axes: Sequence[float],
    ) -> None:
        """Writes one cycle's sample; ``axes`` has the fields of `layout.Axis` of all axes in order."""
        sequence = self._sequence + 1
        at = self._offset + sequence % SAMPLES_KEPT * self._size
        self._pack_into(
            self._buffer,
            at,
            sequence,
            cycle,
            time_ns,
            late_us,
            busy_us,
            bus_load,
            skipped,
            *axes,
            0,
            sequence,
        )
        if self._checked:
            end = at + self._size - TAIL_BYTES
            _CHECK.pack_into(self._buffer, end, zlib.crc32(self._buffer[at:end]))
        self._head[0] = self._sequence = sequence


class SampleReader:
    """Reads the samples since it was created or since its last `read`."""

    def __init__(self, region: Region, layout: Layout) -> None:
        self._slots: npt.NDArray[Any] = np.frombuffer(
            region.view, slot_dtype(layout.axes), SAMPLES_KEPT, layout.samples.offset
        )
        self._dtype = sample_dtype(layout.axes)
        self._head = region.cells(layout.samples.offset - 2 * LINE, 1)
        self._checked = region.checked
        self._next: int = self._head[0] + 1

    def read(self) -> tuple[SampleArray, int]:
        """Returns a copy of the new samples, oldest first, and the number lost before them.

        Samples are lost if they are overwritten before they are read.
        """
        first = self._next
        end: int = self._head[0]
        self._next = end + 1
        # The slot after the newest may be in progress, and it replaces the oldest.
        kept = self._copy(max(first, end + 2 - SAMPLES_KEPT), end)
        return kept.view(self._dtype), end + 1 - first - len(kept)

    def _copy(self, first: int, end: int) -> npt.NDArray[Any]:
        """Returns the complete slots with these numbers."""
        wanted = np.arange(first, end + 1)
        for _ in range(RETRIES):
            slots = self._slots[wanted % SAMPLES_KEPT]
            # Slots overwritten during the copy are lost; those after them are complete.
            overwritten = self._head[0] + 2 - SAMPLES_KEPT - first
            if overwritten > 0:
                first += overwritten
                slots, wanted = slots[overwritten:], wanted[overwritten:]
            whole = (slots["sequence"] == wanted) & (slots["last"] == wanted)
            if self._checked:
                whole &= slots["check"] == [zlib.crc32(each.tobytes()[:-TAIL_BYTES]) for each in slots]
            if whole.all():
                break
        kept: npt.NDArray[Any] = slots[whole]
        return kept
