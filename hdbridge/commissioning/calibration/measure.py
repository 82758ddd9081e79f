"""Runs a plan on a bench, without compensation, into a journal."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from hdbridge.axis import AxisConfig, Identity
from hdbridge.commissioning.calibration.journal import Journal
from hdbridge.control.bench import Bench, axis_view, lost_channels
from hdbridge.drive.drive import Drive
from hdbridge.errors import HdbridgeError, InputError, OutputError
from hdbridge.files.atomic import make_folder
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
    """Progress of a measurement in control cycles; a bench calls `interrupted` once per cycle."""

    def __init__(self, total_s: float, period_s: float, callbacks: Callbacks) -> None:
        self.name = ""
        self.total_s = total_s
        self._done_s = 0.0
        self._period_s = period_s
        self._callbacks = callbacks
        self._cycles = 0

    def begin(self, name: str) -> None:
        """Starts a task."""
        self.name = name
        self._say()

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


def start_journal(
    folder: Path,
    axis: AxisConfig,
    plan: Plan,
    date: datetime,
    identity: Identity,
    notes: dict[str, Any] | None = None,
) -> Journal:
    """Creates a journal, whose notes list the parts of the plan that are shortened for this axis.

    InputError if the axis has no encoder at its load.
    """
    axis.require_load_encoder()
    notes = dict(notes or {})
    if shortened := remaining_plan(plan, axis).notes:
        notes["shortened"] = list(shortened)
    return Journal.create(folder, axis, plan, date, identity, notes)


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
    pace = Pace(left.duration_s, drive.axis.drive.cycle_s, callbacks)
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
