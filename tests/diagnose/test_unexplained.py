"""Tests of causes outside the catalogue: smallest size that is reported, and exclusions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.hypothesis import Estimator
from hdbridge.analysis.prepared import gather
from hdbridge.axis.effects import FloatArray, Hysteresis, Motion, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

LOOPS = {"hysteresis_parameters", "hysteresis_memory"}


def test_local_unknown_effects_are_unexplained(diagnosed: Callable[..., Diagnosis]) -> None:
    """The residual is below 0.5 arcsec rms, whereas a cause needs a peak of at least 0.5 arcsec."""
    (found,) = diagnosed({"unknown": {"kind": "packet", "size": 5.0, "width": 8.0}}).findings
    assert found.cause == "unexplained"
    assert found.left_arcsec < 0.5 < found.peak_arcsec < 6.0
    assert found.lives_in in {"load angle", "position"}


def test_effects_below_a_motor_count_are_remarks(diagnosed: Callable[..., Diagnosis]) -> None:
    """A motor count is 3.2 arcsec at the load; smaller effects cannot be corrected."""
    result = diagnosed({"unknown": {"kind": "packet", "size": 2.8, "width": 12.0}})
    assert not result.findings
    (remark,) = [each for each in result.remarks if "beyond the noise" in each]
    assert "motor count" in remark


@pytest.mark.parametrize("law", ["dahl", "bouc_wen"])
def test_residuals_of_another_law_at_reversals_belong_to_the_loop(
    diagnosed: Callable[..., Diagnosis], law: str
) -> None:
    """The residual is 1 arcsec rms, but vanishes once the motor has moved by the width of the loop."""
    (found,) = diagnosed(law=law, rate_hz=16.0).findings
    # With samples at 16 Hz, the errors at turning points are as large as the residual.
    assert found.cause in LOOPS | ({"unexplained"} if law == "bouc_wen" else set())


def test_direction_effects_far_from_reversals_are_not_a_changed_loop(
    diagnosed: Callable[..., Diagnosis],
) -> None:
    """The motion carries a ring along for more than one motor turn before the ring slips."""
    (found,) = diagnosed({"unknown": {"kind": "ring", "size": 5.0, "travel": 400.0}}).findings
    assert found.cause == "unexplained"


LOOP = Hysteresis(offset_arcsec=28.0, width_deg=10.0, exponent=2.2)
TIME_S = np.arange(60_000) / 1000.0


def to_and_fro(motor: FloatArray, every: int, load_count_arcsec: float) -> Record:
    """Returns a record of a healthy axis with this load resolution; keeps one sample in ``every``."""
    rng, step = np.random.default_rng(5), load_count_arcsec / 3600.0
    load = (
        motor / 100.0 + LOOP.predict(Motion(motor)) / 3600.0 + 0.05 * rng.standard_normal(len(motor)) / 3600.0
    )
    columns = {
        "time_s": TIME_S,
        "motor_position_deg": motor,
        "load_position_deg": step * np.round(load / step),
    }
    return Record({name: values[::every] for name, values in columns.items()})


def test_a_move_that_repeats_repeats_the_rounding_of_its_load_encoder() -> None:
    record = to_and_fro(300.0 * np.sin(0.5 * np.pi * TIME_S), 4, 5.0)
    assert not diagnose(record, TransmissionModel(100.0, (LOOP,))).findings


def test_a_turn_between_two_samples_may_lie_before_the_outermost() -> None:
    motor = 900.0 * np.sin(2.0 * np.pi * TIME_S / (2.7 + 0.01 * TIME_S))
    estimator = Estimator(gather(to_and_fro(motor, 76, 0.01), 100.0))
    turns, unknown = estimator.turned([LOOP], Start.VIRGIN)
    missed = LOOP.predict(Motion(motor))[::76] - LOOP.predict(Motion(motor[::76].copy()))
    assert np.max(np.abs(missed[turns])) > 10.0
    assert np.all(np.abs(missed[turns]) < 1.5 * np.abs(unknown[turns]) + 0.5)
