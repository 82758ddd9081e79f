"""Connection of the load encoders' watch to the service: the models it uses and the advice it gives."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.recorder.recorder import FlightRecorder
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.watch.sink import WatchSink
from hdbridge.model import TransmissionModel

_log = logging.getLogger(__name__)


class Watching:
    """A sink of the observer; its advice is the bridge's from now on."""

    def __init__(self, machine: Machine, bridge: ServiceBridge, recorder: FlightRecorder | None) -> None:
        """``recorder`` supplies the data of a diagnosis; without it nothing is diagnosed."""
        self._names = [axis.name for axis in machine.axes]
        self._bridge = bridge
        self._sink = WatchSink.of(machine, self._tell, recorder)
        self._used: list[TransmissionModel | None] = [None] * len(self._names)
        bridge.advice = self._sink.advice

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples from the observer; watches the committed model, whatever the scheme or adaptation."""
        for place, port in enumerate(self._bridge.axes.values()):
            model = port.models.chosen.model
            if self._used[place] is not model:
                self._used[place] = model
                self._sink.use(place, model)
        self._sink.take(samples, events, lost)

    def close(self) -> None:
        """Ends the watch's thread and the processes it started."""
        self._sink.close()

    def _tell(self, words: str, place: int) -> None:
        """Notes and logs a message, from the watch's thread."""
        self._bridge.core.log.note(words, place)
        _log.warning("watch", {"axis": self._names[place], "text": words})
