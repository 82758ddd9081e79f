"""Pipe between the service and a job's process: the job requests runs on the axis, the service executes them.

    job's process -> service      Ask (a run), Stop, Phase, Line, Folder, Result, Failure
    service -> job's process      Cycles, Share, Done

Messages are pickled: both ends are hdbridge on the same computer, and no other process has the pipe.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import Run
from hdbridge.control.compensation import Compensation
from hdbridge.control.rig import Rig
from hdbridge.control.survived import Survived
from hdbridge.daemon.service.joborder import Told, Work
from hdbridge.errors import DaemonError
from hdbridge.motion.procedures.moves import Procedure
from hdbridge.records.record import REQUIRED, Record
from hdbridge.records.recording import Segment

Outcome = TypeVar("Outcome")
CYCLES_TOLD: Final = 25
"""Cycles between two reports of a run's progress."""
POLL_S: Final = 0.1


@dataclass(frozen=True)
class Begin:
    """First message: the job and the identity of the drive."""

    work: Work
    identity: Identity


class Ask(NamedTuple):
    """Request to run a procedure."""

    compensation: Compensation | None
    procedure: Procedure[Any]


class Stop(NamedTuple):
    """Request to end the present run, because the job was interrupted."""


class Phase(NamedTuple):
    """Progress of the job's present phase."""

    name: str
    done_s: float
    total_s: float


class Line(NamedTuple):
    """Status line of the job."""

    text: str


class Folder(NamedTuple):
    """Folder of the measurements."""

    path: Path


class Result(NamedTuple):
    """Result of a completed job."""

    document: dict[str, Any]


class Failure(NamedTuple):
    """Error of a job that failed or was interrupted."""

    error: BaseException


class Cycles(NamedTuple):
    """Number of further cycles that the present run has executed."""

    cycles: int


class Share(NamedTuple):
    """Share of the present run that is done."""

    share: float


class Done(NamedTuple):
    """End of a run: its result, or the error that ended it, and the measurements."""

    run: Run[Any] | None
    error: BaseException | None
    record: Record
    legs: tuple[Segment, ...]
    survived: tuple[Survived, ...]


# ---------------------------------------------------------------- the service's end


class Served:
    """Serves a job's process, from a worker thread of the service."""

    def __init__(
        self,
        connection: Connection,
        rig: Rig,
        told: Told,
        alive: Callable[[], str],
        interrupt: Callable[[], None],
    ) -> None:
        """``alive`` returns how the process has ended, or an empty string; ``interrupt`` interrupts it."""
        self._connection = connection
        self._rig = rig
        self._told = told
        self._alive = alive
        self._interrupt = interrupt
        self._interrupted = False

    def until_done(self) -> dict[str, Any]:
        """Serves the process to its end and returns the job's document.

        Raises the job's error, or DaemonError if the process died.
        """
        connection = self._connection
        while True:
            try:
                if not connection.poll(POLL_S):
                    self._look()
                    continue
                message = connection.recv()
            except (EOFError, OSError):
                raise DaemonError(
                    f"the job's process has ended by itself{self._alive()}; what it had measured is kept"
                ) from None
            match message:
                case Ask():
                    self._run(message)
                case Result():
                    return message.document
                case Failure():
                    raise message.error
                case _:
                    self._hear(message)

    def _hear(self, message: Phase | Line | Folder | Stop) -> bool:
        """Handles a message from the job during a run; returns True if the run is to end."""
        match message:
            case Phase():
                self._told.phase(*message)
            case Line():
                self._told.line(message.text)
            case Folder():
                self._told.folder(message.path)
        return isinstance(message, Stop)

    def _look(self) -> None:
        """Interrupts the process if the job was cancelled between two runs."""
        if self._told.interrupted() and not self._interrupted:
            self._interrupted = True
            self._interrupt()

    def _run(self, ask: Ask) -> None:
        connection = self._connection
        asked = 0

        def interrupted() -> bool:
            nonlocal asked
            asked += 1
            if asked >= CYCLES_TOLD:
                connection.send(Cycles(asked))
                asked = 0
                while connection.poll(0.0):
                    if self._hear(connection.recv()):
                        return True
            return self._told.interrupted()

        bench = self._rig.bench(ask.compensation, interrupted=interrupted)
        run: Run[Any] | None = None
        error: BaseException | None = None
        try:
            run = bench.run(ask.procedure, lambda share: connection.send(Share(share)))
        except (Exception, KeyboardInterrupt) as problem:
            error = problem
        connection.send(Done(run, error, bench.record(), bench.legs, bench.survived))


# ---------------------------------------------------------------- the job's end


class PipedBench:
    """A `Bench` whose runs are executed by the service."""

    def __init__(
        self, connection: Connection, compensation: Compensation | None, interrupted: Callable[[], bool]
    ) -> None:
        self._connection = connection
        self._compensation = compensation
        self._interrupted = interrupted
        self._done: Done | None = None

    @property
    def legs(self) -> tuple[Segment, ...]:
        """Moves of the last procedure."""
        return self._done.legs if self._done is not None else ()

    @property
    def survived(self) -> tuple[Survived, ...]:
        """Faults that the last procedure tolerated."""
        return self._done.survived if self._done is not None else ()

    def record(self) -> Record:
        """Returns the record of the last procedure; empty before the first."""
        return self._done.record if self._done is not None else Record(dict.fromkeys(REQUIRED, np.empty(0)))

    def run(
        self, procedure: Procedure[Outcome], progress: Callable[[float], None] = lambda _: None, /
    ) -> Run[Outcome]:
        """Runs one procedure to its end; raises as `Bench.run` does."""
        connection = self._connection
        connection.send(Ask(self._compensation, procedure))
        stopped = False
        while True:
            match connection.recv():
                case Cycles(cycles):
                    if sum(self._interrupted() for _ in range(cycles)) and not stopped:
                        stopped = True
                        connection.send(Stop())
                case Share(share):
                    progress(share)
                case Done() as done:
                    self._done = done
                    if done.error is not None:
                        raise done.error
                    assert done.run is not None
                    return done.run


class PipedRig:
    """`hdbridge.control.rig.Rig` in the job's process."""

    def __init__(self, connection: Connection, axis: AxisConfig, identity: Identity) -> None:
        self._connection = connection
        self.axis = axis
        self.identity = identity

    def bench(
        self, compensation: Compensation | None = None, *, interrupted: Callable[[], bool] = lambda: False
    ) -> PipedBench:
        """Returns a bench on the service's axis."""
        return PipedBench(self._connection, compensation, interrupted)


def told_over(connection: Connection, interrupted: Callable[[], bool]) -> Told:
    """Returns a `Told` that reports to the service."""
    return Told(
        phase=lambda name, done_s, total_s: connection.send(Phase(name, done_s, total_s)),
        line=lambda text: connection.send(Line(text)),
        folder=lambda path: connection.send(Folder(path)),
        interrupted=interrupted,
    )


@contextlib.contextmanager
def telling_failure(connection: Connection) -> Iterator[None]:
    """Reports an error within the block to the service."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        with contextlib.suppress(OSError):
            connection.send(Failure(error))
