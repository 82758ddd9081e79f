"""Log lines for the control process's events, because that process writes no log."""

import logging
from collections.abc import Sequence

from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.memory.layout import LEVELS
from hdbridge.drive.supervision import Reaction

_log = logging.getLogger(__name__)


class Journal:
    """A sink of the observer that logs one line per event, with the name of its axis."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer."""
        if lost:
            _log.warning("cycles lost", {"cycles": lost})
        for event in events:
            level = LEVELS.get(event.kind, logging.INFO)
            if _log.isEnabledFor(level):
                _log.log(level, event.kind.name.lower().replace("_", " "), self._facts(event))

    def _facts(self, event: Event) -> dict[str, object]:
        facts: dict[str, object] = {"cycle": event.cycle}
        if 0 <= event.axis < len(self._names):
            facts["axis"] = self._names[event.axis]
        if event.kind is EventKind.STATE:
            facts["state"] = AxisState(event.code).name.lower().replace("_", "-")
        if event.kind is EventKind.FAULT and (fault := fault_of(event.code)) is not None:
            facts["fault"] = fault.name
            facts["reaction"] = Reaction(event.id).name.lower()
        if event.text:
            facts["text"] = event.text
        return facts
