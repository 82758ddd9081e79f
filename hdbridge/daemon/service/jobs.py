"""Jobs: procedures that run through the daemon while it holds the bus. At most one per axis.

A job has exclusive use of its axis: other motion is refused until it ends, but any client may stop it. It
continues when the lease under which it began expires. Afterwards the axis is disabled, and compensated as
before.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hdbridge.client import messages
from hdbridge.client.messages import JobKind, JobState
from hdbridge.daemon.service.activity import Activity, Kind
from hdbridge.daemon.service.joborder import Told, Work, options_of
from hdbridge.daemon.service.jobpipe import Begin, Served
from hdbridge.daemon.service.jobprocess import job_process
from hdbridge.daemon.service.rigs import DaemonRig
from hdbridge.errors import HdbridgeError, InputError

if TYPE_CHECKING:
    from hdbridge.daemon.service.axis import ServiceAxis
    from hdbridge.daemon.service.core import Core

JOBS_KEPT: Final = 100
_log = logging.getLogger(__name__)

Runner = Callable[[Work, DaemonRig, Told], dict[str, Any]]
"""Function that runs a job; it blocks."""


def in_own_process(work: Work, rig: DaemonRig, told: Told) -> dict[str, Any]:
    """Runs a job in its own process at low priority."""
    with job_process(Begin(work, rig.identity)) as process:
        return Served(process.connection, rig, told, process.ended, process.interrupt).until_done()


class _Running:
    """A job and its state; the worker thread writes, the event loop reads."""

    def __init__(self, job: messages.Job, axis: ServiceAxis, activity: Activity) -> None:
        self.job = job
        self.axis = axis
        self.activity = activity
        self.cancelled = threading.Event()

    def update(self, **changes: Any) -> None:
        """Changes fields of the job's message."""
        self.job = self.job.model_copy(update=changes)

    def phase(self, name: str, done_s: float, total_s: float) -> None:
        """Updates the progress; the share never decreases."""
        share = min(max(done_s / total_s, 0.0), 1.0) if total_s > 0.0 else 0.0
        self.update(text=name, share=max(share, self.job.share))


class JobBook:
    """The jobs of all axes."""

    def __init__(
        self,
        core: Core,
        recordings: Callable[[ServiceAxis], Path],
        runner: Runner = in_own_process,
    ) -> None:
        """``recordings`` returns the folder for an axis's recordings."""
        self._core = core
        self._recordings = recordings
        self._runner = runner
        self._jobs: dict[str, _Running] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._numbers = itertools.count(1)

    def all(self) -> list[messages.Job]:
        """Returns the running jobs and the last finished ones, newest last."""
        return [each.job for each in self._jobs.values()]

    def of_axis(self, name: str) -> messages.Job | None:
        """Returns the job that runs on an axis, or None."""
        running = (each.job for each in self._jobs.values() if each.job.axis == name)
        return next((each for each in running if each.state is JobState.RUNNING), None)

    def begin(self, axis: ServiceAxis, holder: str, kind: JobKind, given: Mapping[str, Any]) -> messages.Job:
        """Begins a job, which runs when this returns. Raises InputError for invalid options."""
        options = options_of(kind, given)
        axis.check_free()
        now = datetime.now(UTC)
        work = Work(
            kind, options, axis.axis.profile, axis.axis.config, self._recordings(axis), now.astimezone()
        )
        job = messages.Job(
            id=f"{kind.value}-{next(self._numbers)}",
            kind=kind,
            axis=axis.name,
            client=client.client if (client := self._core.lease.holder) is not None else "",
            state=JobState.RUNNING,
            started=now,
        )
        running = _Running(job, axis, Activity(Kind.JOB, holder))
        axis.occupy(running.activity)
        self._jobs[job.id] = running
        while len(self._jobs) > JOBS_KEPT:
            oldest = next((key for key, each in self._jobs.items() if each.activity.over), None)
            if oldest is None:
                break
            del self._jobs[oldest]
        self._core.log.note(f"job {job.id} has begun", axis.link.index)
        task = asyncio.get_running_loop().create_task(self._run(running, work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return job

    def cancel(self, job_id: str) -> None:
        """Cancels a job: its axis brakes to rest, its measurements are kept. InputError for an unknown id."""
        running = self._jobs.get(job_id)
        if running is None:
            raise InputError(
                f"there is no job '{job_id}'; expected one of: {', '.join(self._jobs) or 'none yet'}"
            )
        running.cancelled.set()

    async def close(self) -> None:
        """Cancels all running jobs and waits for their end."""
        for each in self._jobs.values():
            each.cancelled.set()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _run(self, running: _Running, work: Work) -> None:
        told = Told(
            phase=running.phase,
            line=lambda text: running.update(text=text),
            folder=lambda path: running.update(folder=str(path)),
            interrupted=running.cancelled.is_set,
        )
        state, problem, document = JobState.DONE, None, None
        try:
            rig = DaemonRig(running.axis, running.activity)
            document = await self._core.timing.work(_uninterrupted, self._runner, work, rig, told)
            if document is None:
                state = JobState.CANCELLED
        except HdbridgeError as error:
            state = JobState.CANCELLED if running.cancelled.is_set() else JobState.FAILED
            problem = messages.Problem.of(error, running.axis.name)
        except Exception as error:
            _log.exception("job failed", extra={"job": running.job.id})
            state = JobState.FAILED
            problem = messages.Problem.of(
                HdbridgeError(f"an error in hdbridge: {error!r}"), running.axis.name
            )
        running.activity.end(f"job {running.job.id} is {state.value}")
        await running.axis.vacate()
        running.update(
            state=state,
            problem=problem,
            result=document,
            ended=datetime.now(UTC),
            share=1.0 if state is JobState.DONE else running.job.share,
        )
        why = f": {problem.detail}" if problem is not None else ""
        self._core.log.note(f"job {running.job.id} is {state.value}{why}", running.axis.link.index)


def _uninterrupted(runner: Runner, work: Work, rig: DaemonRig, told: Told) -> dict[str, Any] | None:
    """Runs a job; returns its document, or None if it was interrupted."""
    try:
        return runner(work, rig, told)
    except KeyboardInterrupt:
        return None
