"""Tests that a changed compliance is found, or reported with its aliases."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.springs import with_spring

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

Columns = Callable[..., dict[str, Any]]
KNOWN, NOW = 1.5, 2.4
"""Compliance in the model, and true compliance, arcsec/Nm."""


@pytest.fixture
def known(model: TransmissionModel) -> TransmissionModel:
    """Returns the model with a linear compliance."""
    return with_spring(model, KNOWN)


def spring_of(model: TransmissionModel) -> float:
    (spring,) = (each for each in model.effects if each.name == "compliance")
    return float(spring.parameters()["c1_arcsec_per_nm"])


def test_a_changed_spring_is_found_and_written_to_the_model(
    columns: Columns, known: TransmissionModel
) -> None:
    """The load torque is uncorrelated with all other coordinates."""
    record = columns()
    torque_nm = 6.0 * np.sin(2.0 * np.pi * record["time_s"] / 37.0)
    record["load_torque_nm"] = torque_nm + 0.01 * np.random.default_rng(1).normal(size=len(torque_nm))
    record["load_position_deg"] = record["load_position_deg"] + NOW * torque_nm / 3600.0
    result = diagnose(Record(record), known)
    (found,) = result.findings
    assert (found.cause, found.aliases) == ("compliance", ())
    size = found.parameters["c1_arcsec_per_nm"]
    assert size.low < NOW < size.high
    assert spring_of(result.model) == pytest.approx(NOW, rel=0.02)
    assert not found.refusal()


def test_a_change_explained_by_eccentricity_is_not_reported(
    columns: Columns, known: TransmissionModel
) -> None:
    """The torque of an eccentric mass repeats once per load turn, like run-out of the load encoder."""
    record = columns({"compliance": {"c1": NOW, "c2": NOW, "t1": 1e3}}, torque_nm=9.0)
    result = diagnose(Record(record), known)
    assert len(result.findings) == 1
    names = {result.findings[0].cause, *result.findings[0].aliases}
    assert {"compliance", "load_order"} <= names
    assert spring_of(result.model) == pytest.approx(KNOWN, rel=0.1)
    size = result.findings[0].parameters["c1_arcsec_per_nm"]
    assert size.low < KNOWN < NOW < size.high


def test_a_spring_within_its_calibration_is_not_reported(columns: Columns, known: TransmissionModel) -> None:
    spring = {"c1": 1.03 * KNOWN, "c2": 1.03 * KNOWN, "t1": 1e3}
    result = diagnose(Record(columns({"compliance": spring}, torque_nm=6.0)), known)
    assert not result.findings
