"""Tests of records with a very short part, and of the influence of the motion before a record begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.effects import USUAL_LOOP, Motion, Start, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording, Segment
from hdbridge.units import ARCSEC_PER_DEG


def test_a_part_of_one_sample_is_accepted(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    whole = Record({name: np.asarray(each)[:1500] for name, each in columns({}).items()})
    record = concatenate([whole, whole.rows(0, 1)])
    result = diagnose(record, model, independent_zeros=True)
    assert result.noise_floor_arcsec > 0.0


def test_a_part_that_ends_in_its_fast_move_is_accepted(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    """Samples of fast moves are not used, and a run interrupted in its first move has no other samples."""
    parts = [
        Record({name: np.asarray(each)[rows] for name, each in columns({}).items()})
        for rows in (slice(0, 1500), slice(1500, 1520))
    ]
    record = concatenate(parts)
    fast = Segment(kind="move", start_s=record.time_s[1500], end_s=record.time_s[-1])
    found, whole = (
        diagnose(each, model, independent_zeros=True) for each in (Recording(record, (fast,)), parts[0])
    )
    assert [each.cause for each in found.findings] == [each.cause for each in whole.findings]
    assert found.noise_floor_arcsec == pytest.approx(whole.noise_floor_arcsec, rel=0.05)


@pytest.mark.parametrize("back_deg", [3.0, 1.5])
def test_the_motion_before_a_record_is_not_a_cause(back_deg: float) -> None:
    effects = (Synchronous(orders=[{"order": 2, "amplitude_arcsec": 14.0, "phase_deg": 20.0}]), USUAL_LOOP)
    time_s = 0.016 * np.arange(3000)
    turns_s, speeds_deg_s = (0.5, 1.5, 12.0, 12.8, 30.0, 30.8), (0.0, -600.0, -600.0, 600.0, 600.0, -600.0)
    motor = 0.016 * np.cumsum(np.interp(time_s, turns_s, speeds_deg_s))
    angle = np.append((90.0 - back_deg, -back_deg), motor)
    error = sum(each.predict(Motion(angle), Start.VIRGIN) for each in effects)[2:]
    error += np.random.default_rng(7).normal(0.0, 0.3, len(error))
    columns = {"time_s": time_s, "motor_position_deg": motor, "motor_target_deg": motor}
    record = Record({**columns, "load_position_deg": motor / 50.0 + error / ARCSEC_PER_DEG})
    assert not diagnose(record, TransmissionModel(50.0, effects)).findings
