"""Shared parts of the commands that measure by a plan: options, the measurement, progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from hdbridge.cli.options import note, progress_bar
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, new_folder

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.cli.session import Session
    from hdbridge.commissioning.calibration import Journal
    from hdbridge.drive.drive import Drive
    from hdbridge.motion.procedures.plan import Plan

PlanOption = Annotated[
    str,
    typer.Option("--plan", metavar="quick|full|FILE", help="Bundled plan or plan file."),
]


def out_option(help_: str) -> Any:
    """Returns the option `--out`, the folder of a new recording."""
    return typer.Option("--out", metavar="FOLDER", help=f"{help_}; else recordings/AXIS-DATE-TIME.")


def resume_option(help_: str) -> Any:
    """Returns the option `--resume`, the recording to continue."""
    return typer.Option("--resume", metavar="FOLDER", help=help_)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Plan to be measured into a folder, or the rest of one that was begun there."""

    axis: AxisConfig
    plan: Plan
    folder: Path
    date: datetime
    journal: Journal | None
    """Journal of the recording to continue; None for a new one."""

    @classmethod
    def asked(cls, axis: AxisConfig, plan: str, out: Path | None, resume: Path | None) -> Self:
        """Creates the measurement from the options; raises `InputError` if they contradict each other or the
        recording.

        Also creates the folder, so that an unwritable location is refused before a drive is connected.
        """
        from hdbridge.commissioning.calibration import Journal
        from hdbridge.commissioning.calibration.measure import outlook
        from hdbridge.motion.procedures.plan import Plan

        date = datetime.now().astimezone()
        if resume is None:
            loaded = Plan.load(plan)
            outlook(loaded, axis)  # refused before a folder is made
            default = Path("recordings") / f"{axis.name}-{date:%Y%m%d-%H%M%S}"
            return cls(axis, loaded, make_folder(out) if out else new_folder(default), date, None)
        if out is not None:
            raise InputError("--resume continues in its own folder: leave out --out")
        journal = Journal.open(resume)
        journal.check_is_of(axis)
        return cls(axis, journal.plan, resume, date, journal)

    def announce(self, after: str = "") -> None:
        """Prints what is left of the plan and its duration; ``after`` describes what follows."""
        from hdbridge.commissioning.calibration.measure import outlook

        done = self.journal.done if self.journal else ()
        left = outlook(self.plan, self.axis, done)
        for each in left.notes:
            note(f"plan '{self.plan.name}': {each}")
        there = f" ({len(done)} tasks are there already)" if self.journal else ""
        note(
            f"plan '{self.plan.name}': {len(left.tasks)} tasks{there}, {left.duration_s / 60:.1f} min of the "
            f"axis{f', and {after}' if after else ''}"
        )

    def begun(self, drive: Drive, simulated_seed: int | None) -> Journal:
        """Returns the journal to continue, else a new one for this booted drive."""
        from hdbridge.commissioning.calibration import start_journal

        if self.journal is not None:
            return self.journal
        about = {} if simulated_seed is None else {"simulated": True, "seed": simulated_seed}
        return start_journal(self.folder, self.axis, self.plan, self.date, drive.identity, about)

    @contextmanager
    def booted(self, session: Session) -> Iterator[tuple[Drive, Callable[[], bool]]]:
        """Yields the booted drive, and locks the axis against other measurements."""
        from hdbridge.axis.model.store import measuring

        with _kept_in(self.folder), measuring(session.files.axis), session.booted() as ready:
            yield ready


@contextmanager
def _kept_in(folder: Path) -> Iterator[None]:
    """Prints the location of the record if the measurement fails; removes an empty folder."""
    try:
        yield
    except BaseException:
        if (folder / "recording.yaml").exists():
            note(f"what was measured is kept; go on with --resume {folder}")
        raise
    finally:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def phases() -> Iterator[Callable[[str, float, float], None]]:
    """Yields a progress function with one bar per phase; a phase is identified by its total duration, s."""
    with progress_bar() as bar:
        bars: dict[float, int] = {}

        def show(name: str, done_s: float, total_s: float) -> None:
            if total_s not in bars:
                bars[total_s] = bar.add_task("", total=total_s)
            bar.update(bars[total_s], completed=done_s, description=f"{name:>18}")  # type: ignore[arg-type]

        yield show
