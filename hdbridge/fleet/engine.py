"""Run over a fleet: one Dask task per recording, on a local or an existing cluster.

Dask schedules the tasks, restarts workers and repeats the tasks of a dead worker. A recording that repeatedly
kills its worker is diagnosed once more at the end, alone. If this fails too, its row reports it.
"""

from __future__ import annotations

import signal
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from hdbridge import __version__
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, write_atomically
from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.diagnosing import NO_MEMORY, Model, Row, axes_of, diagnosed, fitted, local_model, lost
from hdbridge.fleet.sources import Source, Stored, with_axes

if TYPE_CHECKING:
    from distributed import Client

INCREMENT_S: Final = 1.0
"""Minimum time between two increments; `kill -9` loses at most the recordings finished in this time."""
POLL_S: Final = 0.25
AHEAD: Final = 2000
"""Maximum number of unfinished tasks submitted to the scheduler."""
KILLED: Final = (
    "it kills its worker each time, most likely for memory; raise --memory, or shorten the recording"
)
RETRIED: Final = (KILLED, NO_MEMORY)
"""Reasons for diagnosing an unchanged recording again, because --memory may have changed."""


@dataclass(frozen=True)
class Progress:
    """Progress of a run, in numbers of recordings."""

    done: int
    total: int
    failed: int
    known: int
    memory_mb: float
    """Maximum memory use of a worker so far, MB."""


@dataclass(frozen=True)
class Cluster:
    """Dask cluster of a run."""

    scheduler: str | None = None
    """Address of an existing scheduler; None starts a local cluster."""
    workers: int | None = None
    memory: str = "2GB"
    """Memory limit of each worker of a local cluster."""

    @contextmanager
    def client(self) -> Iterator[Client]:
        """Provides a connected client. InputError if the scheduler is unreachable or Dask is missing."""
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise InputError("a fleet needs Dask: python -m pip install 'hdbridge[fleet]'") from None
        if self.scheduler is not None:
            try:
                client = Client(self.scheduler, set_as_default=False)
            except (OSError, ValueError) as problem:
                raise InputError(f"--scheduler {self.scheduler}: cannot be reached: {problem}") from None
            with client:
                yield client
            return
        # Threads and processes inherit the mask, so that Ctrl-C reaches only this process, not the workers.
        # Starting the resource tracker would reset the mask, so it is started before.
        ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            local = LocalCluster(
                n_workers=self.workers,
                threads_per_worker=1,
                memory_limit=self.memory,
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with local, Client(local, set_as_default=False) as client:
            yield client


def run(
    sources: Sequence[Source],
    dataset: Dataset,
    cluster: Cluster,
    *,
    model: Path | None = None,
    models: Path | None = None,
    progress: Callable[[Progress], None] = lambda _: None,
    interrupted: Callable[[], bool] = lambda: False,
    retried: Collection[str] = RETRIED,
) -> Progress:
    """Diagnoses the recordings that are not in the data set yet, and adds them.

    A recording with unchanged files, manifest row and model is not read. A recording that failed for a reason
    in ``retried`` is tried again.

    ``model`` is the model of every joint, ``models`` a folder of JOINT.yaml; a joint without one gets a model
    fitted to its earliest usable recording, kept in OUT/models. Raises KeyboardInterrupt when interrupted;
    the rows completed by then are kept.
    """
    with dataset.locked(), ExitStack() as stack:
        clients = cache(lambda: stack.enter_context(cluster.client()))
        return _Run(clients, dataset, progress, interrupted, retried).of(sources, model, models)


def watch(
    find: Callable[[Stored], Sequence[Source]],
    dataset: Dataset,
    interval_s: float,
    diagnose: Callable[[Sequence[Source], Collection[str]], None],
    *,
    once: bool = False,
    report: Callable[[str], None] = lambda _: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> None:
    """Passes sources and ``retried`` to ``diagnose`` whenever some are new, until interrupted, or ``once``.

    A recording is ready once two listings, ``interval_s`` apart, agree on it, so a recording that is still
    being written waits for a later round. The first call receives all ready recordings, because models may
    have changed. An error of a later listing is reported, and the next round tries again.
    """
    before: dict[tuple[str, str | None], str | None] | None = None
    done = False
    while not interrupted():
        stored = dataset.stored()
        try:
            found = find(stored)
        except InputError as problem:
            if before is None:
                raise
            report(f"{problem}; the next round tries again")
        else:
            if before is None:
                dataset.create()  # refused now, not after an interval
            files: dict[str, list[Source]] = defaultdict(list)
            for each in found:
                files[each.path].append(each)
            new = {path for path, own in files.items() if _is_new(own, stored)}
            if before is not None or not new:
                same = before or {}
                wait = {
                    each.path for each in found if each.path in new and same.get(_name(each)) != each.stamp
                }
                if not done or new - wait:
                    diagnose([each for each in found if each.path not in wait], () if done else RETRIED)
                    done = True
                if once:
                    return
            before = {_name(each): each.stamp for each in found}
        until_s = time.monotonic() + interval_s
        while time.monotonic() < until_s and not interrupted():
            time.sleep(min(POLL_S, interval_s))


def _name(source: Source) -> tuple[str, str | None]:
    return source.path, source.axis


def _is_new(file: Sequence[Source], stored: Stored) -> bool:
    """Returns True for a file that must be read; False for a file that was already missing."""
    if any(each.stamp is None for each in file):
        return any(stored.row(each) is None for each in file)
    return not stored.unchanged(file)


@dataclass
class _Run:
    clients: Callable[[], Client]
    """Function that returns the cluster's client; its first call starts the cluster."""
    dataset: Dataset
    progress: Callable[[Progress], None]
    interrupted: Callable[[], bool]
    retried: Collection[str]

    def __post_init__(self) -> None:
        self._stored = self.dataset.stored()
        self._renewed: dict[tuple[str, str], Row] = {}
        self._rows: list[Row] = []
        self._present: list[tuple[str, str]] = []
        self._written_s = time.monotonic()
        self._failed = self._known = self._total = 0
        self._memory = 0.0

    def of(self, sources: Sequence[Source], model: Path | None, models: Path | None) -> Progress:
        """Performs the run. However it ends, the completed rows are kept."""
        try:
            sources = self._split_flights(sources)
            self._total = len(sources) + len(self._present)
            rows = [self._unchanged(each) for each in sources]
            given = self._models(sources, rows, model, models)
            tasks = []
            for source, row in zip(sources, rows, strict=True):
                own = given[source.joint or ""]
                if row is not None and row["model_sha256"] == own.sha256:
                    self._known += 1
                    self._present.append((row["key"], row["path"]))
                else:
                    stored = self._stored.row(source)
                    tasks.append((diagnosed, (source, own, stored["key"] if stored else "")))
            again = []
            for place, row in self._results(tasks):
                if row is None:
                    again.append(tasks[place])
                else:
                    self._take(row)
            for task in again:  # one at a time, to identify the recording that kills its worker
                for _, row in self._results([task]):
                    self._take(row if row is not None else lost(task[1][0], KILLED))
        finally:
            self._write()
            self.dataset.renew(self._renewed)
            self.dataset.compact(self._present)
        return self._report()

    def _unchanged(self, source: Source) -> Mapping[str, Any] | None:
        """Returns the stored row if the recording is unchanged, else None; the model may still differ."""
        row = self._stored.row(source)
        if row is None or source.stamp is None or row["reason"] in self.retried:
            return None
        return row if row["stamp"] == source.stamp and row["version"] == __version__ else None

    def _split_flights(self, sources: Sequence[Source]) -> list[Source]:
        """Replaces each flight recording by one source for each of its axes."""
        result = [each for each in sources if not each.is_flight]
        flights: dict[str, list[Source]] = defaultdict(list)
        for each in sources:
            if each.is_flight:
                flights[each.path].append(each)
        for path, described in [*flights.items()]:
            rows = self._stored.unchanged(described)
            if rows and not any(row["reason"] in self.retried for row in rows):
                result += with_axes(path, sorted((row["axis"] for row in rows), key=str), described)
                del flights[path]
        paths = list(flights)
        for place, axes in self._results((axes_of, (path,)) for path in paths):
            described = flights[paths[place]]
            if isinstance(axes, list):
                result += with_axes(paths[place], axes, described)
            else:
                self._take(lost(replace(described[0], axes=1), axes or KILLED))
        return sorted(result, key=lambda each: (each.path, each.axis or ""))

    def _models(
        self,
        sources: Sequence[Source],
        rows: Sequence[Mapping[str, Any] | None],
        model: Path | None,
        models: Path | None,
    ) -> dict[str, Model]:
        """Returns the model of each joint; fits the missing ones, unless nothing new could be fitted."""
        joints: dict[str, list[Source]] = defaultdict(list)
        fitting: set[str] = set()
        for each, row in zip(sources, rows, strict=True):
            joints[each.joint or ""].append(each)
            if row is None or row["model_sha256"]:
                fitting.add(each.joint or "")
        folder = self.dataset.folder / "models"
        found: dict[str, Model] = {"": Model(reason="the joint is not known")}
        to_fit = []
        for joint in sorted(filter(None, joints)):
            own = sorted(joints[joint], key=lambda each: each.order)
            said = next((each.model for each in own if each.model), None)
            kept = folder / f"{quote(joint, safe='')}.yaml"
            in_folder = models / f"{quote(joint, safe='')}.yaml" if models else None
            if said:
                found[joint] = local_model(said)
            elif in_folder is not None and in_folder.is_file():
                found[joint] = local_model(str(in_folder))
            elif model is not None:
                found[joint] = local_model(str(model))
            elif kept.is_file():
                found[joint] = replace(local_model(str(kept)), where=f"models/{kept.name}")
            elif joint in fitting:
                to_fit.append((joint, own, kept))
            else:
                found[joint] = Model(reason="no recording for a model")
        total, self._total = self._total, self._total + len(to_fit)
        fits = ((fitted, (own, f"models/{kept.name}")) for _, own, kept in to_fit)
        for place, made in self._results(fits):
            joint, _, kept = to_fit[place]
            found[joint] = made or Model(reason=f"no model could be fitted: {KILLED}")
            if not found[joint].reason:
                make_folder(folder)
                write_atomically(kept, found[joint].text)
        self._total = total
        return found

    def _results(
        self, tasks: Iterable[tuple[Callable[..., Any], tuple[Any, ...]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yields number and result of each task on completion; None for a task that kills its workers."""
        from distributed import KilledWorker, as_completed

        tasks = list(tasks)
        if not tasks:
            return
        client = self.clients()
        numbered = enumerate(tasks)
        numbers: dict[str, int] = {}
        """Numbers of the submitted tasks by the key of their future."""
        done = as_completed([], loop=client.loop)
        seen_s = time.monotonic()
        while True:
            for number, (work, arguments) in islice(numbered, AHEAD - len(numbers)):
                future = client.submit(work, *arguments, pure=False)
                numbers[future.key] = number
                done.add(future)
            if not numbers:
                break
            if self.interrupted():
                raise KeyboardInterrupt
            batch = done.next_batch(block=False)
            for future in batch:
                number = numbers.pop(future.key)
                try:
                    result = future.result()
                except KilledWorker:
                    result = None
                future.release()
                yield number, result
            if time.monotonic() - seen_s > 5.0:
                seen_s = time.monotonic()
                self._measure(client)
            if not batch:
                time.sleep(POLL_S)
        self._measure(client)

    def _measure(self, client: Client) -> None:
        """Updates the maximum memory use of a worker, MB."""
        with suppress(OSError):
            workers: Collection[Mapping[str, Any]] = client.scheduler_info(n_workers=-1)["workers"].values()
            self._memory = max(
                self._memory, *(each["metrics"].get("memory", 0) / 1e6 for each in workers), 0.0
            )

    def _take(self, row: Row) -> None:
        self._present.append((row["key"], row["path"]))
        if "findings" not in row:
            self._known += 1
            self._renewed[row["key"], row["path"]] = row
        else:
            self._failed += bool(row.get("reason"))
            self._rows.append(row)
        if time.monotonic() - self._written_s > INCREMENT_S:
            self._write()
        self._report()

    def _write(self) -> None:
        self.dataset.add(self._rows)
        self._rows.clear()
        self._written_s = time.monotonic()

    def _report(self) -> Progress:
        state = Progress(len(self._present), self._total, self._failed, self._known, self._memory)
        self.progress(state)
        return state
