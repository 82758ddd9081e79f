"""Motion test: ripple over speed by order, path errors, and the response of the axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from hdbridge.analysis.response import (
    DIFFERENT,
    LEAST_ARCSEC,
    STOP,
    Answers,
    Harmonics,
    Limits,
    Trial,
    following_lag_s,
    gain,
    harmonics,
    lags_agree,
    motor_orders,
    order_hz,
    response_of,
)
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import InertialWindup, Motion, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import Response
from hdbridge.commissioning.calibration.measure import SILENT, Callbacks, Pace
from hdbridge.commissioning.calibration.path import PathError, inertia_over_stiffness, path_errors
from hdbridge.control.bench import axis_view, compensation_for
from hdbridge.drive.drive import Drive
from hdbridge.drive.gains import changed_gains, read_gains
from hdbridge.errors import InputError
from hdbridge.motion.procedures.even_speed import SHARES, EvenRun, EvenSpeed
from hdbridge.motion.procedures.path_test import PathRun, PathTest
from hdbridge.motion.procedures.rehearsal import total_duration_s
from hdbridge.units import ARCSEC_PER_DEG, rounded

CHANCE = 1.05
"""Ratio of two ripples, or of two path errors, above which the first counts as larger."""
FADED = 0.5
"""Fraction of the required gain below which the filter counts as no longer correcting an order."""
RETUNED = (
    "the servo does not respond as it did when the response was measured (following lag {:.1f} ms then, "
    "{:.1f} ms now; the response differs by {:.0f} %): it was retuned, or the load changed; measure the "
    "response again"
)
CHECKED = (0.64, 0.38, 0.18)
"""Speeds at which the stored response is checked, as fractions of the speed limit."""
NO_LOAD_ENCODER = (
    "load_encoder.source is the motor encoder: the ripple is that of the load angle predicted from motor "
    "encoder and model; path errors are not measured"
)
TRIALS = 3
"""Maximum number of filters to try. Each is designed from the runs with the previous ones; the first is
exploratory and also corrects orders beyond the known frequency range."""


@dataclass(frozen=True, slots=True)
class OrderRipple:
    """Amplitude of one motor order in the load error at one speed, rms of both directions; arcsec."""

    order: int
    frequency_hz: float
    none_arcsec: float
    static_arcsec: float | None = None
    filtered_arcsec: float | None = None


@dataclass(frozen=True, slots=True)
class PathResult:
    """Errors on one path: without correction, static, filtered, and filtered with wind-up compensation."""

    name: str
    none: PathError
    static: PathError
    filtered: PathError | None = None
    wind_up: PathError | None = None


@dataclass(frozen=True, slots=True)
class Ripple:
    """Rms of the load error about a straight line at one speed, both directions together; arcsec."""

    speed_deg_s: float
    none_arcsec: float
    static_arcsec: float | None = None
    filtered_arcsec: float | None = None
    faded_orders: tuple[int, ...] = ()
    """Motor orders that are too fast for the filter at this speed."""
    orders: tuple[OrderRipple, ...] = ()

    @property
    def in_force_arcsec(self) -> float | None:
        """Ripple with the filtered correction if it was run, otherwise with the static correction."""
        return self.static_arcsec if self.filtered_arcsec is None else self.filtered_arcsec

    @property
    def removed_in_force_percent(self) -> float | None:
        """Percentage of the ripple that the correction in force removes."""
        return _removed(self.none_arcsec, self.in_force_arcsec)

    @property
    def removed_percent(self) -> float | None:
        """Percentage of the ripple that the filtered correction removes."""
        return _removed(self.none_arcsec, self.filtered_arcsec)

    @property
    def removed_static_percent(self) -> float | None:
        """Percentage of the ripple that the static correction removes."""
        return _removed(self.none_arcsec, self.static_arcsec)


@dataclass(frozen=True, slots=True)
class MotionTest:
    """Ripple over speed without correction, with the static correction, and with the filtered correction."""

    ripples: tuple[Ripple, ...]
    response: Response | None
    """Response with the filter of the correction; None if no filter helps."""
    remarks: tuple[str, ...] = ()
    paths: tuple[PathResult, ...] = ()
    wind_up: InertialWindup | None = None
    """Wind-up due to acceleration of the load, if its compensation reduces the path error."""

    def applied(self, model: TransmissionModel) -> TransmissionModel:
        """Returns a model with the response and the wind-up of this test."""
        effects = model.effects if self.wind_up is None else (*model.effects, self.wind_up)
        return replace(model, effects=effects, response=self.response)

    @property
    def helps_to_deg_s(self) -> float | None:
        """Highest speed up to which the correction in force removes at least half of the ripple."""
        reached = None
        for each in sorted(self.ripples, key=lambda one: one.speed_deg_s):
            removed = each.removed_in_force_percent
            if removed is None or removed < 50.0:
                break
            reached = each.speed_deg_s
        return reached

    @property
    def summary(self) -> str:
        """Ripple at the highest speed, without and with the correction in force, in words."""
        fastest = max(self.ripples, key=lambda each: each.speed_deg_s)
        after = fastest.in_force_arcsec
        left = "" if after is None else f" to {after:.2f}"
        return f"ripple at {fastest.speed_deg_s:g} deg/s {fastest.none_arcsec:.2f}{left} arcsec"

    @property
    def harms_at(self) -> tuple[float, ...]:
        """Speeds at which the filtered correction leaves more ripple than no correction, deg/s."""
        return tuple(
            each.speed_deg_s
            for each in self.ripples
            if each.filtered_arcsec is not None and each.filtered_arcsec > CHANCE * each.none_arcsec
        )

    @property
    def harms_paths(self) -> bool:
        """True if the rms error over all paths is larger with the filtered correction than without."""
        filtered = [each.filtered.path_arcsec for each in self.paths if each.filtered is not None]
        return bool(filtered) and _rms(filtered) > CHANCE * _rms(
            [each.none.path_arcsec for each in self.paths]
        )

    @property
    def gains_by_wind_up(self) -> bool:
        """True if compensation of the wind-up reduces the path error, with wind-up, over all paths."""
        pairs = [(each.filtered, each.wind_up) for each in self.paths]
        before, after = ([one.delayed_arcsec for one in each if one] for each in zip(*pairs, strict=True))
        return bool(after) and CHANCE * _rms(after) < _rms(before)

    @property
    def remaining(self) -> float:
        """Mean fraction of the ripple that remains with the filtered correction; 1 if there is no filter."""
        shares = [
            1.0 if each.filtered_arcsec is None else each.filtered_arcsec / each.none_arcsec
            for each in self.ripples
        ]
        return sum(shares) / len(shares)

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``hdbridge motion --json``, schema ``hdbridge.motion/1``."""
        return {
            "schema": "hdbridge.motion/1",
            "helps_to_deg_s": self.helps_to_deg_s,
            "speeds": [
                {
                    **asdict(each),
                    "removed_static_percent": each.removed_static_percent,
                    "removed_percent": each.removed_percent,
                }
                for each in self.ripples
            ],
            "paths": [asdict(each) for each in self.paths],
            "response": self.response.model_dump(mode="json") if self.response else None,
            "wind_up": self.wind_up.parameters() if self.wind_up else None,
            "remarks": list(self.remarks),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> MotionTest:
        restored: MotionTest = TypeAdapter(cls).validate_python({**data, "ripples": data["speeds"]})
        return restored


def motion_test_s(axis: AxisConfig) -> float:
    """Returns the maximum duration of the motion test on an ideal axis, s."""
    view = axis_view(axis)
    paths_s = 4.0 * total_duration_s([PathTest()], view)
    return paths_s + (2 + TRIALS) * total_duration_s([EvenSpeed.spread(view)], view)


def motion_test(
    drive: Drive, model: TransmissionModel, callbacks: Callbacks = SILENT, *, measure: bool = True
) -> MotionTest:
    """Runs a booted drive's axis at several speeds and on paths, without and with the model's correction.

    With ``measure`` the response is measured, otherwise the model's own is tested. A filter is kept only if
    neither the ripple at any speed nor the path error is larger than without correction. InputError if no
    motor order of the model is large enough to measure, if the travel is too short, or if a response to be
    tested was measured with a different cycle time. Without an encoder at the load, the ripple is that of the
    load angle predicted from the motor encoder, and no path is run.
    """
    runner = _Runner(drive, model, callbacks)
    if not measure:
        compensation_for(drive.axis, model)  # rejects a response for a different cycle time before any motion
    gains = read_gains(drive.sdo)
    found = _ripple_test(runner, model, measure)
    if found.response is not None and measure:
        found = replace(found, response=found.response.model_copy(update={"gain_objects": gains}))
    elif found.response is not None:
        changed = changed_gains(found.response.gain_objects, gains)
        found = replace(found, remarks=(*found.remarks, *changed))
    if drive.axis.load_encoder.is_motor_encoder:
        return replace(found, remarks=(*found.remarks, NO_LOAD_ENCODER))
    used = [replace(model.only(()), response=None), replace(model, response=None)]
    if found.response is not None:
        used.append(replace(model, response=found.response))
    runs = [runner.run_paths(each) for each in used]
    errors = path_errors(runs, model.ratio, runner.lag_s)
    if measure and found.response is not None and (wind_up := runner.wind_up(runs[-1])) is not None:
        found = replace(found, wind_up=wind_up)
        corrected = runner.run_paths(found.applied(model))
        errors.append(path_errors([runs[0], corrected], model.ratio, runner.lag_s)[1])
    found = replace(found, paths=tuple(PathResult(each[0].name, *each) for each in zip(*errors, strict=True)))
    if found.wind_up is not None and not found.gains_by_wind_up:
        found = replace(found, wind_up=None)
    if measure and found.harms_paths:
        remark = "no filter is kept: with it the path error is larger than without correction"
        return replace(found, response=None, wind_up=None, remarks=(*found.remarks, remark))
    return found


def _ripple_test(runner: _Runner, model: TransmissionModel, measure: bool) -> MotionTest:
    """Runs the constant-speed part of the test."""
    axis = runner.axis
    none = runner.run("without correction", replace(model.only(()), response=None))
    runner.lag_s = following_lag_s(none)
    static_model = replace(model, response=None)
    static = runner.run("correction of rest", static_model)
    if not measure and model.response is None:
        return MotionTest(_ripples(runner, none, static), None)
    if not measure:
        filtered, check = runner.check(model)
        remarks = () if check.remark is None else (check.remark,)
        return MotionTest(_ripples(runner, none, static, filtered, model.response), model.response, remarks)
    limits = Limits.of(axis, model)
    trials = [Trial(static)]
    highest, best = math.inf, MotionTest(_ripples(runner, none, static), None)
    for explore in (True, *[False] * (TRIALS - 1)):
        response = response_of(
            none,
            trials,
            runner.motor_orders,
            model.ratio,
            axis.drive.cycle_s,
            limits,
            highest_hz=highest,
            explore=explore,
        )
        if response is None:
            break
        filtered = runner.run("filtered correction", replace(model, response=response))
        found = MotionTest(_ripples(runner, none, static, filtered, response), response)
        if not explore and found.harms_at:
            # The frequency responsible is unknown, but lies within the filter's range.
            highest = 0.7 * response.known_to_hz
        elif not explore and (best.response is None or found.remaining < best.remaining):
            best = found
        trials.append(Trial(filtered, response.filter))
    if best.response is not None:
        return best
    if len(trials) <= 2:
        return replace(best, remarks=("the response cannot be measured: the ripple is too small",))
    at = ", ".join(f"{speed:g}" for speed in found.harms_at)
    return replace(
        best, remarks=(f"no filter is kept: at {at} deg/s it leaves more ripple than no correction",)
    )


@dataclass(frozen=True, slots=True)
class ServoCheck:
    """Comparison of the motor's response with the stored response."""

    stored_lag_ms: float
    lag_ms: float
    difference: float
    """Rms difference of measured and stored response, relative to the ripple (`Answers.difference`)."""

    @property
    def agrees(self) -> bool:
        """True if neither the following lag nor the response differs significantly."""
        return lags_agree(self.stored_lag_ms, self.lag_ms) and self.difference < DIFFERENT

    @property
    def remark(self) -> str | None:
        """Reason why the stored response is no longer valid; None if it is valid."""
        if self.agrees:
            return None
        return RETUNED.format(self.stored_lag_ms, self.lag_ms, 100.0 * self.difference)


def servo_check(
    drive: Drive, model: TransmissionModel, interrupted: Callable[[], bool] = lambda: False
) -> ServoCheck:
    """Runs a booted drive's axis at a few speeds, and compares the motor's response with the stored response.

    InputError if the model has no response or no motor order.
    """
    if model.response is None:
        raise InputError(f"{model.path}: has no response in motion; measure it: hdbridge motion --propose")
    return _Runner(drive, model, Callbacks(interrupted=interrupted), CHECKED).check(model)[1]


class _Runner:
    """Runs the procedures of the motion test on one axis, each with the correction of a given model."""

    def __init__(
        self,
        drive: Drive,
        model: TransmissionModel,
        callbacks: Callbacks,
        shares: Sequence[float] = SHARES,
    ) -> None:
        axis = self.axis = drive.axis
        self.motor_orders = motor_orders(model)
        self.orders = tuple(each.order for each in self.motor_orders)
        if not self.orders:
            raise InputError(
                f"the model has no motor order of {LEAST_ARCSEC:g} arcsec or more: there is no ripple with "
                "which to measure the response; calibrate the axis first"
            )
        self.lag_s = 0.0
        """Following lag of the axis, s, from the runs without correction."""
        self._model = model
        self.procedure = EvenSpeed.spread(axis_view(axis), shares)
        self._orders_only = TransmissionModel(model.ratio, (Synchronous(orders=tuple(self.motor_orders)),))
        self.ratio = model.ratio
        self._pace = Pace(drive, motion_test_s(axis), callbacks)

    def run(self, name: str, model: TransmissionModel) -> tuple[Harmonics, ...]:
        """Runs the axis at all speeds with this model's correction; returns the harmonics of each run."""
        return self._harmonics(self._pace.run(name, self.procedure, model).outcome)

    def check(self, model: TransmissionModel) -> tuple[tuple[Harmonics, ...], ServoCheck]:
        """Runs the axis at all speeds with a model; compares the motor's response with the model's."""
        stored, runs = model.response, self._pace.run("filtered correction", self.procedure, model).outcome
        assert stored is not None
        answers = Answers(stored, self.motor_orders, self.ratio)
        for run in runs:
            columns = np.array([each[1:5] for each in run.samples]).T
            answers.take(run.speed_deg_s, *columns)
        found = self._harmonics(runs)
        lag_ms = 1000.0 * following_lag_s(found)
        return found, ServoCheck(stored.following_lag_ms, lag_ms, answers.difference)

    def _harmonics(self, runs: tuple[EvenRun, ...]) -> tuple[Harmonics, ...]:
        if self.axis.load_encoder.is_motor_encoder:
            runs = tuple(predicted_run(each, self._orders_only) for each in runs)
        return tuple(harmonics(each, self.orders, self.ratio) for each in runs)

    def wind_up(self, runs: Sequence[PathRun]) -> InertialWindup | None:
        """Fits the wind-up to compensated runs; None if it is insignificant or already in the model."""
        if wind_up_of(self._model) is not None:
            return None
        moves = [each for each in runs if not each.skipped]
        found_s2, spread_s2 = inertia_over_stiffness(moves, self._orders_only, self.lag_s)
        if found_s2 < 2.0 * spread_s2:
            return None
        limit_deg_s2 = self.axis.limits.acceleration_deg_s2 * self.ratio
        return InertialWindup(
            ratio=self.ratio, inertia_over_stiffness_s2=rounded(found_s2, 3), limit_deg_s2=limit_deg_s2
        )

    def run_paths(self, model: TransmissionModel) -> tuple[PathRun, ...]:
        """Runs the paths with this model."""
        return self._pace.run("path error", PathTest(), model).outcome


def wind_up_of(model: TransmissionModel) -> InertialWindup | None:
    """Returns the model's wind-up due to acceleration of the load, or None."""
    return next((each for each in model.effects if isinstance(each, InertialWindup)), None)


def predicted_run(run: EvenRun, model: TransmissionModel) -> EvenRun:
    """Returns the run with the load angle replaced by the prediction from motor encoder and model."""
    motor_deg = np.array([each.motor_position_deg for each in run.samples])
    load_deg = motor_deg / model.ratio + model.predict(Motion(motor_deg)) / ARCSEC_PER_DEG
    samples = zip(run.samples, load_deg.tolist(), strict=True)
    return replace(run, samples=tuple(each._replace(load_position_deg=load) for each, load in samples))


def _ripples(
    runner: _Runner,
    none: tuple[Harmonics, ...],
    static: tuple[Harmonics, ...],
    filtered: tuple[Harmonics, ...] | None = None,
    response: Response | None = None,
) -> tuple[Ripple, ...]:
    ripples: list[Ripple] = []
    variants = [none, static, *([filtered] if filtered else [])]
    for speed in sorted({abs(each.speed_deg_s) for each in none}):
        both = [[run for run in each if abs(run.speed_deg_s) == speed] for each in variants]
        whole = [_rms([run.ripple_arcsec for run in runs]) for runs in both]
        orders = tuple(
            OrderRipple(
                order,
                round(float(order_hz(order, speed, runner.ratio)), 2),
                *(_rms([abs(run.amplitudes[place]) for run in runs]) for runs in both),
            )
            for place, order in enumerate(runner.orders)
        )
        faded = faded_orders(response, runner.orders, speed, runner.ratio) if response else ()
        last = whole[2] if filtered else None
        ripples.append(Ripple(speed, whole[0], whole[1], last, tuple(faded), orders))
    return tuple(ripples)


def faded_orders(
    response: Response, orders: tuple[int, ...], speed_deg_s: float, ratio: float
) -> Iterator[int]:
    """Yields the motor orders that the filter does not correct at this speed."""
    cycle_s = response.cycle_ms / 1000.0
    for order in orders:
        hertz = float(order_hz(order, speed_deg_s, ratio))
        wanted = 1.0 / float(np.interp(hertz, response.frequency_hz, response.gain))
        given = abs(gain(response.filter, np.array([hertz]), cycle_s)[0])
        if hertz > STOP / cycle_s or given < FADED * wanted:
            yield order


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(each**2 for each in values) / len(values))


def _removed(none_arcsec: float, arcsec: float | None) -> float | None:
    return None if arcsec is None else 100.0 * (1.0 - arcsec / none_arcsec)
