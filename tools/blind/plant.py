"""Runs a simulated axis without a bus, far faster than its own time: procedures, calibrations, records.

A calibration runs on a `PlantRig` as on a bench. Loops, mechanics and
encoders are those behind the simulated drive's firmware. The command is in whole counts, one for each SYNC,
and the encoders are read at its end. The command is kept: `Plant.run` repeats it on an axis that has changed,
or with other noise.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from blind.axes import EverydayAxis
from numpy.typing import NDArray

from hdbridge import InputError, TransmissionModel, fit
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Moment
from hdbridge.commissioning.calibration import Journal
from hdbridge.commissioning.calibration.measure import remaining_plan
from hdbridge.control.bench import Run, axis_view, compensation_for, record_of, run_moves
from hdbridge.control.compensation import Compensation
from hdbridge.motion.procedures.moves import Move, Procedure, Sample, Settle
from hdbridge.motion.procedures.moves import Path as Way
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import rehearse
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

DATE = datetime(2026, 1, 1, tzinfo=UTC)
Floats = NDArray[np.float64]


class Plant:
    """Powered axis that follows a command, with its encoder readings."""

    def __init__(self, axis: EverydayAxis, truth: Truth, seed: int) -> None:
        self._machine = Machine(truth, seed, may_compile=True)
        self._substeps = round(axis.config.drive.cycle_s / truth.substep_s)
        self._flicker = axis.flicker_counts, np.random.default_rng(seed)
        self._motor, self._load = axis.config.motor_encoder.scale, axis.config.load_encoder.scale
        self._ratio = axis.config.gear.ratio
        self._last = 0.0

    def run(self, counts: Sequence[float]) -> dict[str, Floats]:
        """Follows a target in motor counts for each SYNC; returns columns of a record and the exact error."""
        seen = self._machine.follow_all([self._last, *counts], [self._substeps] * len(counts))
        self._last = float(counts[-1])
        size, noise = self._flicker
        flicker = size * noise.standard_normal(len(counts))
        exact_deg = self._load.degrees(1.0) * seen.load_reading
        exact_deg -= self._motor.degrees(1.0) * seen.motor_reading / self._ratio
        return {
            "motor_position_deg": self._motor.degrees(1.0) * np.floor(seen.motor_reading + flicker + 0.5),
            "load_position_deg": self._load.degrees(1.0) * np.floor(seen.load_reading + 0.5),
            "motor_target_deg": self._motor.degrees(1.0) * np.asarray(counts, dtype=np.float64),
            "motor_torque_nm": seen.torque_nm,
            "load_torque_nm": seen.load_torque_nm,
            "temperature_c": seen.temperature_c,
            "exact_arcsec": 3600.0 * exact_deg,
        }


class PlantRig:
    """Plant on which procedures run."""

    def __init__(self, axis: EverydayAxis, seed: int) -> None:
        self.axis: AxisConfig = axis.config
        self.identity = axis.config.drive.identity
        self.plant = Plant(axis, axis.truth, seed)
        self.target_deg: list[float] = []
        """Load target of every SYNC since the axis was switched on."""
        self.counts: list[float] = []
        """Commands, motor counts."""

    def bench(self, compensation: Compensation | None = None) -> PlantBench:
        """Returns a bench; without compensation, the motor target is the ratio times the load target."""
        return PlantBench(self, compensation)

    def compensated(self, model: TransmissionModel) -> PlantBench:
        """Returns a bench with compensation, or without it if the model has no inverse."""
        compensation = None
        with suppress(InputError):
            compensation = compensation_for(self.axis, model)
            compensation.reset(0.0, Moment())
            compensation.engage()
        return self.bench(compensation)


class PlantBench:
    """Runs procedures on a `PlantRig`."""

    def __init__(self, rig: PlantRig, compensation: Compensation | None) -> None:
        self._rig = rig
        self._compensation = compensation
        self._place = rig.target_deg[-1] if rig.target_deg else 0.0
        self._samples: list[dict[str, Floats]] = []
        self._legs: list[Segment] = []

    @property
    def legs(self) -> tuple[Segment, ...]:
        """Returns the moves of the last procedure."""
        return tuple(self._legs)

    def run(self, procedure: Procedure[Any], progress: Callable[[float], None] = lambda _: None) -> Run[Any]:
        """Runs a procedure to its end."""
        self._samples, self._legs = [], []
        view = axis_view(self._rig.axis)
        rehearsal = rehearse(procedure, view, self._place)
        outcome = run_moves(procedure, view, rehearsal, progress, lambda: self._place, self._leg)
        return Run(self.record(), self.legs, outcome=outcome)

    def record(self) -> Record:
        """Returns the samples of the last procedure."""
        names = ("time_s", "motor_position_deg", "load_position_deg", "motor_target_deg", "motor_torque_nm")
        if not self._samples:
            return record_of((), self._rig.axis)
        return Record({name: np.concatenate([each[name] for each in self._samples]) for name in names})

    def _leg(self, move: Move, way: Way) -> Sequence[Sample]:
        """Runs one move; only a `Settle` reads measured values."""
        period_s = self._rig.axis.drive.cycle_s
        cycles = math.ceil(way.duration_s / period_s - 1e-9) + 1
        samples = self._follow([way.at(cycle * period_s) for cycle in range(cycles)])
        first_s = float(self._samples[-1]["time_s"][0])
        if isinstance(move, Settle):
            while not move.ended(samples, axis_view(self._rig.axis)):
                samples += self._follow([self._place])
        last_s = float(self._samples[-1]["time_s"][-1])
        self._legs.append(Segment(kind=move.kind, start_s=first_s, end_s=last_s))
        return samples

    def _follow(self, targets: list[float]) -> list[Sample]:
        rig = self._rig
        scale, ratio = rig.axis.motor_encoder.scale, rig.axis.gear.ratio
        if self._compensation is None:
            counts = np.rint(scale.counts(ratio) * np.array(targets)).tolist()
        else:
            command = self._compensation.command
            counts = [float(round(scale.counts(command(each, Moment())))) for each in targets]
        seen = rig.plant.run(counts)
        seen["time_s"] = rig.axis.drive.cycle_s * np.arange(
            len(rig.counts) + 1, len(rig.counts) + len(counts) + 1
        )
        rig.counts += counts
        rig.target_deg += targets
        self._place = targets[-1]
        self._samples.append(seen)
        if len(targets) > 1_000:
            return []  # longer than any settling
        rows = zip(
            seen["time_s"].tolist(), targets, seen["motor_target_deg"].tolist(),
            seen["motor_position_deg"].tolist(), seen["load_position_deg"].tolist(),
            seen["motor_torque_nm"].tolist(), strict=True,
        )  # fmt: skip
        return [Sample(*row) for row in rows]


def calibrated(axis: EverydayAxis, folder: Path, seed: int) -> TransmissionModel:
    """Calibrates the axis; ``folder`` keeps the model for its next record."""
    kept = folder / "model.yaml"
    if not kept.exists():
        shutil.rmtree(folder, ignore_errors=True)
        rig = PlantRig(axis, seed)
        journal = Journal.create(folder / "recording", axis.config, Plan.load(axis.plan), DATE, rig.identity)
        journal.begin_session()
        bench = rig.bench()
        for task in remaining_plan(journal.plan, axis.config).tasks:
            bench.run(task.procedure)
            journal.add(task.name, bench.record(), bench.legs, complete=True)
        model = fit(journal.recording(), axis=axis.config).model
        shutil.rmtree(folder / "recording")
        model.save(kept)
    return TransmissionModel.load(kept)
