"""A gain is what a hold-out gave; without one there is none, and what does not gain is not offered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.gain import Gain, held_out_change
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.prepared import gather
from hdbridge.axis.effects import Start, Synchronous
from hdbridge.axis.effects.orders import orders_from
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.improvement import extension_of
from hdbridge.records.record import Record

Diagnosed = Callable[..., Diagnosis]
WORSE = Gain("stretches of time", 8, np.ones(8), np.full(8, 4.0), np.full(8, 4.1))


@pytest.fixture(scope="module")
def wider(diagnosed: Diagnosed) -> Diagnosis:
    """A loop half again as wide as the model's."""
    found = diagnosed(width=30.0)
    assert [each.cause for each in found.findings] == ["hysteresis_parameters"]
    return found


def test_a_change_that_is_not_there_loses_on_what_is_held_out(
    columns: Callable[..., dict[str, Any]],
) -> None:
    """Orders of nothing but noise: a fit always gains by them in itself."""
    record = Record(columns(orders=(), offset=0.0))
    estimator = Estimator(gather(record, 50.0))
    nothing = Synchronous(orders=orders_from(range(3, 24), 0.0))
    fitted = estimator.fit(Hypothesis((nothing,), Start.VIRGIN))
    moved = estimator.columns(nothing, Start.VIRGIN) @ fitted.hypothesis.effects[0].coefficients()
    as_given = fitted.residual + estimator.weight * moved
    gain = held_out_change(estimator, fitted, fitted.places(0), moved)
    assert gain is not None
    assert float(as_given @ as_given) > fitted.chi_square
    assert gain.after_arcsec > gain.before_arcsec


def test_a_changed_loop_is_held_out(wider: Diagnosis, model: TransmissionModel) -> None:
    (found,) = wider.findings
    assert found.gain is not None
    assert len(found.gain.samples) > 30
    assert wider.extended.rms_arcsec < found.gain.after_arcsec < found.gain.before_arcsec
    assert not found.refusal()
    assert extension_of(wider, model).improves


@pytest.mark.parametrize("gain", [WORSE, None], ids=["worse", "none made"])
def test_a_change_without_a_gain_is_refused(
    wider: Diagnosis, model: TransmissionModel, gain: Gain | None
) -> None:
    finding = replace(wider.findings[0], gain=gain)
    extension = extension_of(replace(wider, findings=(finding,)), model)
    assert not extension.improves
    assert not extension.carried
    assert "held out" in extension.left[0] or "held-out" in extension.left[0]
    assert "not_offered" in finding.as_dict()


def test_what_may_be_nothing_is_not_offered(diagnosed: Diagnosed, model: TransmissionModel) -> None:
    found = diagnosed({"motor_order": {"orders": [(5, 4.0, 30.0)]}})
    finding = found.findings[0]
    unsure = {name: replace(each, low=0.0) for name, each in finding.parameters.items()}
    extension = extension_of(replace(found, findings=(replace(finding, parameters=unsure),)), model)
    assert "zero" in extension.left[0]
    assert not extension.improves
    assert "motor_order" not in {each.name for each in extension.model.effects}


def test_nothing_is_held_out_of_something_unexplained(diagnosed: Diagnosed) -> None:
    first = diagnosed({"unknown": {"kind": "one_way", "size": 6.0}}).findings[0]
    assert first.cause == "unexplained"
    assert first.gain is None
    data = first.as_dict()
    assert set(data["gain"].values()) == {None}
    assert data["not_offered"]


def test_what_is_not_named_is_not_written(
    diagnosed: Diagnosed, columns: Callable[..., dict[str, Any]]
) -> None:
    """Several near-equal orders of the flexspline are one unknown, and none of them goes into the model."""
    orders = {"orders": [(2, 4.0, 30.0), (3, 4.0, 70.0), (5, 4.0, 10.0)]}
    found = diagnosed({"flexspline_order": orders})
    assert [each.cause for each in found.findings] == ["unexplained"]
    assert {each.name for each in found.model.effects} == {"synchronous", "hysteresis"}
    # What the extended model is said to leave is what it leaves.
    again = diagnose(Record(columns({"flexspline_order": orders})), found.model)
    assert found.extended.rms_arcsec == pytest.approx(again.baseline.rms_arcsec, rel=0.01)
