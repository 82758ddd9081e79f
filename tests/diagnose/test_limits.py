"""Tests that detection limits agree with the findings, and that only equal motions count as repetitions."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.identifiability import VISIBLE
from hdbridge.axis.effects import Hysteresis, Motion
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

Diagnosed = Callable[..., Diagnosis]


@pytest.mark.parametrize(
    ("cause", "of_peak"),
    [
        ("backlash", lambda peak: {"gap": 2.0 * peak}),
        ("creep", lambda peak: {"size": peak, "tau": 5.0}),
    ],
)
def test_a_cause_is_named_above_its_detection_limit_and_not_below(
    diagnosed: Diagnosed, cause: str, of_peak: Callable[[float], dict[str, Any]]
) -> None:
    """The limit is that of an instance less visible than this one, so only a far smaller one is not named."""
    limit = diagnosed().identifiability[cause].detection_limit_arcsec
    assert limit is not None
    below, above = (diagnosed({cause: of_peak(times * limit)}).findings for times in (0.7 * VISIBLE, 1.0))
    assert not below
    assert [each.cause for each in above] == [cause]


def test_a_cause_that_is_found_hides_no_other(diagnosed: Diagnosed) -> None:
    found = diagnosed({"load_order": {"orders": [(2, 20.0, 40.0)]}})
    assert [each.cause for each in found.findings] == ["load_order"]
    limits, healthy = (
        {cause: each.detection_limit_arcsec for cause, each in one.identifiability.items() if each.detectable}
        for one in (found, diagnosed())
    )
    assert limits == pytest.approx(healthy, rel=0.3)


def test_recordings_of_different_motion_do_not_repeat_each_other(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    """Only one of the recordings shows the loop's return-point memory."""
    whole = columns(law="memory")
    ends = np.searchsorted(whole["time_s"], [0.0, 9.0, 30.0, 1e9])
    parts = [Record({name: each[a:b] for name, each in whole.items()}) for a, b in pairwise(ends)]
    (found,) = diagnose(parts, model).findings
    assert found.cause == "hysteresis_memory"
    assert found.probability > 0.8


LOOP = Hysteresis(offset_arcsec=28.0, width_deg=10.0, exponent=1.8)
RESOLUTIONS = {
    "ratio": st.sampled_from([30, 50, 80, 100, 160]),
    "motor_counts": st.sampled_from([4096, 8000, 16_384, 2**17, 2**20]),
    "load_counts": st.sampled_from([2**18, 2**20, 1_440_000, 2**23]),
}


def run_out(ratio: int, motor_counts: int, load_counts: int, peak: float) -> tuple[Diagnosis, float]:
    """Diagnoses a swinging axis with a load order; its peak is in units of the smallest that matters.

    That is half a count of both encoders, or 0.5 arcsec. Returns it as well, in arcsec.
    """
    motor_step, load_step = 360.0 / motor_counts, 360.0 / load_counts
    floor_arcsec = max(0.5 * 3600.0 * math.hypot(motor_step / ratio, load_step), 0.5)
    time_s = np.arange(1500) / 25.0
    load_deg = 400.0 * np.sin(time_s / 7.0)
    error = LOOP.predict(Motion(ratio * load_deg)) + peak * floor_arcsec * np.cos(np.radians(2.0 * load_deg))
    error += 0.05 * np.random.default_rng(1).standard_normal(len(time_s))
    columns = {
        "time_s": time_s,
        "motor_position_deg": motor_step * np.round(ratio * load_deg / motor_step),
        "load_position_deg": load_step * np.round((load_deg + error / 3600.0) / load_step),
    }
    return diagnose(Record(columns), TransmissionModel(float(ratio), (LOOP,))), floor_arcsec


@settings(max_examples=8)
@given(**RESOLUTIONS, share=st.sampled_from([0.7, 0.9]))
def test_an_effect_within_the_rounding_of_the_encoders_is_not_a_finding(
    ratio: int, motor_counts: int, load_counts: int, share: float
) -> None:
    found, _ = run_out(ratio, motor_counts, load_counts, share)
    assert not found.findings


@settings(max_examples=4)
@given(**RESOLUTIONS)
def test_what_exceeds_the_rounding_is_named_and_no_limit_is_below_it(
    ratio: int, motor_counts: int, load_counts: int
) -> None:
    found, floor_arcsec = run_out(ratio, motor_counts, load_counts, 1.5)
    assert [each.cause for each in found.findings] == ["load_order"]
    limits = [each.detection_limit_arcsec for each in found.identifiability.values()]
    assert all(each > 0.99 * floor_arcsec for each in limits if each is not None)
