"""The pipe between the service and a job's process: the job asks for runs on the axis, the service runs them.

    job's process -> service      Ask (a run), Stop, Phase, Line, Folder, Result, Failure
    service -> job's process      Cycles, Share, Done

What travels is pickled: both ends are hdbridge, on one machine, and nobody else has the pipe.
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
from hdbridge.procedures.moves import Procedure
from hdbridge.records.record import REQUIRED, Record
from hdbridge.records.recording import Segment

Outcome = TypeVar("Outcome")
CYCLES_TOLD: Final = 25
"""Cycles between two words on how far a run is."""
POLL_S: Final = 0.1


@dataclass(frozen=True)
class Begin:
    """The first message: the job, and the drive that answers."""

    work: Work
    identity: Identity


class Ask(NamedTuple):
    """Run this procedure."""

    compensation: Compensation | None
    procedure: Procedure[Any]


class Stop(NamedTuple):
    """End the present run: the job was interrupted."""


class Phase(NamedTuple):
    """How far the job is."""

    name: str
    done_s: float
    total_s: float


class Line(NamedTuple):
    """What the job is at."""

    text: str


class Folder(NamedTuple):
    """Where what is measured goes."""

    path: Path


class Result(NamedTuple):
    """The job is done."""

    document: dict[str, Any]


class Failure(NamedTuple):
    """The job has failed, or was interrupted."""

    error: BaseException


class Cycles(NamedTuple):
    """So many cycles more of the present run."""

    cycles: int


class Share(NamedTuple):
    """So much of the present run is done."""

    share: float


class Done(NamedTuple):
    """The run is over: what it gave, or why it did not come to its end; and what was measured."""

    run: Run[Any] | None
    error: BaseException | None
    record: Record
    legs: tuple[Segment, ...]
    survived: tuple[Survived, ...]


# ---------------------------------------------------------------- the service's end


class Served:
    """Serves a job's process from a worker thread of the service."""

    def __init__(
        self,
        connection: Connection,
        rig: Rig,
        told: Told,
        alive: Callable[[], str],
        interrupt: Callable[[], None],
    ) -> None:
        """``alive`` says how the process has ended, in words, or nothing; ``interrupt`` interrupts it."""
        self._connection = connection
        self._rig = rig
        self._told = told
        self._alive = alive
        self._interrupt = interrupt
        self._interrupted = False

    def until_done(self) -> dict[str, Any]:
        """Serve it to its end; the job's document. Raises what the job raises, DaemonError where it died."""
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
        """What a job says meanwhile; whether it wants the present run to end."""
        match message:
            case Phase():
                self._told.phase(*message)
            case Line():
                self._told.line(message.text)
            case Folder():
                self._told.folder(message.path)
        return isinstance(message, Stop)

    def _look(self) -> None:
        """Between two runs: interrupt the process where the job was cancelled while it computes."""
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
    """As `Bench`: asks the service for its runs."""

    def __init__(
        self, connection: Connection, compensation: Compensation | None, interrupted: Callable[[], bool]
    ) -> None:
        self._connection = connection
        self._compensation = compensation
        self._interrupted = interrupted
        self._done: Done | None = None

    @property
    def legs(self) -> tuple[Segment, ...]:
        """The moves that the last procedure has run."""
        return self._done.legs if self._done is not None else ()

    @property
    def survived(self) -> tuple[Survived, ...]:
        """What it has gone on in spite of."""
        return self._done.survived if self._done is not None else ()

    def record(self) -> Record:
        """What it has measured."""
        return self._done.record if self._done is not None else Record(dict.fromkeys(REQUIRED, np.empty(0)))

    def run(
        self, procedure: Procedure[Outcome], progress: Callable[[float], None] = lambda _: None, /
    ) -> Run[Outcome]:
        """Run one procedure to its end; raises as `Bench.run` does."""
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
    """`hdbridge.control.rig.Rig` at the job's end."""

    def __init__(self, connection: Connection, axis: AxisConfig, identity: Identity) -> None:
        self._connection = connection
        self.axis = axis
        self.identity = identity

    def bench(
        self, compensation: Compensation | None = None, *, interrupted: Callable[[], bool] = lambda: False
    ) -> PipedBench:
        """A bench on the service's axis."""
        return PipedBench(self._connection, compensation, interrupted)


def told_over(connection: Connection, interrupted: Callable[[], bool]) -> Told:
    """`Told` that tells the service."""
    return Told(
        phase=lambda name, done_s, total_s: connection.send(Phase(name, done_s, total_s)),
        line=lambda text: connection.send(Line(text)),
        folder=lambda path: connection.send(Folder(path)),
        interrupted=interrupted,
    )


@contextlib.contextmanager
def telling_failure(connection: Connection) -> Iterator[None]:
    """Tell the service of what goes wrong within."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        with contextlib.suppress(OSError):
            connection.send(Failure(error))
