"""Trial of an extended model: stepping with both models alternately, to compare their positioning."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, HysteresisMemory
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.measure import Callbacks, Pace
from hdbridge.commissioning.calibration.validation import (
    CHANCE,
    Floor,
    Validation,
    worse_ways,
)
from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.control.bench import axis_view, compensation_for
from hdbridge.control.faultcounts import FaultCount, fault_notes
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.moves import AxisView
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import total_duration_s
from hdbridge.motion.procedures.small_steps import SmallSteps
from hdbridge.motion.procedures.stepping import Stepping, SteppingOutcome

PIECES = 4
"""Number of parts of the travel; both models step in each part, so that a drift affects both equally."""
SMALL_STEPS = 40
DEFAULT_WIDTH_DEG = 20.0
"""Hysteresis width assumed for the small steps if the model has no hysteresis; motor degrees."""
_WORDS = ("the active model", "the extended model")


@dataclass(frozen=True, slots=True)
class Trial:
    """Results of stepping with the active and the extended model, at the load encoder."""

    stepping: Validation
    """Steps longer than the hysteresis width, over the plan's travel."""
    small: tuple[Stepped, Stepped]
    """Steps shorter than the hysteresis width about one pose, with the active and with the extended model."""

    @property
    def improves(self) -> bool:
        """True if positioning improves in one of the two tests and worsens in neither, beyond chance."""
        gains = [_gain(self.stepping.before, self.stepping.after), _gain(*self.small)]
        return any(each > CHANCE for each in gains) and all(each > -CHANCE for each in gains)

    @property
    def worse(self) -> tuple[str, ...]:
        """One line for each direction of either test in which the scatter is significantly larger."""
        small = (f"small steps {each}" for each in worse_ways(*self.small))
        return (*self.stepping.worse, *small)

    @property
    def of_floor(self) -> float:
        """Ratio of the three sigma of stepping with the extended model to the best possible on this axis."""
        return self.stepping.after.pooled.three_sigma_arcsec / self.stepping.floor.three_sigma_arcsec

    def as_dict(self) -> dict[str, Any]:
        """Returns plain data; ``stepping`` has the format of a calibration's stepping test."""
        before, after = self.small
        return {
            "stepping": self.stepping.as_dict(),
            "small_steps": {
                "before": before.as_dict(),
                "after": after.as_dict(),
                "worse": list(worse_ways(before, after)),
            },
            "improves": self.improves,
        }


def run_trial(
    drive: Drive,
    plan: Plan,
    active: TransmissionModel,
    model: TransmissionModel,
    floor: Floor,
    folder: Path,
    callbacks: Callbacks,
) -> Trial:
    """Steps a booted drive's axis with both models alternately, one part of the travel after the other.

    Each run's samples are written to ``folder``, even if it is interrupted. Raises `InputError` before any
    motion if the axis lacks a channel that the model's compensation needs.
    """
    axis = drive.axis
    compensations = [compensation_for(axis, each) for each in (active, model)]
    procedures = _procedures(plan, axis_view(axis), active)
    pace = Pace(drive, trial_s(plan, axis, active), callbacks)
    outcomes: tuple[list[SteppingOutcome], list[SteppingOutcome]] = ([], [])
    fault_counts: list[tuple[str, tuple[FaultCount, ...]]] = []
    for number, (name, procedure) in enumerate(procedures):
        for which in (0, 1) if number % 2 == 0 else (1, 0):
            title = f"{name}-{'before' if which == 0 else 'after'}"
            path = folder / f"{title}.csv.gz"
            run = pace.run(title.replace("-", " "), procedure, compensations[which], path)
            outcomes[which].append(run.outcome)
            fault_counts.append((title, run.fault_counts))
    pieces = [Stepped.of(words, _together(each[:-1])) for words, each in zip(_WORDS, outcomes, strict=True)]
    small = [Stepped.of(words, each[-1]) for words, each in zip(_WORDS, outcomes, strict=True)]
    stepping = Validation(pieces[0], pieces[1], floor, fault_notes=tuple(fault_notes(fault_counts)))
    return Trial(stepping, (small[0], small[1]))


def trial_s(plan: Plan, axis: AxisConfig, active: TransmissionModel) -> float:
    """Returns the duration of the trial on an ideal axis, s."""
    view = axis_view(axis)
    return 2.0 * total_duration_s((each for _, each in _procedures(plan, view, active)), view)


def _procedures(
    plan: Plan, view: AxisView, active: TransmissionModel
) -> list[tuple[str, Stepping | SmallSteps]]:
    """Returns the parts of the plan's stepping test, followed by the small steps, by name."""
    whole = plan.stepping(view)
    count = max(whole.count // PIECES, 2)
    pieces = [
        replace(
            whole,
            count=min(count, whole.count - first)
            if first + 2 * count <= whole.count
            else whole.count - first,
            start_deg=whole.start_deg + first * whole.step_deg / view.ratio,
        )
        for first in range(0, whole.count - count + 1, count)
    ]
    widths = [each.width_deg for each in active.effects if isinstance(each, Hysteresis | HysteresisMemory)]
    small = SmallSteps(
        view.limits.middle_deg,
        0.9 * min(*(widths or [DEFAULT_WIDTH_DEG]), plan.precondition_deg),
        min(SMALL_STEPS, 2 * whole.count),
        whole.precondition_deg,
    )
    return [*((f"stepping-{n}", each) for n, each in enumerate(pieces, 1)), ("small-steps", small)]


def _together(outcomes: Sequence[SteppingOutcome]) -> SteppingOutcome:
    return SteppingOutcome(
        cw=tuple(each for one in outcomes for each in one.cw),
        ccw=tuple(each for one in outcomes for each in one.ccw),
    )


def _gain(before: Stepped, after: Stepped) -> float:
    """Returns the decrease of the error variance at the same targets, in standard errors."""
    squares = []
    for stepped in (before, after):
        errors = np.concatenate([np.asarray(each) for each in stepped.errors_arcsec])
        squares.append((errors - errors.mean()) ** 2)
    fall = squares[0] - squares[1]
    error = float(np.std(fall)) / math.sqrt(len(fall))
    return float(np.mean(fall)) / error if error > 0.0 else 0.0
