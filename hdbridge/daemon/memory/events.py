"""Ring of events from the loop to the service."""

from __future__ import annotations

from typing import Final

from hdbridge.daemon.memory.layout import EVENT, TEXT_BYTES, Event, EventKind, Layout
from hdbridge.daemon.memory.region import Region
from hdbridge.daemon.memory.rings import Ring, RingReader

_KINDS: Final = {int(kind): kind for kind in EventKind}


class EventWriter:
    """The loop's end of the ring."""

    __slots__ = ("_append",)

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._append = Ring(region, layout.events, EVENT, checked=checked).append

    def tell(
        self,
        cycle: int,
        time_ns: int,
        axis: int,
        kind: EventKind,
        id: int = 0,  # noqa: A002
        code: int = 0,
        text: str = "",
    ) -> None:
        """Adds an event; truncates a long text."""
        data = text.encode("utf-8", "replace")[:TEXT_BYTES]
        self._append(cycle, time_ns, axis, kind, id, code, len(data), data)


class EventReader:
    """Reads the events since it was created or since its last `read`."""

    def __init__(self, region: Region, layout: Layout, *, checked: bool) -> None:
        self._ring = RingReader(region, layout.events, EVENT, checked=checked)

    def read(self) -> tuple[list[Event], int]:
        """Returns the new events, oldest first, and the number lost."""
        slots, lost = self._ring.read()
        return [_event(sequence, *values) for sequence, values in slots], lost


def _event(
    sequence: int,
    cycle: int,
    time_ns: int,
    axis: int,
    kind: int,
    id: int,  # noqa: A002
    code: int,
    length: int,
    text: bytes,
) -> Event:
    # Cutting may have split the last character.
    return Event(
        sequence, cycle, time_ns, axis, _KINDS[kind], id, code, text[:length].decode("utf-8", "ignore")
    )
