"""Faults of the supervision as events: each that has a reaction, and of the others not too many."""

from __future__ import annotations

import math
from typing import Final, Protocol

from hdbridge.daemon.memory.layout import EventKind
from hdbridge.drive.supervision import Fault, Reaction, Supervision

TOLD_EVERY_S: Final = 1.0
"""A fault that changes nothing is told no more often than this."""
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

    __slots__ = ("_axis", "_every", "_last", "_noted", "_supervision", "_tell")

    def __init__(self, axis: int, supervision: Supervision, tell: Tell, period_s: float) -> None:
        self._axis, self._supervision, self._tell = axis, supervision, tell
        self._every = math.ceil(TOLD_EVERY_S / period_s)
        self._noted = supervision.noted
        self._last: dict[Fault, int] = {}
        """The cycle in which each was told last."""

    def tell(self) -> None:
        """What is new since the last turn."""
        supervision = self._supervision
        if supervision.noted == self._noted:
            return
        last = self._last
        for event in supervision.since(self._noted):
            before = last.get(event.fault)
            if event.reaction is Reaction.GO and before is not None and event.cycle - before < self._every:
                continue
            last[event.fault] = event.cycle
            code = FAULT_INDEX[event.fault]
            self._tell(self._axis, EventKind.FAULT, event.reaction, code, event.detail)
        self._noted = supervision.noted
