"""The ring of cycle samples: one packed slot per cycle out of the loop, arrays of them for whoever reads."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

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
from hdbridge.daemon.memory.rings import RETRIES

SampleArray = npt.NDArray[np.void]
"""Samples as `sample_dtype` has them, shape (n,)."""
_CHECK: Final = struct.Struct("@I")


def joined_samples(batches: Sequence[SampleArray]) -> SampleArray:
    """One after the other, as plain bytes: joining them field by field takes four times as long."""
    plain = np.dtype((np.void, batches[0].dtype.itemsize))
    return np.concatenate([each.view(plain) for each in batches]).view(batches[0].dtype)


class SampleWriter:
    """The loop's end. Plain numbers in, no numpy: a third of the time."""

    __slots__ = ("_buffer", "_checked", "_head", "_offset", "_pack_into", "_sequence", "_size")

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        packed = sample_struct(layout.axes)
        assert packed.size == layout.samples.slot_bytes == slot_dtype(layout.axes).itemsize
        self._buffer = region.view
        self._offset, _, self._size = layout.samples
        self._pack_into = packed.pack_into
        self._head = region.cells(self._offset - 2 * LINE, 1)
        self._sequence: int = self._head[0]
        self._checked = checked

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
        """One cycle's sample; ``axes`` has the fields of `layout.Axis` of one axis after the other."""
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
    """Gives the samples that came since it was made, or since its last `read`."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._slots: npt.NDArray[Any] = np.frombuffer(
            region.view, slot_dtype(layout.axes), SAMPLES_KEPT, layout.samples.offset
        )
        self._dtype = sample_dtype(layout.axes)
        self._head = region.cells(layout.samples.offset - 2 * LINE, 1)
        self._checked = checked
        self._next: int = self._head[0] + 1

    def read(self) -> tuple[SampleArray, int]:
        """The new samples, oldest first, as an array of its own; and how many were lost before them.

        Lost are those that were overwritten before they were read.
        """
        first = self._next
        end: int = self._head[0]
        self._next = end + 1
        # The slot after the newest may be under way, and it lies where the oldest did.
        kept = self._copy(max(first, end + 2 - SAMPLES_KEPT), end)
        return kept.view(self._dtype), end + 1 - first - len(kept)

    def _copy(self, first: int, end: int) -> npt.NDArray[Any]:
        """The slots with these numbers, as far as they are whole."""
        wanted = np.arange(first, end + 1)
        for _ in range(RETRIES):
            slots = self._slots[wanted % SAMPLES_KEPT]
            # What was overwritten during the copy is lost, and what follows it is whole.
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
