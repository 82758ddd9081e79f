"""Offset of the hysteresis, fitted to the rests of a stepping test."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.exercised import booted
from support.raised import ARTICLE

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Effect, Hysteresis, InertialWindup, Motion, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.validation import Floor, Validation, at_rest, validate
from hdbridge.control.bench import Run
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

RATIO, STEPS, SAMPLES = 50.0, 10, 20
ORDERS = Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=9.0, phase_deg=20.0),))


def model(offset_arcsec: float) -> TransmissionModel:
    loop = Hysteresis(offset_arcsec=offset_arcsec, width_deg=20.0, exponent=1.6)
    return TransmissionModel(RATIO, (ORDERS, loop))


def stepped(truth: TransmissionModel, zero_arcsec: float) -> Run[SteppingOutcome]:
    """Steps forward and back, each a move and a rest of `SAMPLES`, on an axis that is exactly ``truth``."""
    stops = 43.56 * np.array([-3, *range(STEPS + 1), *range(STEPS - 1, -1, -1)])
    motor_deg = np.concatenate(
        [[*np.linspace(*each, SAMPLES), *[each[1]] * SAMPLES] for each in pairwise(stops)]
    )
    error = truth.predict(Motion(motor_deg)) + zero_arcsec
    time_s = 0.004 * np.arange(len(motor_deg))
    load_deg = motor_deg / RATIO + error / 3600.0
    columns = {"time_s": time_s, "motor_position_deg": motor_deg, "load_position_deg": load_deg}
    ends = range(4 * SAMPLES - 1, len(motor_deg), 2 * SAMPLES)
    settles = tuple(Segment(kind="settle", start_s=time_s[at - 1], end_s=time_s[at]) for at in ends)
    stands = tuple(Standing(motor_deg[at] / RATIO, error[at], 0.1) for at in ends)
    return Run(Record(columns), settles, outcome=SteppingOutcome(stands[:STEPS], stands[STEPS:]))


@pytest.mark.parametrize("fitted", [41.2, 25.0, -10.0])
@pytest.mark.parametrize("truth", [40.0, -35.0])
def test_the_offset_is_that_of_the_rests(truth: float, fitted: float) -> None:
    orders, loop = at_rest(model(fitted), stepped(model(truth), zero_arcsec=7.0)).effects
    assert orders == ORDERS
    assert loop.offset_arcsec == pytest.approx(truth, abs=1e-6)


PLAN = """
schema: hdbridge.plan/1
name: steps
procedures: [{procedure: standstill, duration_s: 1}]
validation: {count: 20, step_deg: 43.56}
"""


def validated(folder: Path, load_kg_m2: float, stiffness: float, servo: dict, *more: Effect) -> Validation:
    """Validates the exact model, and more effects, on the article's gear with a different load and servo."""
    truth = yaml.safe_load((ARTICLE / "truth.yaml").read_text(encoding="utf-8"))
    truth["gear"] |= {"stiffness_nm_per_rad": stiffness, "damping_nm_s_per_rad": 15.0}
    truth["load"]["inertia_kg_m2"] = load_kg_m2
    truth["servo"] = {key: value for key, value in (truth["servo"] | servo).items() if value is not None}
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth), encoding="utf-8")
    (folder / "plan.yaml").write_text(PLAN, encoding="utf-8")
    axis, gear = AxisConfig.load(ARTICLE), TransmissionModel.load(ARTICLE / "model.yaml")
    model = replace(gear, effects=(*gear.effects, *more))
    with booted(axis, folder / "truth.yaml") as (drive, _):
        plan = Plan.load(str(folder / "plan.yaml"))
        return validate(drive, plan, None, model, Floor(2.8, 0.4), folder)[0]


def test_the_offset_is_that_of_the_arrival_with_the_new_model(tmp_path: Path) -> None:
    """A servo without feed-forward overshoots by less if the wind-up is compensated."""
    servo = {"inertia_feedforward_kg_m2": 0.0, "command_filter_ms": 0.2, "load_feedforward": None}
    wind_up = InertialWindup(ratio=RATIO, inertia_over_stiffness_s2=1.09e-4)
    found = validated(tmp_path, 0.468, 4310.0, servo, wind_up)
    assert abs(found.after.cw.mean_arcsec - found.after.ccw.mean_arcsec) < 1.0


def test_a_servo_that_hunts_at_rest_is_reported(tmp_path: Path) -> None:
    servo = {
        "position_gain_per_s": 110.0,
        "velocity_gain_nm_s_per_rad": 0.0192,
        "dead_time_ms": 1.5,
        "load_feedforward": {"inertia_kg_m2": 2.2e-4, "frequency_hz": 23.7, "damping_ratio": 0.2},
    }
    found = validated(tmp_path, 0.55, 12233.0, servo)
    assert [each for each in found.fault_notes if "hunts" in each]
