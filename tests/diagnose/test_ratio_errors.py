"""Tests that a ratio error is named only if the error has the same slope over the whole travel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record


@pytest.fixture
def sloping(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> Callable[[float, float], Diagnosis]:
    """Returns a function that diagnoses a load error that is zero up to a fraction of the travel and then
    rises linearly to a given size, arcsec, at its end.
    """

    def run(begins: float, arcsec: float) -> Diagnosis:
        record = columns()
        angle = record["motor_position_deg"]
        travelled = (angle - np.min(angle)) / np.ptp(angle)
        ramp = np.clip((travelled - begins) / (1.0 - begins), 0.0, 1.0)
        record["load_position_deg"] = record["load_position_deg"] + arcsec * ramp / 3600.0
        return diagnose(Record(record), model)

    return run


def test_a_uniform_slope_is_a_wrong_ratio(sloping: Callable[[float, float], Diagnosis]) -> None:
    assert [each.cause for each in sloping(0.0, 8.0).findings] == ["ratio_error"]


@pytest.mark.parametrize("begins", [0.4, 0.6])
def test_a_slope_on_part_of_the_travel_is_not_a_wrong_ratio(
    sloping: Callable[[float, float], Diagnosis], begins: float
) -> None:
    assert "ratio_error" not in {each.cause for each in sloping(begins, 8.0).findings}
