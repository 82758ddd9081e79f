"""A recording may have parts of hardly any sample: a task that was interrupted as it began."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hdbridge.diagnose import diagnose
from hdbridge.model import TransmissionModel
from hdbridge.record import Record, concatenate


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_a_part_of_a_few_samples_is_no_obstacle(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel, samples: int
) -> None:
    whole = Record({name: np.asarray(each)[:4000] for name, each in columns({}).items()})
    record = concatenate([whole, whole.rows(0, samples)])
    result = diagnose(record, model, independent_zeros=True)
    assert result.noise_floor_arcsec > 0.0
