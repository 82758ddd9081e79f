"""Bench: runs procedures on a real or simulated drive, and records the measurements.

Code and procedures are the same for both; only the drive's bus and clock differ.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.axis.effects import Channel, Moment, compensable, missing_channels
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.channelstate import ChannelState
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.cycle import Cycle, Feedback
from hdbridge.control.faultcounts import FaultCount, FaultCounter
from hdbridge.control.realtime import resumed_realtime
from hdbridge.drive.drive import Drive
from hdbridge.drive.feedback import ENABLE_TIMEOUT_S, STANDING, STOP_TIMEOUT_S, until_enabled
from hdbridge.drive.layout import layouts
from hdbridge.drive.link import new_tuple
from hdbridge.drive.objects import TORQUE_ACTUAL
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import DriveError, HdbridgeError, InputError, SafetyStop
from hdbridge.motion.procedures.moves import AxisView, MotionLimits, Move, Path, Procedure, Sample
from hdbridge.motion.procedures.rehearsal import Rehearsal, rehearse
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment, versions_here

Outcome = TypeVar("Outcome")
_log = logging.getLogger(__name__)
_AT_REST = Moment()


class _Leg(NamedTuple):
    """Move of a procedure as executed; converted to a `Segment` after the run."""

    kind: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Run(Recording, Generic[Outcome]):
    """Recording of a completed procedure, with its outcome."""

    outcome: Outcome = field(kw_only=True)
    fault_counts: tuple[FaultCount, ...] = field(default=(), kw_only=True)
    """Faults that the supervision tolerated."""


def online_channels(axis: AxisConfig) -> frozenset[Channel]:
    """Returns the channels that `Bench` passes to the effects in each cycle."""
    known = {each for each in Channel if each.axis_key in {"", *axis.channels}}
    return frozenset(known - ({Channel.MOTOR_TORQUE} if TORQUE_ACTUAL in layouts(axis).absent else set()))


def run_moves(
    procedure: Procedure[Outcome],
    view: AxisView,
    rehearsal: Rehearsal,
    progress: Callable[[float], None],
    place_deg: Callable[[], float],
    leg: Callable[[Move, Path], Sequence[Sample]],
) -> Outcome:
    """Runs the legs of a procedure in sequence, without pauses; returns its outcome.

    ``place_deg`` returns the current load target; ``leg`` runs a move along its path and returns its samples.
    """
    done_s = 0.0
    steps = procedure.moves(view)
    try:
        move = next(steps)
        while True:
            path = move.path(place_deg(), view.limits)
            samples = leg(move, path)
            done_s += path.duration_s
            progress(min(done_s / rehearsal.duration_s, 1.0) if rehearsal.duration_s else 1.0)
            move = steps.send(samples)
    except StopIteration as end:
        outcome: Outcome = end.value
        return outcome


def record_of(samples: Sequence[Sample], axis: AxisConfig) -> Record:
    """Returns the record of a bench's samples, without channels that failed during the run."""
    names = Sample._fields[:-1]
    table = np.array([row[:-1] for row in samples], dtype=np.float64).reshape(-1, len(names))
    columns = dict(zip(names, table.T, strict=True))
    columns.pop("load_target_deg")
    if np.isnan(columns["motor_torque_nm"]).any():
        del columns["motor_torque_nm"]  # the drive does not send it
    for place, key in enumerate(axis.channels):
        reading = np.array([row.readings[place] for row in samples], dtype=np.float64)  # None becomes NaN
        if not np.isnan(reading).any():
            columns[BY_KEY[key].value] = reading
    return Record(columns)


def lost_channels(axis: AxisConfig, record: Record) -> tuple[str, ...]:
    """Returns the axis-file keys of the channels missing from a record of `Bench`."""
    return tuple(key for key in axis.channels if BY_KEY[key].value not in record.columns)


def axis_view(axis: AxisConfig) -> AxisView:
    """Returns the axis properties available to procedures."""
    limits = axis.limits
    return AxisView(
        axis.gear.ratio,
        MotionLimits(
            limits.position_min_deg,
            limits.position_max_deg,
            limits.velocity_deg_s,
            limits.acceleration_deg_s2,
            limits.jerk_deg_s3,
        ),
        abs(axis.motor_encoder.degrees(1)),
    )


def compensation_for(axis: AxisConfig, model: TransmissionModel) -> Compensation:
    """Returns the compensation for a model, with the limits and the cycle time of the axis file.

    Raises InputError if the model is bound to a different gear, axis or drive, or if an effect needs a
    channel that the control loop lacks.
    """
    model.check_bound_to(axis)
    for name, channels in missing_channels(compensable(model.effects), online_channels(axis)).items():
        lacking = sorted(channels, key=lambda each: each.value)
        keys = " and ".join(f"'{each.axis_key}'" for each in lacking if each.axis_key)
        add = f"add {keys} to {axis.path}, or " * bool(keys)
        raise InputError(
            f"the effect '{name}' needs {', '.join(each.value for each in lacking)}, which this axis does "
            f"not have: {add}leave the effect out of the model that compensates"
        )
    caps = axis.compensation
    limits = CompensationLimits(caps.maximum_arcsec, caps.slew_arcsec_s, caps.ramp_s)
    return Compensation(model, limits, axis.drive.cycle_s)


class Bench:
    """Drive in cyclic position mode, with or without compensation.

    Power is on only while a procedure runs. `run` enables the drive at standstill, and always brings it to
    rest and disables it at the end, so files can be written between procedures. The compensation is ramped in
    at the start of each procedure.
    """

    def __init__(
        self,
        drive: Drive,
        compensation: Compensation | TransmissionModel | None = None,
        *,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepares the bench; a model is converted by `compensation_for`, with its InputErrors.

        ``interrupted`` is called in each cycle and stops the axis by returning True (KeyboardInterrupt).
        """
        axis = drive.axis
        if compensation is None:
            compensation = TransmissionModel(axis.gear.ratio)
        if isinstance(compensation, TransmissionModel):
            compensation = compensation_for(axis, compensation)
        self.axis = axis
        self.view = axis_view(axis)
        self.supervision = Supervision()
        self.cycle = Cycle(
            drive.link,
            drive.link.clock,
            drive.image,
            self.supervision,
            axis.drive.cycle_s,
            monitor=drive.monitor,
        )
        self._drive = drive
        self._image = drive.image
        self._compensation = compensation
        self._interrupted = interrupted
        self._channel_state = ChannelState(axis)
        self._place = 0.0
        self._most = math.inf
        """Maximum number of samples of a leg; beyond it, the first half is dropped."""
        self._measured: list[list[Sample]] = []
        self._legs: list[_Leg] = []
        self._fault_counter = FaultCounter(self.supervision, 0)

    def run(
        self,
        procedure: Procedure[Outcome],
        progress: Callable[[float], None] = lambda _: None,
        *,
        keep_s: float = math.inf,
    ) -> Run[Outcome]:
        """Runs one procedure to its end; ``progress`` receives the completed fraction after each leg.

        ``keep_s`` limits the samples of a leg that holds the axis for hours. At least the last ``keep_s``
        seconds are kept, at most twice as many.

        Raises InputError before any motion if the procedure would leave the axis's limits or if the
        compensation's model is bound to a different gear, axis or drive. Raises SafetyStop if the supervision
        stops the axis, and KeyboardInterrupt if interrupted; `record` then returns the samples up to the
        stop.
        """
        # Every motion with a model begins here: check the model against the connected drive, not only the
        # axis file.
        self._compensation.model.check_bound_to(self._drive.axis, self._drive.identity)
        standing_deg = self._drive.read_positions().motor_deg / self.view.ratio
        rehearsal = rehearse(procedure, self.view, standing_deg)
        self._measured.clear()
        self._legs.clear()
        self._most = math.inf if math.isinf(keep_s) else max(2 * math.ceil(keep_s / self.cycle.period_s), 2)
        _log.info("run begins", {"procedure": type(procedure).__name__, "ideally_s": rehearsal.duration_s})
        self._fault_counter = FaultCounter(self.supervision, self.cycle.skipped)
        try:
            with resumed_realtime():
                outcome = self._powered(procedure, rehearsal, progress)
        finally:
            self._log_end()
        axis = self._drive.axis
        return Run(
            self.record(),
            self.legs,
            axis=axis.name,
            ratio=axis.gear.ratio,
            drive=self._drive.identity,
            versions=versions_here(),
            notes={"procedure": type(procedure).__name__},
            outcome=outcome,
            fault_counts=self.fault_counts,
        )

    def _powered(
        self, procedure: Procedure[Outcome], rehearsal: Rehearsal, progress: Callable[[float], None]
    ) -> Outcome:
        """Runs the procedure, from power on to power off."""
        self._drive.enable()
        try:
            self._engage()
            outcome = run_moves(procedure, self.view, rehearsal, progress, lambda: self._place, self._leg)
        except SafetyStop:
            raise  # the drive is at rest, or stops on its own; the latch remains
        except BaseException:
            with suppress(HdbridgeError):
                self._image.power.quick_stop()
                self._rest()
            raise
        self._image.power.go(State.SWITCH_ON_DISABLED)
        self._rest()
        return outcome

    def _log_end(self) -> None:
        """Logs the events of the run once the axis is at rest, because the cycle itself does not log."""
        nodes = self._drive.monitor.nodes.values()
        facts = {
            "samples": sum(len(each) for each in self._measured),
            "legs": len(self._legs),
            "supervision": {fault.name.lower(): n for fault, n in self.supervision.counts.items() if n},
            "emergencies": [str(each) for node in nodes for each in node.emergencies],
        }
        _log.info("run ended", {name: value for name, value in facts.items() if value})

    def record(self) -> Record:
        """Returns the samples of the current procedure so far.

        A channel that failed during the run is left out, because held values would look like measurements.
        """
        # Converted to arrays only here: on a real bus there is no time for it between two legs.
        return record_of([sample for samples in self._measured for sample in samples], self._image.axis)

    @property
    def legs(self) -> tuple[Segment, ...]:
        """Moves of the current procedure so far."""
        return tuple(Segment(kind=each.kind, start_s=each.start_s, end_s=each.end_s) for each in self._legs)

    @property
    def fault_counts(self) -> tuple[FaultCount, ...]:
        """Faults of the current procedure so far, including the one that stopped it, and skipped periods."""
        return self._fault_counter.fault_counts(self.cycle.skipped)

    def _engage(self) -> None:
        """Enables the drive by PDO at standstill, with the compensation starting from its position."""
        self.cycle.restart()
        feedback = until_enabled(self.cycle.tick, self._image.power, self.cycle.period_s)
        feedback = self._await_channels(feedback)
        motor_deg = self._image.motor_deg(feedback.motor_counts)
        self._place = motor_deg / self.view.ratio
        self._channel_state.begin(feedback, motor_deg, self._compensation)
        self._compensation.engage()

    def _await_channels(self, feedback: Feedback) -> Feedback:
        """Waits at standstill until every channel of the axis file has a reading; DriveError on time-out."""
        image, period_s = self._image, self.cycle.period_s
        rarest = max((each.every_cycles for each in image.axis.channels.values()), default=0)
        for _ in range(math.ceil(ENABLE_TIMEOUT_S / period_s) + 2 * rarest):
            waiting = [each for each in image.channels if each.value is None]
            if not waiting:
                return feedback
            if waiting[0].lost:
                break
            feedback = self.cycle.tick()
        raise DriveError(
            f"{image.axis.where(waiting[0].key)}: no plausible reading arrived ({waiting[0].why}); "
            "check the sensor, or leave the key out"
        )

    def _leg(self, move: Move, path: Path) -> Sequence[Sample]:
        """Runs one move, cycle by cycle, from the current load target; returns its samples."""
        samples: list[Sample] = []
        tick, image, interrupted = self.cycle.tick, self._image, self._interrupted
        command, hold, counts_for = (
            self._compensation.command,
            self._compensation.hold,
            image.target_counts_for,
        )
        axis, torque_nm = image.axis, self._channel_state.torque_nm
        motor_deg, load_deg = axis.motor_encoder.scale.degrees, axis.load_encoder.scale.degrees
        period_s, duration_s, at = self.cycle.period_s, path.duration_s, path.at
        compensation, moment_of = self._compensation, self._channel_state.moment
        needs = bool(compensation.needs)
        target_deg, most = self._place, self._most
        # Counted in completed cycles, not in clock time: a skipped period must not make the
        # target jump ahead.
        elapsed_s = 0.0

        def answer(feedback: Feedback) -> int:
            moment = moment_of(feedback, target_deg, compensation) if needs else _AT_REST
            return counts_for(command(target_deg, moment) if feedback.fresh else hold(target_deg, moment))

        try:
            while True:
                target_deg = at(elapsed_s)
                feedback = tick(answer)
                samples.append(
                    new_tuple(
                        Sample,
                        (
                            feedback.time_s,
                            target_deg,
                            motor_deg(feedback.demand_counts),
                            motor_deg(feedback.motor_counts),
                            load_deg(feedback.load_counts),
                            feedback.torque_permille * torque_nm,
                            feedback.readings,
                        ),
                    )
                )
                if len(samples) > most:
                    del samples[: len(samples) // 2]
                self._place = target_deg
                if interrupted():
                    raise KeyboardInterrupt
                if elapsed_s >= duration_s and move.ended(samples, self.view):
                    return samples
                elapsed_s += period_s
        finally:
            if samples:
                self._measured.append(samples)
                self._legs.append(_Leg(move.kind, samples[0].time_s, samples[-1].time_s))

    def _rest(self) -> None:
        """Waits until the drive is at rest with power off or in quick stop, then disables it."""
        power = self._image.power
        for _ in range(math.ceil(STOP_TIMEOUT_S / self.cycle.period_s)):
            before = self._image.motor_counts
            self.cycle.tick()
            if power.state in STANDING and abs(self._image.motor_counts - before) <= 1:
                break
        self._drive.disable()
