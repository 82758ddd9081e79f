"""Tests that hidden effects are named, and that a healthy axis yields no finding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from hdbridge.analysis import diagnosis
from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.records.record import Record

Diagnosed = Callable[..., Diagnosis]


def names(diagnosis: Diagnosis) -> list[str]:
    return [each.cause for each in diagnosis.findings]


def test_nothing_is_found_in_a_healthy_axis(diagnosed: Diagnosed) -> None:
    result = diagnosed()
    assert names(result) == []
    assert result.extended.rms_arcsec < result.baseline.rms_arcsec
    assert result.as_dict()["findings"] == []


@pytest.mark.parametrize(
    ("cause", "effect"),
    [
        ("motor_order", {"orders": [(5, 4.0, 30.0)]}),
        ("vibration", {"size": 3.0, "hz": 3.3}),
        ("creep", {"size": 4.0, "tau": 3.0}),
    ],
)
def test_a_finding_improves_held_out_data_and_is_offered(
    diagnosed: Diagnosed, cause: str, effect: dict[str, Any]
) -> None:
    result = diagnosed({cause: effect})
    assert names(result)[:1] == [cause]
    found = result.findings[0]
    assert found.gain.after_arcsec < found.gain.before_arcsec
    assert not found.refusal()
    assert found.probability > 0.7
    assert result.extended.rms_arcsec < 1.5 * diagnosed().extended.rms_arcsec + 0.1


def test_once_per_load_turn_without_a_torque_channel_may_be_gravity(diagnosed: Diagnosed) -> None:
    found = diagnosed({"load_order": {"orders": [(1, 8.0, 30.0)]}}).findings[0]
    assert found.cause == "load_order"
    assert "compliance" in found.aliases
    assert "mass" in found.experiment


def test_motor_encoder_eccentricity_is_an_alias_of_the_first_motor_order(diagnosed: Diagnosed) -> None:
    found = diagnosed({"motor_encoder_eccentricity": {"orders": [(1, 4.0, 100.0)]}}).findings[0]
    assert {found.cause, *found.aliases} == {"motor_encoder_eccentricity", "motor_order"}
    assert "re-clock" in found.experiment


def test_two_effects_at_once(diagnosed: Diagnosed) -> None:
    hidden = {"load_order": {"orders": [(1, 8.0, 30.0)]}, "count_loss": {"size": 5.0, "at": 0.55}}
    assert set(names(diagnosed(hidden))) == set(hidden)


def test_the_extended_model_predicts_the_finding(
    diagnosed: Diagnosed, columns: Callable[..., dict[str, Any]]
) -> None:
    hidden = {"motor_order": {"orders": [(7, 4.0, 60.0)]}}
    extended = diagnosed(hidden).model
    assert [each.name for each in extended.effects][-1] == "motor_order"
    assert extended.uncertainty["motor_order"]
    again = diagnose(Record(columns(hidden, seed=9)), TransmissionModel.from_text(extended.dump()))
    assert again.findings == ()


def test_the_document_follows_its_contract(diagnosed: Diagnosed) -> None:
    data = diagnosed({"motor_order": {"orders": [(5, 4.0, 30.0)]}}).as_dict()
    assert data["schema"] == "hdbridge.diagnosis/1"
    assert set(data["baseline"]) == {"rms_arcsec", "three_sigma_arcsec"} == set(data["extended"])
    finding = data["findings"][0]
    assert {"cause", "probability", "aliases", "parameters", "gain", "experiment"} <= set(finding)
    assert set(finding["gain"]) == {"held_out_rms_before_arcsec", "held_out_rms_after_arcsec"}
    assert {"detectable", "detection_limit_arcsec", "aliases"} <= set(data["identifiability"]["backlash"])
    assert data["identifiability"]["compliance"]["detectable"] is False


def test_too_short_a_record_is_refused(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    few = {name: values[:30] for name, values in columns().items()}
    with pytest.raises(InputError, match="too few"):
        diagnose(Record(few), model)


def test_a_model_needing_a_channel_reports_it(columns: Callable[..., dict[str, Any]]) -> None:
    text = (
        "schema: hdbridge.model/1\nratio: 50\neffects:\n"
        "  - effect: compliance\n    parameters: {c1_arcsec_per_nm: 9, "
        "c2_arcsec_per_nm: 8, c3_arcsec_per_nm: 7, torque1_nm: 5, torque2_nm: 9}\n"
    )
    with pytest.raises(InputError, match="load_torque_nm"):
        diagnose(Record(columns()), TransmissionModel.from_text(text))


def test_the_same_record_gives_the_same_answer(
    diagnosed: Diagnosed, columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    hidden = {"creep": {"size": 4.0, "tau": 3.0}}
    assert diagnose(Record(columns(hidden)), model).as_dict() == diagnosed(hidden).as_dict()


def test_a_short_record_yields_no_confident_wrong_cause(model: TransmissionModel) -> None:
    """One direction, no command, no standstill, coarse counts and noise permit few conclusions."""
    rng = np.random.default_rng(3)
    time = np.arange(150) * 0.02
    motor = np.round(400.0 * time / 0.045) * 0.045
    load = motor / 50 + rng.normal(size=150) * 0.5 / 3600
    bare = Record({"time_s": time, "motor_position_deg": motor, "load_position_deg": load})
    result = diagnose(bare, TransmissionModel(50.0, ()))
    assert not [each for each in result.findings if each.probability > 0.5]
    assert any("reversal" in each for each in result.remarks)


@pytest.mark.parametrize(("counts", "digits"), [(2**14, 9), (8000, 7)])
def test_rounded_digits_yield_no_cause(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel, counts: int, digits: int
) -> None:
    """Without a command, the hysteresis depends on the measured angle, whose count rounding hides."""
    values = columns()
    lag_s = 2e-4  # lag of the plant's motor behind its command
    motor = values["motor_target_deg"]
    motor = motor - lag_s * np.gradient(motor, values["time_s"])
    read = np.round(motor * counts / 360.0) * 360.0 / counts + 36_000.0
    record = {"time_s": values["time_s"], "load_position_deg": values["load_position_deg"]}
    record["motor_position_deg"] = np.array([float(f"{each:.{digits}g}") for each in read.tolist()])
    assert diagnose(Record(record), model).findings == ()


def test_a_diagnosis_uses_one_thread_and_restores_the_caller_s(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that uses the library may have loaded numpy with any number of threads."""

    def threads() -> list[int]:
        return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]

    during: list[int] = []
    with threadpool_limits(2, "blas"):
        before = threads()
        result = diagnose(Record(columns()), model, progress=lambda _: during.extend(threads()))
        monkeypatch.setattr(diagnosis, "capability", lambda *_: during.extend(threads()))
        assert result.identifiability  # computed on request
        assert threads() == before
    assert set(before) == {2}
    assert set(during) == {1}
