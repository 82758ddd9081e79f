"""Runs a plan on a bench, without compensation, into a journal."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.journal import Journal
from hdbridge.control.bench import Bench, Run, axis_view, lost_channels
from hdbridge.control.compensation import Compensation
from hdbridge.drive.drive import Drive
from hdbridge.errors import HdbridgeError, InputError, OutputError
from hdbridge.files.atomic import make_folder
from hdbridge.files.outputs import writing
from hdbridge.motion.procedures.moves import Outcome, Procedure
from hdbridge.motion.procedures.plan import Plan, Task
from hdbridge.motion.procedures.rehearsal import total_duration_s

REPORT_CYCLES = 50
"""Number of cycles between two reports of progress."""


@dataclass(frozen=True, slots=True)
class Callbacks:
    """Functions that a measurement calls."""

    progress: Callable[[str, float, float], None] = lambda *_: None
    """Receives the name of the current task, and the completed and total seconds."""
    interrupted: Callable[[], bool] = lambda: False
    """Called in each control cycle; the axis is stopped if it returns True."""
    notify: Callable[[str], None] = lambda _: None
    """Receives a line for each step of a workflow."""


SILENT: Final = Callbacks()


class Pace:
    """Progress of a measurement of ``total_s`` on a drive; a bench calls `interrupted` once per cycle."""

    def __init__(self, drive: Drive, total_s: float, callbacks: Callbacks) -> None:
        self.name = ""
        self.total_s = total_s
        self._drive = drive
        self._done_s = 0.0
        self._period_s = drive.axis.drive.cycle_s
        self._callbacks = callbacks
        self._cycles = 0

    def begin(self, name: str) -> None:
        """Starts a task."""
        self.name = name
        self._say()

    def run(
        self,
        name: str,
        procedure: Procedure[Outcome],
        compensation: Compensation | TransmissionModel,
        path: Path | None = None,
    ) -> Run[Outcome]:
        """Runs a procedure with a compensation; writes its samples to ``path``, even if it is stopped."""
        self.begin(name)
        bench = Bench(self._drive, compensation, interrupted=self.interrupted)
        try:
            return bench.run(procedure)
        finally:
            if path is not None and len(record := bench.record()):
                with writing():
                    record.write_csv(path)

    def interrupted(self) -> bool:
        """Counts a cycle and reports progress; returns True if the axis must stop."""
        self._cycles += 1
        if self._cycles >= REPORT_CYCLES:
            self._say()
        return self._callbacks.interrupted()

    def _say(self) -> None:
        self._done_s += self._cycles * self._period_s
        self._cycles = 0
        self._callbacks.progress(self.name, min(self._done_s, self.total_s), self.total_s)


@dataclass(frozen=True, slots=True)
class RemainingPlan:
    """Remaining tasks of a plan."""

    tasks: tuple[Task, ...]
    duration_s: float
    """Duration of the tasks on an ideal axis, s."""
    notes: tuple[str, ...]


def remaining_plan(plan: Plan, axis: AxisConfig, done: Sequence[str] | frozenset[str] = ()) -> RemainingPlan:
    """Returns the remaining tasks of a plan on an axis; InputError if they would leave its limits."""
    view = axis_view(axis)
    fitted = plan.tasks(view)
    left = tuple(each for each in fitted.tasks if each.name not in set(done))
    return RemainingPlan(left, total_duration_s((each.procedure for each in left), view), fitted.notes)


def measure(drive: Drive, journal: Journal, callbacks: Callbacks = SILENT) -> None:
    """Runs the remaining tasks of the journal's plan on a booted drive.

    If a task is stopped (KeyboardInterrupt, `SafetyStop`, `DriveError`, `BusError`), its samples are kept
    before the error is raised.
    """
    journal.check_is_of(drive.axis, drive.identity)
    left = remaining_plan(journal.plan, drive.axis, journal.done)
    if not left.tasks:
        return
    make_folder(journal.folder)  # fails on an unwritable disk before the axis moves
    pace = Pace(drive, left.duration_s, callbacks)
    bench = Bench(drive, interrupted=pace.interrupted)
    journal.begin_session()
    for task in left.tasks:
        pace.begin(task.name)
        try:
            bench.run(task.procedure)
        except InputError:
            raise  # refused before anything moved
        except (HdbridgeError, KeyboardInterrupt):
            with suppress(OSError, OutputError):
                _add(journal, drive.axis, task, bench, complete=False)
            raise
        _add(journal, drive.axis, task, bench, complete=True)


def _add(journal: Journal, axis: AxisConfig, task: Task, bench: Bench, *, complete: bool) -> None:
    record = bench.record()
    lost = lost_channels(axis, record)
    journal.add(task.name, record, bench.legs, complete=complete, lost=lost, survived=bench.fault_counts)
