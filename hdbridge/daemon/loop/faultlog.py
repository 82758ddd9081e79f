"""Faults of the supervision as events: one when a fault begins, one when its reaction becomes graver."""

from __future__ import annotations

import math
from typing import Final, Protocol

from hdbridge.daemon.memory.layout import EventKind
from hdbridge.drive.supervision import Fault, Reaction, Supervision

OVER_S: Final = 1.0
"""A fault that was absent for so long is over; it is told again when it comes back."""
CODES_KEPT: Final = 64
FAULT_INDEX: Final = {fault: place for place, fault in enumerate(Fault)}
"""The numbers of faults in events and samples."""


class Tell(Protocol):
    """How the loop tells the service something of an axis (-1: of the machine)."""

    def __call__(
        self,
        axis: int,
        kind: EventKind,
        id: int = 0,  # noqa: A002
        code: int = 0,
        text: str = "",
    ) -> None:
        """Add an event."""


class FaultLog:
    """Of one axis."""

    __slots__ = ("_axis", "_noted", "_over", "_seen", "_supervision", "_tell")

    def __init__(self, axis: int, supervision: Supervision, tell: Tell, period_s: float) -> None:
        self._axis, self._supervision, self._tell = axis, supervision, tell
        self._over = math.ceil(OVER_S / period_s)
        self._noted = supervision.noted
        self._seen: dict[tuple[Fault, str], tuple[int, Reaction]] = {}
        """The last cycle of each fault, and the gravest reaction that was told."""

    def tell(self) -> None:
        """What is new since the last turn."""
        supervision = self._supervision
        if supervision.noted == self._noted:
            return
        for event in supervision.since(self._noted):
            # Emergency messages with different codes are different faults.
            code = event.detail.partition(",")[0] if event.fault is Fault.EMERGENCY else ""
            last, told = self._seen.pop((event.fault, code), (-self._over, None))
            stops = event is supervision.stop or event is supervision.gravest
            if stops or told is None or event.reaction > told or event.cycle - last >= self._over:
                told = event.reaction
                self._tell(self._axis, EventKind.FAULT, told, FAULT_INDEX[event.fault], event.detail)
            self._seen[event.fault, code] = event.cycle, told
            if len(self._seen) > CODES_KEPT:
                del self._seen[next(iter(self._seen))]
        self._noted = supervision.noted
