"""Validation of a model: the stepping test with the previous and with the new model."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects.elastic_loop import ElasticLoop
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.identification import resting
from hdbridge.commissioning.calibration.measure import SILENT, Callbacks, Pace
from hdbridge.commissioning.calibration.path import SETTLED_ARCSEC
from hdbridge.commissioning.evaluation.accuracy import AxisAccuracy, axis_accuracy
from hdbridge.commissioning.evaluation.stepping import Stepped, quantisation_floor_arcsec
from hdbridge.control.bench import Bench, Run, axis_view, compensation_for
from hdbridge.control.faultcounts import fault_notes
from hdbridge.drive.drive import Drive
from hdbridge.files.outputs import writing
from hdbridge.motion.procedures.moves import Settle
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import rehearse
from hdbridge.motion.procedures.stepping import SteppingOutcome
from hdbridge.records.recording import Recording
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN, figure

WINDOW_S = 0.06
"""Averaging time of a reading at rest in the stepping test, s."""
CHANCE = 2.0
"""Significance limit for a worse stepping test, in standard errors."""


def worse_ways(before: Stepped, after: Stepped) -> tuple[str, ...]:
    """Returns one line for each direction in which the steps scatter significantly more after than before.

    The pooled scatter may nevertheless be smaller.
    """
    found = []
    for name, one, other, errors in (
        ("CW", before.cw, after.cw, after.errors_arcsec[0]),
        ("CCW", before.ccw, after.ccw, after.errors_arcsec[1]),
    ):
        if other.three_sigma_arcsec > _chance(len(errors)) * one.three_sigma_arcsec:
            found.append(
                f"worse {name}: 3 sigma {one.three_sigma_arcsec:.2f} to {other.three_sigma_arcsec:.2f} arcsec"
            )
    return tuple(found)


def _chance(steps: int) -> float:
    """Returns the ratio above which a standard deviation from this number of steps is significantly larger.

    The relative standard error of a standard deviation is 1 / sqrt(2 n), and that of the ratio of two
    standard deviations is 1 / sqrt(n).
    """
    return 1.0 + CHANCE / math.sqrt(max(steps, 1))


@dataclass(frozen=True, slots=True)
class Validation:
    """Results of the stepping test with the previous and the new model, and the best possible result."""

    before: Stepped
    after: Stepped
    floor: Floor
    accuracy_before: AxisAccuracy | None = None
    accuracy_after: AxisAccuracy | None = None
    """Accuracy from the positioning test; None if the plan has none."""
    fault_notes: tuple[str, ...] = ()
    """One line for each run with tolerated faults, or with a motor that turns back at rest."""

    @property
    def improves(self) -> bool:
        """True if positioning is not significantly worse with the new model."""
        return not _exceeds(
            self.after.pooled.three_sigma_arcsec, self.before.pooled.three_sigma_arcsec, self.after
        )

    @property
    def worse(self) -> tuple[str, ...]:
        """Directions that became worse, in words."""
        return worse_ways(self.before, self.after)

    @property
    def summary(self) -> str:
        """Result in one sentence: 3 sigma before and after, their ratio, and the best possible."""
        before, after = (each.pooled.three_sigma_arcsec for each in (self.before, self.after))
        ratio = before / after if after <= before else after / before
        return (
            f"{before:.1f} to {after:.1f} arcsec (3 sigma), {figure(ratio, 2)} times "
            f"{'better' if after <= before else 'worse'}; best possible {self.floor.three_sigma_arcsec:.2f}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Returns plain data for `from_dict`."""
        return {
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "floor_arcsec": self.floor.three_sigma_arcsec,
            "quantisation_floor_arcsec": self.floor.quantisation_arcsec,
            "noise_floor_arcsec": self.floor.noise_arcsec,
            "worse": list(self.worse),
            "survived": list(self.fault_notes),
            "of_floor": self.after.pooled.three_sigma_arcsec / self.floor.three_sigma_arcsec,
            "accuracy": {
                "before": asdict(self.accuracy_before) if self.accuracy_before else None,
                "after": asdict(self.accuracy_after) if self.accuracy_after else None,
            },
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Validation:
        stepped = TypeAdapter(Stepped).validate_python
        accurate = TypeAdapter(AxisAccuracy | None).validate_python
        return cls(
            stepped(data["before"]),
            stepped(data["after"]),
            Floor(data["quantisation_floor_arcsec"], data["noise_floor_arcsec"]),
            accurate(data["accuracy"]["before"]),
            accurate(data["accuracy"]["after"]),
            tuple(map(str, data["survived"])),
        )


@dataclass(frozen=True, slots=True)
class Floor:
    """Best possible three sigma of a stepping test, with the gear perfectly known; arcsec."""

    quantisation_arcsec: float
    """Contribution of the motor encoder, because a motor target is a whole number of counts."""
    noise_arcsec: float
    """Contribution of the load encoder: its noise between settled windows, and its resolution."""

    @property
    def three_sigma_arcsec(self) -> float:
        """Root sum square of both contributions."""
        return math.hypot(self.quantisation_arcsec, self.noise_arcsec)


def floor_of(axis: AxisConfig, recording: Recording) -> Floor:
    """Returns the best possible result, from the encoders' resolutions and the recorded noise at rest."""
    means = resting(recording, WINDOW_S)
    count = axis.load_encoder.resolution_arcsec / math.sqrt(12.0)
    noise = float(np.std(means)) if len(means) else 0.0
    quantisation = quantisation_floor_arcsec(axis.motor_encoder.counts_per_turn, axis.gear.ratio)
    return Floor(quantisation, 3.0 * math.hypot(noise, count))


def validation_s(plan: Plan, axis: AxisConfig) -> float:
    """Returns the duration of a plan's validation on an ideal axis, s."""
    view = axis_view(axis)
    stepping, positioning = plan.stepping(view), plan.positioning(view)
    each_s = rehearse(stepping, view, stepping.start_deg).duration_s
    if positioning:
        each_s += rehearse(positioning, view, positioning.targets_deg[0]).duration_s
    return 2.0 * each_s


def validate(
    drive: Drive,
    plan: Plan,
    before: TransmissionModel | None,
    after: TransmissionModel,
    floor: Floor,
    folder: Path,
    callbacks: Callbacks = SILENT,
) -> tuple[Validation, TransmissionModel]:
    """Runs the stepping and positioning tests with ``before`` (None: no compensation), then with ``after``.

    The new model is tested, and returned, with the hysteresis offset fitted by `at_rest`. ``drive`` is
    booted. The samples of each run are written to ``folder``, even if the run is stopped.
    """
    axis = drive.axis
    stepping = plan.stepping(axis_view(axis))
    positioning = plan.positioning(axis_view(axis))
    pace = Pace(validation_s(plan, axis), axis.drive.cycle_s, callbacks)
    results: list[Stepped] = []
    accuracies: list[AxisAccuracy] = []
    notes: list[str] = []
    model = before or TransmissionModel(axis.gear.ratio)

    def stepped(name: str, model: TransmissionModel) -> tuple[Bench, Run[SteppingOutcome]]:
        pace.begin(f"stepping {name}")
        bench = Bench(drive, compensation_for(axis, model), interrupted=pace.interrupted)
        with record_kept(bench, folder / f"stepping-{name}.csv.gz"):
            return bench, bench.run(stepping)

    for name, words in (
        ("before", "the active model" if before else "no compensation"),
        ("after", "the new model"),
    ):
        bench, run = stepped(name, model)
        test = Stepped.of(words, run.outcome)
        # The hysteresis at rest depends on the overshoot of the arriving motor. A compensated wind-up
        # changes it: the means of the two directions differ then.
        if name == "after" and _exceeds(test.pooled.three_sigma_arcsec, _within_directions(test), test):
            model = at_rest(model, run)
            bench, run = stepped(name, model)
            test = Stepped.of(words, run.outcome)
        results.append(test)
        notes += fault_notes([(f"stepping {name}", run.fault_counts)])
        if name == "after" and _exceeds(_within_directions(test), floor.three_sigma_arcsec, test):
            notes += _turning_back(run, axis)
        if positioning:
            pace.begin(f"positioning {name}")
            with record_kept(bench, folder / f"positioning-{name}.csv.gz"):
                measured = bench.run(positioning)
            approaches = measured.outcome
            notes += fault_notes([(f"positioning {name}", measured.fault_counts)])
            accuracies.append(
                axis_accuracy(
                    [each.target_deg for each in approaches],
                    [each.error_arcsec for each in approaches],
                    [each.forward for each in approaches],
                )
            )
        if name == "before":
            model = at_rest(after, run)
    accurate = (accuracies[0], accuracies[1]) if accuracies else (None, None)
    return Validation(results[0], results[1], floor, accurate[0], accurate[1], tuple(notes)), model


def _within_directions(test: Stepped) -> float:
    """Returns three sigma about the mean of each direction."""
    return math.hypot(test.cw.three_sigma_arcsec, test.ccw.three_sigma_arcsec) / math.sqrt(2.0)


def _exceeds(scatter_arcsec: float, other_arcsec: float, test: Stepped) -> bool:
    """Returns True if a scatter in a test is significantly larger than another."""
    return scatter_arcsec > _chance(sum(map(len, test.errors_arcsec))) * other_arcsec


def _turning_back(run: Run[SteppingOutcome], axis: AxisConfig) -> Iterator[str]:
    """Yields a line if the motor turns back after most moves: the model cannot know the hysteresis then."""
    count_deg = DEG_PER_TURN / axis.motor_encoder.counts_per_turn
    back_deg = max(SETTLED_ARCSEC / ARCSEC_PER_DEG * axis.gear.ratio, 1.5 * count_deg)
    time_s, motor_deg = run.record.time_s, run.record.columns["motor_position_deg"]
    rests = [each for each in run.segments if each.kind == Settle().kind]
    turned = 0
    for each in rests:
        motor = motor_deg[(time_s >= each.start_s) & (time_s <= each.end_s)]
        forward = np.max(motor - np.minimum.accumulate(motor))
        back = np.max(np.maximum.accumulate(motor) - motor)
        turned += int(min(forward, back) > back_deg)
    if 2 * turned > len(rests):
        yield (
            f"after {turned} of {len(rests)} steps the motor turned back by more than {back_deg:.2g} deg "
            "before it stood still: the servo hunts or overshoots, so the hysteresis at rest varies: "
            "tune the drive and calibrate again"
        )


def at_rest(model: TransmissionModel, run: Run[SteppingOutcome]) -> TransmissionModel:
    """Returns the model with its hysteresis offset fitted to the positions at rest in a stepping test.

    In motion, the reading of a coarse motor encoder is wrong by a fraction of a count; on arrival, a motor
    that overshoots by a few hundredths of a degree moves back on the hysteresis loop. Both add to the offset
    at rest.
    """
    loop = next((each for each in model.effects if isinstance(each, ElasticLoop)), None)
    if loop is None:
        return model
    motion, stands = run.record.motion(), (*run.outcome.cw, *run.outcome.ccw)
    ends_s = [each.end_s for each in run.segments if each.kind == Settle().kind]
    rows = np.searchsorted(run.record.time_s, ends_s, "right") - 1
    load_deg = np.array([each.load_deg for each in stands])
    error = ARCSEC_PER_DEG * (load_deg - motion.motor_deg[rows] / model.ratio) - model.predict(motion)[rows]
    columns = np.column_stack([loop.columns(motion)[rows], np.ones(len(rows))])
    change = np.linalg.lstsq(columns, error, rcond=None)[0][0]
    resting = loop.fitted(loop.coefficients() + change)
    return replace(model, effects=tuple(resting if each is loop else each for each in model.effects))


@contextmanager
def record_kept(bench: Bench, path: Path) -> Iterator[None]:
    """Writes the bench's record to ``path`` on exit, even if the run is stopped."""
    try:
        yield
    finally:
        record = bench.record()
        if len(record):
            with writing():
                record.write_csv(path)
