"""The flight recorder: all samples and events of the loop, on disk within a second.

`FlightRecorder` is a sink of the observer. It never blocks and uses bounded memory: data that its thread is
too slow for is dropped, counted and reported. `flightlog` does the thread's work.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.recorder.about import About
from hdbridge.daemon.recorder.flightlog import MARK, Batch, Counts, FlightLog, Item, ModelUse, Note
from hdbridge.daemon.recorder.settings import RecorderSettings
from hdbridge.daemon.recorder.store import Store, free_bytes

FLUSH_S: Final = 1.0
QUEUE_BATCHES: Final = 500
"""Maximum number of waiting items: ten seconds of batches."""
_log = logging.getLogger(__name__)


class FlightRecorder:
    """Sink that passes everything to its thread; another thread mends files of earlier processes."""

    def __init__(
        self,
        folder: Path,
        about: About,
        settings: RecorderSettings | None = None,
        *,
        tell: Callable[[str], None] = lambda _: None,
        wall_ns: Callable[[], int] = time.time_ns,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """The recorder's thread calls ``tell``. Raises OSError if the folder cannot be created."""
        self._flight = FlightLog(
            Store(folder, settings or RecorderSettings(), free), about, tell=tell, wall_ns=wall_ns
        )
        self._queue: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self._tell = tell
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        # Its duration does not matter: each file is mended completely or not at all.
        self._mender = threading.Thread(target=self._mend, name="recorder-mend", daemon=True)
        self._mender.start()

    @property
    def folder(self) -> Path:
        """Folder of the recordings."""
        return self._flight.folder

    @property
    def counts(self) -> Counts:
        """Counts of cycles so far."""
        return replace(self._flight.counts, dropped=self._dropped)

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer; never waits."""
        if self._queue.qsize() < QUEUE_BATCHES:
            self._queue.put(Batch(samples if len(samples) else None, tuple(events), lost))
            return
        if not self._dropped:
            self._tell("the recorder is too slow: cycles are dropped")
        self._dropped += len(samples)

    def put(self, item: ModelUse | Note) -> None:
        """Records a change of model or a note. They are rare, and never dropped."""
        self._queue.put(item)

    def mark(self, text: str = "") -> None:
        """Records a mark and keeps the time around it, as around a fault."""
        self.put(Note(MARK, text))

    def close(self) -> None:
        """Finishes the file; returns when it is on the disk."""
        self._queue.put(None)
        self._thread.join()
        self._mender.join()

    def _mend(self) -> None:
        try:
            self._flight.mend()
        except Exception:
            _log.exception("unfinished recordings could not be mended")

    def _run(self) -> None:
        flight = self._flight
        due_s = time.monotonic() + FLUSH_S
        told = 0
        going = True
        while going:
            with suppress(queue.Empty):
                item = self._queue.get(timeout=max(due_s - time.monotonic(), 0.01))
                if item is None:
                    going = False
                else:
                    flight.put(item)
            if self._dropped != told:
                flight.put(
                    Note("DROPPED", f"{self._dropped - told} cycles were dropped: the recorder was too slow")
                )
                told = self._dropped
            if time.monotonic() < due_s and going:
                continue
            due_s = time.monotonic() + FLUSH_S
            try:
                flight.flush() if going else flight.close()
            except Exception:
                _log.exception("the recorder failed; it goes on")
