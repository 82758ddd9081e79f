"""What a motor may do within one count of a coarse encoder is allowed for at rest."""

from __future__ import annotations

import numpy as np
import pytest

from hdbridge.diagnose.unseen import hunting_arcsec
from hdbridge.effects import FloatArray, Hysteresis, Motion

LAW = Hysteresis(offset_arcsec=40.0, width_deg=20.0, exponent=1.6)


def allowed(count_deg: float) -> tuple[FloatArray, FloatArray]:
    """What is allowed for on the way and in the rest after it."""
    way, rest = np.linspace(0.0, 100.0, 201), np.full(50, 100.0)
    speed = np.concatenate([np.full(201, 10.0), np.zeros(50)])
    motion = Motion(np.concatenate([way, rest]), motor_speed_deg_s=speed)
    noise = hunting_arcsec(motion, count_deg, LAW.predict)
    return noise[:201], noise[201:]


def test_half_of_what_half_a_count_back_would_do_is_allowed_for_at_rest() -> None:
    moving, resting = allowed(0.05)
    back = Motion(np.array([0.0, 100.0, 100.0 - 0.025]))
    assert resting == pytest.approx(0.5 * np.abs(np.diff(LAW.predict(back))[-1]), rel=1e-9)
    assert not moving.any()


@pytest.mark.parametrize("count_deg", [0.0, 1e-5])
def test_a_fine_encoder_sees_what_its_motor_does(count_deg: float) -> None:
    assert np.all(allowed(count_deg)[1] < 0.03)
