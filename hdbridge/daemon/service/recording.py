"""Connection of the flight recorder to the service: its models, remarks and state."""

import logging
from collections.abc import Sequence

from hdbridge.client import messages
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.recorder.about import About, AxisAbout
from hdbridge.daemon.recorder.flightlog import ModelUse
from hdbridge.daemon.recorder.recorder import FlightRecorder
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.setting import CompensationSetting

_log = logging.getLogger(__name__)


class Recording:
    """A sink of the observer. If the folder cannot be created, it records nothing and reports that."""

    def __init__(self, machine: Machine, bridge: ServiceBridge) -> None:
        """Registers itself with the bridge as recorder and receiver of remarks."""
        self._folder = machine.recorder_folder()
        self._bridge = bridge
        self._note: str | None = None
        self.recorder: FlightRecorder | None = None
        """None if the folder could not be created."""
        self._told: dict[str, CompensationSetting] = {}
        about = About.of(
            machine.name, tuple(AxisAbout.of(axis.config) for axis in machine.axes), machine.cycle_s
        )
        try:
            self.recorder = FlightRecorder(self._folder, about, machine.recorder, tell=self._tell)
        except OSError as problem:
            self._tell(f"{self._folder}: cannot be made: {problem.strerror}; nothing is recorded")
        else:
            bridge.marks.append(self.recorder.mark)
        bridge.recorder = self.state

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer."""
        if self.recorder is None:
            return
        for name, axis in self._bridge.axes.items():
            in_use = axis.models.in_use
            if self._told.get(name) is not in_use:
                self._told[name] = in_use
                version = str(in_use.version) if in_use.version is not None else ""
                self.recorder.put(ModelUse(name, version, in_use.compensating.dump()))
        self.recorder.take(samples, events, lost)

    def state(self) -> messages.RecorderState:
        """Returns the state of the recorder for clients."""
        if self.recorder is None:
            return messages.RecorderState(on=False, folder=str(self._folder), note=self._note)
        counts = self.recorder.counts
        return messages.RecorderState(
            on=True, folder=str(self._folder), dropped=counts.dropped + counts.refused, note=self._note
        )

    def close(self) -> None:
        """Finishes the file; returns when it is on the disk."""
        if self.recorder is not None:
            self.recorder.close()

    def _tell(self, text: str) -> None:
        """Notes and logs a message; also called from the recorder's thread."""
        self._note = text
        self._bridge.core.log.note(text)
        _log.warning("recorder", {"text": text})
