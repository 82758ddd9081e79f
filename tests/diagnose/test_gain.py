"""Tests that gains are validated on held-out data, and that findings without a gain are not offered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.gain import Gain, held_out
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.prepared import gather
from hdbridge.analysis.probability import weighed
from hdbridge.axis.effects import Start, Synchronous, VelocityWindup
from hdbridge.axis.effects.orders import orders_from
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.improvement import extension_of
from hdbridge.records.record import Record

Diagnosed = Callable[..., Diagnosis]
WORSE = Gain("stretches of time", 8, np.ones(8), np.full(8, 4.0), np.full(8, 4.1))


@pytest.fixture(scope="module")
def wider(diagnosed: Diagnosed) -> Diagnosis:
    """Returns the diagnosis of a hysteresis loop 1.5 times as wide as in the model."""
    found = diagnosed(width=30.0)
    assert [each.cause for each in found.findings] == ["hysteresis_parameters"]
    return found


def test_a_spurious_change_worsens_held_out_data(
    columns: Callable[..., dict[str, Any]],
) -> None:
    """Orders fitted to pure noise always improve the fit to the same data."""
    record = Record(columns(orders=(), offset=0.0))
    estimator = Estimator(gather(record, 50.0))
    nothing = Synchronous(orders=orders_from(range(3, 24), 0.0))
    fitted = estimator.fit(Hypothesis((nothing,), Start.VIRGIN))
    without = estimator.fit(Hypothesis((), Start.VIRGIN))
    gain = held_out(estimator, without, fitted)
    assert gain is not None
    assert without.chi_square > fitted.chi_square
    assert gain.after_arcsec > gain.before_arcsec


def test_a_changed_loop_is_validated_on_held_out_data(wider: Diagnosis, model: TransmissionModel) -> None:
    (found,) = wider.findings
    assert found.gain is not None
    assert len(found.gain.samples) > 30
    assert wider.extended.rms_arcsec < found.gain.after_arcsec < found.gain.before_arcsec
    assert not found.refusal()
    assert extension_of(wider, model).improves


@pytest.mark.parametrize(
    "effects",
    [
        {"velocity_windup": {"coulomb": 2.0, "viscous": 0.03, "shear": 400.0}},
        {"creep": {"size": 6.0, "tau": 5.0}},
        {"load_order": {"orders": [(2, 8.0, 40.0)]}, "channel_skew": {"ms": 0.7}},
    ],
    ids=" and ".join,
)
def test_a_gain_is_that_of_the_written_model_on_a_fresh_record(
    diagnosed: Diagnosed,
    columns: Callable[..., dict[str, Any]],
    model: TransmissionModel,
    effects: dict[str, Any],
) -> None:
    """Refitting the given model would hide part of the gain."""
    found = diagnosed(effects)
    assert {each.cause for each in found.findings} == set(effects)
    fresh = Record(columns(effects, seed=2))
    after = diagnose(fresh, found.model).baseline.rms_arcsec
    for each in found.findings:
        others = [one for one in found.model.effects if one.name != each.cause and one.name in effects]
        before = diagnose(fresh, replace(model, effects=(*model.effects, *others))).baseline.rms_arcsec
        assert each.gain is not None
        stated = np.sqrt(each.gain.before_arcsec**2 - each.gain.after_arcsec**2)
        assert stated == pytest.approx(np.sqrt(before**2 - after**2), rel=0.1)  # speeds differ by 5 %


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


@pytest.mark.parametrize("gain", [WORSE, None], ids=["worse", "none made"])
def test_a_cause_without_a_gain_is_not_more_likely_than_not(wider: Diagnosis, gain: Gain | None) -> None:
    (found,) = wider.findings
    (known,) = weighed([found], False, wider.scales)
    (unproven,) = weighed([replace(found, gain=gain)], False, wider.scales)
    assert unproven.probability <= 0.5 < known.probability


def test_a_finding_that_cannot_be_written_is_dropped(
    diagnosed: Diagnosed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parameters of the finding are out of bounds after the joint fit of all effects."""
    monkeypatch.setattr(
        VelocityWindup, "tidied", lambda self, _: self.model_copy(update={"shear_deg_s": -1.0})
    )
    result = diagnosed({"velocity_windup": {"coulomb": 1.5, "viscous": 0.03, "shear": 400.0}})
    assert "velocity_windup" not in {each.cause for each in result.findings}
    assert "velocity_windup: it cannot be written into the model" in result.considered
    assert "velocity_windup" not in {each.name for each in result.model.effects}


def test_uncertain_findings_are_not_offered(diagnosed: Diagnosed, model: TransmissionModel) -> None:
    found = diagnosed({"motor_order": {"orders": [(5, 4.0, 30.0)]}})
    finding = found.findings[0]
    unsure = {name: replace(each, low=0.0) for name, each in finding.parameters.items()}
    extension = extension_of(replace(found, findings=(replace(finding, parameters=unsure),)), model)
    assert "zero" in extension.left[0]
    assert not extension.improves
    assert "motor_order" not in {each.name for each in extension.model.effects}


def test_unexplained_findings_have_no_hold_out(diagnosed: Diagnosed) -> None:
    first = diagnosed({"unknown": {"kind": "one_way", "size": 6.0}}).findings[0]
    assert first.cause == "unexplained"
    assert first.gain is None
    data = first.as_dict()
    assert set(data["gain"].values()) == {None}
    assert data["not_offered"]


def test_unnamed_findings_are_not_written(
    diagnosed: Diagnosed, columns: Callable[..., dict[str, Any]]
) -> None:
    """Several flexspline orders of equal size count as one unknown cause, and none is added to the model."""
    orders = {"orders": [(2, 4.0, 30.0), (3, 4.0, 70.0), (5, 4.0, 10.0)]}
    found = diagnosed({"flexspline_order": orders})
    assert [each.cause for each in found.findings] == ["unexplained"]
    assert {each.name for each in found.model.effects} == {"synchronous", "hysteresis"}
    # The reported residual of the extended model is that of the written model.
    again = diagnose(Record(columns({"flexspline_order": orders})), found.model)
    assert found.extended.rms_arcsec == pytest.approx(again.baseline.rms_arcsec, rel=0.01)
