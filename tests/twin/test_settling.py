"""When a load has settled, whatever the noise of its reading."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hdbridge.twin.compare import band_arcsec, overshoot_arcsec, scatter_s, settling_s

TIME_S = np.arange(250) * 0.004
HZ, DECAY_S = 20.0, 0.15
RINGING = 40.0 * np.exp(-TIME_S / DECAY_S) * np.cos(2.0 * np.pi * HZ * TIME_S)


def test_a_load_that_rings_has_settled_where_it_swings_by_no_more_than_the_band() -> None:
    found = settling_s(TIME_S, RINGING, 0.0, 10.0)
    assert found == pytest.approx(DECAY_S * math.log(40.0 / 10.0), abs=0.025)
    assert settling_s(TIME_S, 0.2 * RINGING, 0.0, 10.0) == 0.0


def test_noise_moves_it_by_as_much_as_is_said_and_no_way_in_particular() -> None:
    noise = 2.0
    band = band_arcsec(noise)
    true = settling_s(TIME_S, RINGING, 0.0, band)
    rng = np.random.default_rng(5)
    off = [
        settling_s(TIME_S, RINGING + noise * rng.standard_normal(250), noise, band) - true for _ in range(60)
    ]
    said = scatter_s(TIME_S, RINGING, 0.0, band, (noise, 0.0))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(said, rel=0.4)
    assert abs(np.mean(off)) < 0.6 * said
    assert scatter_s(TIME_S, RINGING, 0.0, band, (0.0, 0.0)) == 0.0


def test_overshoot_is_in_the_direction_of_the_motion() -> None:
    assert overshoot_arcsec(RINGING, 1.0) == pytest.approx(40.0, abs=0.5)
    assert overshoot_arcsec(RINGING, -1.0) == pytest.approx(40.0 * math.exp(-0.025 / DECAY_S), rel=0.05)
