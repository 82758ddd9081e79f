"""The shared memory as both processes see it, each using its ends of what is in it."""

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
from hdbridge.daemon.memory.status import Status
from hdbridge.errors import InputError


class Memory:
    """Shared memory for a number of axes on one bus.

    The control process writes ``samples``, ``events`` and ``incoming`` and takes from ``commands``,
    ``outgoing``, ``knots`` and ``settings``; the service does the opposite, with readers of its own
    (`reader`, `event_reader`, `incoming_reader`: as many as it likes).
    """

    def __init__(self, region: Region, layout: Layout, period_ns: int, *, checked: bool) -> None:
        """Use `create` or `attach`."""
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
        self.status = Status(region)

    @classmethod
    def create(cls, axes: int, period_s: float, *, checked: bool = not ORDERED) -> Self:
        """New memory. ``checked`` puts a checksum into each slot: for a processor with weak ordering."""
        period_ns = round(1e9 * period_s)
        if not 1 <= axes <= AXES_AT_MOST or period_ns < 1:
            raise InputError(
                f"{axes} axes at {period_s} s: expected 1 to {AXES_AT_MOST} axes, a period above 0"
            )
        layout = Layout.of(axes)
        return cls(Region.create(layout, period_ns, checked=checked), layout, period_ns, checked=checked)

    @classmethod
    def attach(cls, fd: int) -> Self:
        """Memory that another process has made, by its descriptor; InputError where it is none of ours.

        The descriptor is then this object's: `close` closes it.
        """
        region, layout, period_ns, checked = Region.attach(fd)
        return cls(region, layout, period_ns, checked=checked)

    @property
    def fd(self) -> int:
        """Descriptor to hand down to another process."""
        return self._region.fd

    @property
    def period_s(self) -> float:
        """Period of the cycle."""
        return self.period_ns / 1e9

    def reader(self) -> SampleReader:
        """Reads samples from now on."""
        return SampleReader(self._region, self._layout, checked=self._checked)

    def event_reader(self) -> EventReader:
        """Reads events from now on."""
        return EventReader(self._region, self._layout, checked=self._checked)

    def incoming_reader(self) -> IncomingReader:
        """Reads relayed frames from now on."""
        return IncomingReader(self._region, self._layout, checked=self._checked)

    def close(self) -> None:
        """Leave the memory; it is gone when all have left."""
        self._region.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """`close`."""
        self.close()
