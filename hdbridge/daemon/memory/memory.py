"""The shared memory, as used by both processes."""

from __future__ import annotations

from typing import Self

from hdbridge.daemon.memory.events import EventReader, EventWriter
from hdbridge.daemon.memory.frames import IncomingReader, IncomingWriter, Outgoing
from hdbridge.daemon.memory.knots import KnotQueue
from hdbridge.daemon.memory.layout import AXES_AT_MOST, Layout
from hdbridge.daemon.memory.mailbox import Mailbox
from hdbridge.daemon.memory.region import ORDERED, Region
from hdbridge.daemon.memory.samples import SampleReader, SampleWriter
from hdbridge.daemon.memory.setting import SettingSlot
from hdbridge.daemon.memory.status import OuterCells, Status
from hdbridge.errors import InputError


class Memory:
    """Shared memory for the axes of one bus.

    The control process writes ``samples``, ``events`` and ``incoming``, and takes from ``commands``,
    ``outgoing``, ``knots``, ``settings`` and ``followed``. The service does the opposite; it may create any
    number of readers (`reader`, `event_reader`, `incoming_reader`). The gateway process fills ``followed``
    and shares ``outer`` with the service.
    """

    def __init__(self, region: Region, layout: Layout, period_ns: int, *, checked: bool) -> None:
        """Use `create` or `attach` instead."""
        self._region = region
        self._layout = layout
        self._checked = checked
        self.axes = layout.axes
        self.period_ns = period_ns
        self.samples = SampleWriter(region, layout, checked=checked)
        self.events = EventWriter(region, layout, checked=checked)
        self.incoming = IncomingWriter(region, layout, checked=checked)
        self.outgoing = Outgoing(region, layout, checked=checked)
        self.commands = Mailbox(region, layout, checked=checked)
        self.knots = tuple(KnotQueue(region, place, checked=checked) for place in layout.knots)
        self.settings = tuple(SettingSlot(region, place) for place in layout.settings)
        self.followed = tuple(KnotQueue(region, place, checked=checked) for place in layout.followed)
        self.outer = tuple(OuterCells(region, place) for place in layout.outer)
        self.status = Status(region)

    @classmethod
    def create(cls, axes: int, period_s: float, *, checked: bool = not ORDERED) -> Self:
        """Creates memory. ``checked`` adds checksums to the slots, for weakly ordered processors."""
        period_ns = round(1e9 * period_s)
        if not 1 <= axes <= AXES_AT_MOST or period_ns < 1:
            raise InputError(
                f"{axes} axes at {period_s} s: expected 1 to {AXES_AT_MOST} axes, a period above 0"
            )
        layout = Layout.of(axes)
        return cls(Region.create(layout, period_ns, checked=checked), layout, period_ns, checked=checked)

    @classmethod
    def attach(cls, fd: int) -> Self:
        """Attaches to another process's memory by its descriptor, which `close` closes.

        Raises InputError if it is not shared memory of this version of hdbridge.
        """
        region, layout, period_ns, checked = Region.attach(fd)
        return cls(region, layout, period_ns, checked=checked)

    @property
    def fd(self) -> int:
        """Descriptor to pass to another process."""
        return self._region.fd

    @property
    def period_s(self) -> float:
        """Period of the cycle."""
        return self.period_ns / 1e9

    def reader(self) -> SampleReader:
        """Returns a reader of the samples from now on."""
        return SampleReader(self._region, self._layout, checked=self._checked)

    def event_reader(self) -> EventReader:
        """Returns a reader of the events from now on."""
        return EventReader(self._region, self._layout, checked=self._checked)

    def incoming_reader(self) -> IncomingReader:
        """Returns a reader of relayed frames from now on."""
        return IncomingReader(self._region, self._layout, checked=self._checked)

    def close(self) -> None:
        """Unmaps the memory, which is freed when all processes have done so."""
        self._region.close()

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Calls `close`."""
        self.close()
