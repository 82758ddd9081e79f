"""Design-matrix columns of the adaptation: the same on line and over a whole record."""

import numpy as np
import pytest
from support.adapting import MODEL, wandering, work

from hdbridge.axis.effects import CATALOGUE, Moment, Motion, Start
from hdbridge.daemon.following.measuring import DriftColumns, DriftModel
from hdbridge.errors import InputError


@pytest.mark.parametrize("name", [name for name, kind in CATALOGUE.items() if kind.drifting])
def test_drift_columns_depend_on_the_motor_angle_only(name):
    effect = CATALOGUE[name].candidate(50.0)
    assert set(effect.drifting) <= set(type(effect).model_fields)
    assert not effect.needs()
    assert len(effect.coefficients())
    assert effect.is_compensable()


def test_load_encoder_errors_are_not_part_of_the_drift():
    assert not any(CATALOGUE[name].drifting for name in ("load_order", "zero_drift", "count_loss"))


def test_on_line_columns_equal_those_of_a_record():
    drift = DriftModel(MODEL)
    columns = DriftColumns(drift)
    _, samples = work(MODEL, [0.0, *wandering(20, seed=3)])
    motor = samples["motor_target_deg"]
    states = []
    known = []
    for angle in motor.tolist():
        columns.advance(angle, Moment())
        states.append(columns.state)
        known.append(columns.known)
    rows = columns.rows(motor, np.array(states))
    after = known.index(True)
    assert 0 < after < len(motor) // 2
    for start in (Start.FORWARD, Start.BACKWARD):
        for each in drift.terms:
            expected = each.effect.columns(Motion(motor), start)
            assert rows[after:, each.columns] == pytest.approx(expected[after:], abs=1e-9)
    predicted = rows[:, : drift.zero] @ drift.committed
    assert predicted[after:] == pytest.approx(MODEL.predict(Motion(motor), Start.FORWARD)[after:], abs=1e-9)


def test_a_changed_model_differs_by_the_columns():
    drift = DriftModel(MODEL)
    change = np.random.default_rng(1).normal(size=drift.zero)
    motion = Motion(work(MODEL, [0.0, *wandering(10)])[1]["motor_target_deg"])
    columns = np.hstack([each.effect.columns(motion, Start.FORWARD) for each in drift.terms])
    difference = drift.changed(change).predict(motion, Start.FORWARD)
    difference -= MODEL.predict(motion, Start.FORWARD)
    assert difference == pytest.approx(columns @ change, abs=1e-9)


def test_only_requested_parameters_are_followed():
    assert [each.effect.name for each in DriftModel(MODEL, ["hysteresis.offset_arcsec"]).terms] == [
        "hysteresis"
    ]
    with pytest.raises(InputError, match=r"did you mean 'hysteresis.offset_arcsec'\?"):
        DriftModel(MODEL, ["hysteresis.ofset_arcsec"])
    with pytest.raises(InputError, match=r"not a parameter that wear or temperature changes"):
        DriftModel(MODEL, ["hysteresis.width_deg"])
