"""Shared memory of the daemon's processes, created by one and passed to the others as a descriptor."""

import os
import platform
import struct
from contextlib import suppress
from typing import Final, Self

from hdbridge.daemon.memory.cells import Cell, Cells, OuterCells, Region, SettingSlot
from hdbridge.daemon.memory.channels import (
    COMMANDS,
    EVENTS,
    FOLLOWED,
    FRAMES,
    KNOTS,
    Mailbox,
    Queue,
    Ring,
    RingReader,
    SampleReader,
    samples_of,
)
from hdbridge.daemon.memory.layout import (
    AXES_AT_MOST,
    HEADER,
    NO_OUTER,
    STATUS_OFFSET,
    Event,
    Layout,
    RelayedFrame,
)
from hdbridge.errors import InputError

_STRONGLY_ORDERED: Final = frozenset({"x86_64", "amd64", "i386", "i586", "i686"})
ORDERED: Final = platform.machine().lower() in _STRONGLY_ORDERED
"""True if all processors see the stores of one processor in program order."""


class Memory:
    """Shared memory for the axes of one bus.

    The control process writes ``samples``, ``events`` and ``incoming``, and takes from ``commands``,
    ``outgoing``, ``knots``, ``settings`` and ``followed``. The service does the opposite; it may create any
    number of readers (`reader`, `event_reader`, `incoming_reader`). The gateway process fills ``followed``
    and shares ``outer`` with the service.
    """

    def __init__(self, region: Region, layout: Layout, period_ns: int) -> None:
        """For internal use; call `create` or `attach` instead."""
        self._region = region
        self._layout = layout
        self.axes = layout.axes
        self.period_ns = period_ns
        self.samples = Ring(region, layout.samples, samples_of(layout.axes))
        self.events = Ring(region, layout.events, EVENTS)
        self.incoming = Ring(region, layout.incoming, FRAMES)
        self.outgoing = Queue(region, layout.outgoing, FRAMES)
        self.commands = Mailbox(region, layout.commands, COMMANDS)
        self.knots = tuple(Queue(region, place, KNOTS) for place in layout.knots)
        self.settings = tuple(SettingSlot(region, place) for place in layout.settings)
        self.followed = tuple(Queue(region, place, FOLLOWED) for place in layout.followed)
        self.outer = tuple(OuterCells(region, place) for place in layout.outer)
        self.status = Cells(region, STATUS_OFFSET, Cell)

    @classmethod
    def create(cls, axes: int, period_s: float, *, checked: bool = not ORDERED) -> Self:
        """Creates memory. ``checked`` adds checksums to the slots, for weakly ordered processors.

        Raises InputError for an invalid number of axes or period.
        """
        period_ns = round(1e9 * period_s)
        if not 1 <= axes <= AXES_AT_MOST or period_ns < 1:
            raise InputError(
                f"{axes} axes at {period_s} s: expected 1 to {AXES_AT_MOST} axes, a period above 0"
            )
        layout = Layout.of(axes)
        region = Region.create(layout.total, checked=checked)
        HEADER.pack_into(region.view, 0, layout.mark, axes, period_ns, checked)
        memory = cls(region, layout, period_ns)
        memory.forget_gateway()
        return memory

    @classmethod
    def attach(cls, fd: int) -> Self:
        """Attaches to another process's memory by its descriptor, which `close` closes.

        Raises InputError if it is not shared memory of this version of hdbridge.
        """
        with suppress(OSError, struct.error):
            mark, axes, period_ns, checked = HEADER.unpack(os.pread(fd, HEADER.size, 0))
            if 1 <= axes <= AXES_AT_MOST:
                layout = Layout.of(axes)
                if (mark, os.fstat(fd).st_size) == (layout.mark, layout.total):
                    return cls(Region(fd, layout.total, checked=checked), layout, period_ns)
        raise InputError(
            f"descriptor {fd}: is not the shared memory of this release of hdbridge; expected that of "
            "'hdbridge run': restart the whole daemon"
        )

    def forget_gateway(self) -> None:
        """Clears the outer master's view of all axes, because no gateway process runs."""
        for cells in self.outer:
            cells.show(NO_OUTER)

    @property
    def fd(self) -> int:
        """Descriptor to pass to another process."""
        return self._region.fd

    @property
    def period_s(self) -> float:
        return self.period_ns / 1e9

    def reader(self) -> SampleReader:
        """Returns a reader of samples from now on."""
        return SampleReader(self._region, self._layout.samples, self.axes)

    def event_reader(self) -> RingReader[Event]:
        """Returns a reader of events from now on."""
        return RingReader(self._region, self._layout.events, EVENTS)

    def incoming_reader(self) -> RingReader[RelayedFrame]:
        """Returns a reader of relayed frames from now on."""
        return RingReader(self._region, self._layout.incoming, FRAMES)

    def close(self) -> None:
        """Unmaps the memory, which is freed when all processes have done so."""
        self._region.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
