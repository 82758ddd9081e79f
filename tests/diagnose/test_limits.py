"""Tests that detection limits agree with the findings, and that only equal motions count as repetitions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.identifiability import VISIBLE
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
