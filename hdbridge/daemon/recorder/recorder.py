"""Flight recorder: all samples and events of the loop, on disk within a second.

`FlightRecorder` is a sink of `Core`. It never blocks and uses bounded memory. Data that arrives faster
than its thread can process is dropped, counted and reported. `flightlog` does the thread's work.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from hdbridge.client import messages
from hdbridge.daemon.machinefile import RecorderSettings
from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.recorder.flightfile import About, ModelUse
from hdbridge.daemon.recorder.flightlog import Batch, FlightLog, Note, free_bytes
from hdbridge.daemon.setting import CompensationSetting

FLUSH_S: Final = 1.0
QUEUE_BATCHES: Final = 500
"""Maximum number of waiting items: ten seconds of batches."""
_log = logging.getLogger(__name__)


class FlightRecorder:
    """Sink that passes everything to its thread; another thread repairs files of earlier processes.

    If the folder cannot be created, it records nothing and reports the failure.
    """

    def __init__(
        self,
        folder: Path,
        about: About,
        settings: RecorderSettings | None = None,
        *,
        notify: Callable[[str], None] = lambda _: None,
        in_use: Callable[[], Mapping[str, CompensationSetting]] = dict,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """``in_use`` returns the setting that compensates each axis. The threads here call ``notify``."""
        self.folder = folder
        self.flight: FlightLog | None = None
        """None if the folder could not be created."""
        self._notify_user, self._in_use = notify, in_use
        self._note: str | None = None
        self._dropped = 0
        """Cycles dropped because the thread was too slow."""
        self._recorded: dict[str, CompensationSetting] = {}
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            flight = FlightLog(folder, settings or RecorderSettings(), about, notify=self._notify, free=free)
        except OSError as problem:
            self._notify(f"{folder}: cannot create this folder: {problem.strerror}; nothing is recorded")
            return
        self.flight = flight
        # Repair may take a long time. It can be killed safely, because each file is repaired completely or
        # not at all.
        for name, run in (("recorder", self._run), ("recorder-mend", self._mend)):
            thread = threading.Thread(target=run, args=(flight,), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the service's core; never waits."""
        for axis, setting in self._in_use().items():
            if self._recorded.get(axis) is not setting:
                self._recorded[axis] = setting
                version = str(setting.version) if setting.version is not None else ""
                self.put(ModelUse(axis, version, setting.compensating.dump()))
        if self.flight is None:
            return
        if len(self.flight.waiting) < QUEUE_BATCHES:
            self.flight.put(Batch(samples, tuple(events), lost))
            return
        if not self._dropped:
            self._notify("the recorder is too slow: cycles are dropped")
        self._dropped += len(samples)

    def put(self, item: ModelUse | Note) -> None:
        """Records a change of model or a note. Both are rare and never dropped."""
        if self.flight is not None:
            self.flight.put(item)

    def note(self, kind: str, text: str) -> None:
        """Records a note; the time around a `flightlog.MARK` is kept, like that around a fault."""
        self.put(Note(kind, text))

    def state(self) -> messages.RecorderState:
        """Returns the state of the recorder for clients."""
        return messages.RecorderState(
            on=self.flight is not None,
            folder=str(self.folder),
            dropped=self._dropped + (self.flight.refused if self.flight is not None else 0),
            note=self._note,
        )

    def close(self) -> None:
        """Finishes the file; returns once it is on the disk."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _notify(self, text: str) -> None:
        self._note = text
        _log.warning("recorder", {"text": text})
        self._notify_user(text)

    def _mend(self, flight: FlightLog) -> None:
        try:
            flight.mend()
        except Exception:
            _log.exception("unfinished recordings could not be repaired")

    def _run(self, flight: FlightLog) -> None:
        begun_s, reported, ended = time.monotonic(), 0, False
        while not ended:
            ended = self._ended.wait(max(begun_s + FLUSH_S - time.monotonic(), 0.0))
            begun_s = time.monotonic()
            if dropped := self._dropped - reported:
                flight.put(Note("DROPPED", f"{dropped} cycles were dropped: the recorder was too slow"))
                reported += dropped
            try:
                flight.close() if ended else flight.flush()
            except Exception:
                _log.exception("the recorder failed; it continues")
