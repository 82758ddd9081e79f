"""Record of an axis that follows its command exactly, with an error in addition to that of its model."""

from __future__ import annotations

from typing import Any

import numpy as np

from hdbridge.axis.effects import Motion, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

RATE_HZ = 20.0
NOISE_ARCSEC = 0.5


def ideal_record(model: TransmissionModel, motor_deg: Any, error_arcsec: Any, **channels: Any) -> Record:
    """Returns the record of ``motor_deg`` (n,), sampled at `RATE_HZ`, with white noise of `NOISE_ARCSEC`."""
    time = np.arange(len(motor_deg)) / RATE_HZ
    noise = NOISE_ARCSEC * np.random.default_rng(5).standard_normal(len(motor_deg))
    error = model.predict(Motion(motor_deg, time), Start.FORWARD) + error_arcsec + noise
    columns = {
        "time_s": time,
        "motor_position_deg": motor_deg,
        "load_position_deg": motor_deg / model.ratio + error / 3600.0,
        "motor_target_deg": motor_deg,
    }
    return Record(columns | channels)
