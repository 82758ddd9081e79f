"""Faults of the supervision as events: one when a fault begins, one when its reaction becomes more severe."""

import math
from typing import Final, Protocol

from hdbridge.daemon.memory.layout import EventKind
from hdbridge.drive.supervision import Fault, Reaction, Supervision

OVER_S: Final = 1.0
"""Time after which an absent fault counts as over, so that it is reported again if it returns."""
CODES_KEPT: Final = 64
FAULT_INDEX: Final = {fault: place for place, fault in enumerate(Fault)}
"""Number of each fault in events and samples."""
_FAULTS: Final = dict(enumerate(Fault))


def fault_of(code: int) -> Fault | None:
    """Returns the fault with this number in events and samples; None for any other number."""
    return _FAULTS.get(code)


class Report(Protocol):
    """Reports an event of one axis to the service."""

    def __call__(self, kind: EventKind, id_: int = 0, code: int = 0, text: str = "") -> None: ...


class FaultLog:
    """Reports the faults of one axis without repeating those that persist."""

    def __init__(self, supervision: Supervision, report: Report, period_s: float) -> None:
        self._supervision, self._report = supervision, report
        self._over = math.ceil(OVER_S / period_s)
        self._noted = supervision.noted
        self._seen: dict[tuple[Fault, str], tuple[int, Reaction]] = {}
        """Last cycle and most severe reported reaction of each fault."""

    def report(self) -> None:
        """Reports the new faults since the last cycle."""
        supervision = self._supervision
        if supervision.noted == self._noted:
            return
        for event in supervision.since(self._noted):
            # Emergency messages with different codes are different faults.
            code = event.detail.partition(",")[0] if event.fault is Fault.EMERGENCY else ""
            last, reported = self._seen.pop((event.fault, code), (-self._over, None))
            stops = event is supervision.stop or event is supervision.gravest
            if stops or reported is None or event.reaction > reported or event.cycle - last >= self._over:
                reported = event.reaction
                self._report(EventKind.FAULT, reported, FAULT_INDEX[event.fault], event.detail)
            self._seen[event.fault, code] = event.cycle, reported
            if len(self._seen) > CODES_KEPT:
                del self._seen[next(iter(self._seen))]
        self._noted = supervision.noted
