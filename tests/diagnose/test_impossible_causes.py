"""Tests that physically impossible or inseparable causes are not named, however well they fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.ideal_record import RATE_HZ, ideal_record

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.identifiability import examined
from hdbridge.axis.effects import Motion
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.effects.ratio_error import RatioError
from hdbridge.axis.effects.subdivisional_error import SubdivisionalError
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

RATIO = 50.0
MODEL = TransmissionModel(
    RATIO,
    (
        Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=20.0, phase_deg=30.0),)),
        Hysteresis(offset_arcsec=30.0, width_deg=15.0, exponent=1.6),
    ),
)


def sweeps(error_arcsec: Callable[[Any], Any], *legs: tuple[float, float]) -> Record:
    """Returns a record of sweeps (load turns, motor turns per second) with an error over the load angle."""
    angles, at = [], 0.0
    for turns, motor_turns_s in legs:
        count = round(abs(turns) * RATIO / motor_turns_s * RATE_HZ)
        angles.append(np.linspace(at, at + turns, count, endpoint=False))
        at += turns
    motor = 360.0 * RATIO * np.concatenate(angles)
    return ideal_record(MODEL, motor, error_arcsec(motor / RATIO))


def judged(ratio: float, true_ratio: float, load_turns: float) -> str:
    """Returns the reason why the error of a model's ratio is implausible; empty if it is plausible."""
    ramp = 360.0 * 3600.0 * (1.0 / true_ratio - 1.0 / ratio)
    motion = Motion(np.array([0.0, 360.0 * ratio * load_turns]))
    seen: Any = SimpleNamespace(motion=motion, ratio=ratio)
    return RatioError(ramp_arcsec_per_turn=ramp).implausible(seen)


@given(st.integers(60, 400), st.integers(60, 400), st.floats(0.01, 3.0))
def test_any_whole_tooth_number_may_be_the_true_one(teeth: int, true_teeth: int, turns: float) -> None:
    assert not judged(teeth / 2.0, true_teeth / 2.0, turns)


@given(st.integers(60, 400), st.floats(0.05, 0.45), st.integers(-20, 20))
def test_fractional_teeth_are_not_a_ratio_error_on_an_arc(teeth: int, part: float, more: int) -> None:
    true_ratio = (teeth + more + part) / 2.0
    if abs(true_ratio * 2.0 / teeth - 1.0) > 1.1e-3:
        assert "no teeth have the ratio" in judged(teeth / 2.0, true_ratio, 0.9)
        assert not judged(teeth / 2.0, true_ratio, 1.1)


@given(st.integers(60, 400), st.floats(-9e-4, 9e-4), st.floats(0.01, 3.0))
def test_the_scale_of_an_encoder_may_be_a_little_wrong(teeth: int, share: float, turns: float) -> None:
    assert not judged(teeth / 2.0, (1.0 + share) * teeth / 2.0, turns)


def test_a_load_order_on_an_arc_keeps_its_ratio_alias() -> None:
    there = [(0.1, 2.0), (-0.1, 2.0)] * 3
    (found,) = diagnose(sweeps(lambda load: 20.0 * np.cos(np.radians(load) + 1.0), *there), MODEL).findings
    assert "load_order" in {found.cause, *found.aliases}


def test_at_one_speed_one_way_a_load_order_may_be_a_vibration() -> None:
    record = sweeps(lambda load: 8.0 * np.cos(np.radians(3.0 * load) + 1.0), (1.2, 6.7))
    (found,) = diagnose(record, MODEL).findings
    assert {found.cause, *found.aliases} >= {"load_order", "vibration"}


@pytest.mark.parametrize(
    ("legs", "alike"),
    [
        ([(1.2, 5.0)], True),
        ([(-1.2, 2.0)], True),
        ([(1.2, 2.0), (1.2, 5.0)], False),
        ([(1.2, 5.0), (-1.2, 5.0)], False),
    ],
    ids=["one speed", "backward", "two speeds", "there and back"],
)
def test_two_speeds_separate_place_from_time(legs: list[tuple[float, float]], alike: bool) -> None:
    found, _ = examined(sweeps(lambda load: 0.0 * load, *legs), MODEL)
    assert ("vibration" in found["load_order"].aliases) is alike
    assert ("load_order" in found["vibration"].aliases) is alike


@pytest.mark.parametrize(
    ("legs", "resolved"),
    [([(0.2, 4.0)], False), ([(0.2, 4.0), (-0.2, 4.0)], False), ([(0.2, 4.0), (-0.2, 1.55)], True)],
    ids=["one way", "there and back", "two speeds"],
)
def test_equal_steps_over_many_lines_do_not_show_line_errors(
    legs: list[tuple[float, float]], resolved: bool
) -> None:
    """At 4 motor turns per second, the load passes 7.2 of its encoder's 1800 lines between two samples."""
    lines = SubdivisionalError(
        lines_per_turn=1800, orders=(MotorOrder(order=1, amplitude_arcsec=3.0, phase_deg=0.0),)
    )
    record = sweeps(lambda load: 0.0 * load, *legs)
    speed = np.gradient(record.motor_position_deg, record.time_s)
    seen: Any = SimpleNamespace(
        motion=Motion(record.motor_position_deg, record.time_s, motor_speed_deg_s=speed),
        ratio=RATIO,
        period_s=1.0 / RATE_HZ,
    )
    assert (not lines.unidentifiable(seen)) is resolved


def test_two_vibrations_do_not_cancel(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    """A tone whose amplitude passes through zero is the limit of two large tones with opposite signs."""
    record = columns()
    time_s = record["time_s"]
    tone = 4.0 * np.sin(math.tau * 3.13 * time_s) * (2.0 * time_s / time_s[-1] - 1.0)
    record["load_position_deg"] = record["load_position_deg"] + tone / 3600.0
    assert all(each.peak_arcsec < 5.0 for each in diagnose(Record(record), model).findings)
