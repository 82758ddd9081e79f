"""Watches of a machine's axes: a sink of the observer with a thread that evaluates samples."""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.watch.autodiagnosis import AutoDiagnosis
from hdbridge.daemon.watch.watch import Raised, Verdict, Watch, WatchSettings
from hdbridge.model import TransmissionModel

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.recorder.recorder import FlightRecorder

QUEUE_BATCHES: Final = 500
"""Capacity of the queue: ten seconds of batches."""
BAD: Final = frozenset({Verdict.RECALIBRATE, Verdict.SOMETHING_CHANGED})
"""Verdicts that start a diagnosis."""
_log = logging.getLogger(__name__)


class _Batch(NamedTuple):
    samples: SampleArray
    lost: int


class _Use(NamedTuple):
    place: int
    model: TransmissionModel


class WatchSink:
    """Sink of the observer. It never blocks; samples are lost if its thread is too slow."""

    def __init__(
        self,
        watches: Sequence[Watch],
        tell: Callable[[Raised], None],
        *,
        diagnose: Callable[[Raised, TransmissionModel], object] = lambda *_: None,
        ending: Callable[[], None] = lambda: None,
    ) -> None:
        """``watches`` are in the order of the axes in a sample; `close` calls ``ending``.

        ``tell``, and ``diagnose`` for a verdict in `BAD`, are called in the watch's thread.
        """
        self._watches = tuple(watches)
        self._tell = tell
        self._diagnose = diagnose
        self._ending = ending
        self._queue: queue.Queue[_Batch | None] = queue.Queue(QUEUE_BATCHES)
        self._uses: deque[_Use] = deque()
        self._missed = 0
        self._words: dict[str, str] = {}
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    @classmethod
    def of(cls, machine: Machine, tell: Callable[[str, int], None], recorder: FlightRecorder | None) -> Self:
        """Creates the watches of a machine's axes; ``tell`` gets text and axis index, in another thread.

        With a recorder, every verdict is recorded and a bad one is diagnosed from its recordings.
        """
        places = {each.name: place for place, each in enumerate(machine.axes)}
        settings = WatchSettings()

        def say(kind: str, axis: str, words: str) -> None:
            if recorder is not None:
                recorder.note(kind, f"{axis}: {words}")
            tell(words, places[axis])

        diagnosis = (
            AutoDiagnosis(recorder.folder, lambda axis, words: say("DIAGNOSIS", axis, words))
            if recorder is not None
            else None
        )

        def diagnose(raised: Raised, model: TransmissionModel) -> None:
            if diagnosis is not None:
                diagnosis.ask(raised.axis, model.dump(), settings.window_s / 60.0, raised.words)

        watches = [
            Watch(each.config, each.model(), place, settings) for place, each in enumerate(machine.axes)
        ]
        return cls(
            watches,
            lambda raised: say("WATCH", raised.axis, raised.words),
            diagnose=diagnose,
            ending=diagnosis.close if diagnosis is not None else lambda: None,
        )

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples from the observer."""
        try:
            self._queue.put_nowait(_Batch(samples, lost + self._missed))
            self._missed = 0
        except queue.Full:
            self._missed += len(samples) + lost

    def use(self, place: int, model: TransmissionModel) -> None:
        """Uses another model for the axis at ``place`` from now on."""
        self._uses.append(_Use(place, model))

    def advice(self, axis: str) -> list[str]:
        """Returns the advice for an axis; empty while its model is valid."""
        words = self._words.get(axis)
        return [words] if words else []

    def close(self) -> None:
        """Ends the thread after it has taken the waiting samples, and a running diagnosis."""
        self._queue.put(None)
        self._thread.join()
        self._ending()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            try:
                while self._uses:
                    self._use(self._uses.popleft())
                self._do(item)
            except Exception:
                _log.exception("the watch failed; it goes on")

    def _use(self, item: _Use) -> None:
        watch = self._watches[item.place]
        watch.use(item.model)
        self._words.pop(watch.axis, None)

    def _do(self, item: _Batch) -> None:
        for watch in self._watches:
            if item.lost:
                watch.lost()
            for raised in watch.take(item.samples):
                self._words[raised.axis] = "" if raised.verdict is Verdict.HOLDS else raised.words
                self._tell(raised)
                if raised.verdict in BAD:
                    self._diagnose(raised, watch.model)
