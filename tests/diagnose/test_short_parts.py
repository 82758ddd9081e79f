"""A recording may have parts of hardly any sample: a task that was interrupted as it began."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record, concatenate


def test_a_part_of_one_sample_is_no_obstacle(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    whole = Record({name: np.asarray(each)[:1500] for name, each in columns({}).items()})
    record = concatenate([whole, whole.rows(0, 1)])
    result = diagnose(record, model, independent_zeros=True)
    assert result.noise_floor_arcsec > 0.0
