"""Runs a plan on a bench, without compensation, into a journal."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from hdbridge.axis import AxisConfig, Identity
from hdbridge.commissioning.calibration.journal import Journal
from hdbridge.control.bench import Bench, axis_view, lost_channels
from hdbridge.control.rig import Rig, bench_on
from hdbridge.drive.drive import Drive
from hdbridge.errors import HdbridgeError, InputError, OutputError
from hdbridge.files.atomic import make_folder
from hdbridge.motion.procedures.plan import Plan, Task
from hdbridge.motion.procedures.rehearsal import rehearse

REPORT_CYCLES = 50
"""Number of cycles between two reports of progress."""


class Pace:
    """Progress of a measurement in control cycles; a bench calls `interrupted` once per cycle."""

    def __init__(
        self,
        total_s: float,
        period_s: float,
        notify: Callable[[str, float, float], None],
        interrupted: Callable[[], bool],
    ) -> None:
        """``notify`` receives the task's name, and the completed and total seconds."""
        self.name = ""
        self.total_s = total_s
        self._done_s = 0.0
        self._period_s = period_s
        self._notify = notify
        self._interrupted = interrupted
        self._cycles = 0

    def begin(self, name: str) -> None:
        """Starts a task."""
        self.name = name
        self._say()

    def interrupted(self) -> bool:
        """Counts a cycle and reports progress; returns the caller's ``interrupted()``."""
        self._cycles += 1
        if self._cycles >= REPORT_CYCLES:
            self._say()
        return self._interrupted()

    def _say(self) -> None:
        self._done_s += self._cycles * self._period_s
        self._cycles = 0
        self._notify(self.name, min(self._done_s, self.total_s), self.total_s)


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
    middle = 0.5 * (axis.limits.position_min_deg + axis.limits.position_max_deg)
    return RemainingPlan(
        left, sum(rehearse(each.procedure, view, middle).duration_s for each in left), fitted.notes
    )


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
    shortened = remaining_plan(plan, axis).notes
    return Journal.create(
        folder,
        axis,
        plan,
        date,
        identity,
        {**(notes or {}), **({"shortened": list(shortened)} if shortened else {})},
    )


def measure(
    drive: Drive | Rig,
    journal: Journal,
    *,
    progress: Callable[[str, float, float], None] = lambda *_: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> None:
    """Runs the remaining tasks of the journal's plan on a booted drive.

    ``progress`` receives the task's name, and the completed and total seconds. If a task is stopped
    (KeyboardInterrupt, `SafetyStop`, `DriveError`, `BusError`), its samples are kept before the error is
    raised.
    """
    journal.check_is_of(drive.axis, drive.identity)
    left = remaining_plan(journal.plan, drive.axis, journal.done)
    if not left.tasks:
        return
    make_folder(journal.folder)  # fails on an unwritable disk before the axis moves
    pace = Pace(left.duration_s, drive.axis.drive.cycle_s, progress, interrupted)
    bench = bench_on(drive, interrupted=pace.interrupted)
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
