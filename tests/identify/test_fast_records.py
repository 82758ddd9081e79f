"""Tests with fast sweeps without segment information: undetermined terms are left out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.legs import Leg, fit

from hdbridge.errors import InputError


def sweep(begin, end, speed, acceleration, rate_hz):
    """Returns a move with a trapezoidal speed profile, without its first point, motor degrees."""
    way = abs(end - begin)
    speed = min(speed, np.sqrt(way * acceleration))
    rise, total = speed / acceleration, way / speed + speed / acceleration
    time = np.minimum(np.arange(1, int(np.ceil(total * rate_hz)) + 1) / rate_hz, total)
    moved = np.select(
        [time < rise, time < total - rise],
        [0.5 * acceleration * time**2, speed * (time - 0.5 * rise)],
        way - 0.5 * acceleration * (total - time) ** 2,
    )
    return begin + np.sign(end - begin) * moved


def record(bench, speed, acceleration, turns, laps, measured):
    """Records sweeps in both directions as one segment without a kind; motor degrees and seconds."""
    axis = bench.axis()
    end = 360.0 * turns
    legs = [sweep(*ends, speed, acceleration, bench.rate_hz) for ends in [(0.0, end), (end, 0.0)] * laps]
    whole = axis.record([("unknown", np.concatenate([[0.0], *legs]))])[0]
    return Leg(whole.time_s, whole.motor_deg, whole.load_deg, commanded=not measured)


@settings(deadline=None, max_examples=5, derandomize=True)
@given(
    speed=st.floats(300.0, 2000.0),
    acceleration=st.sampled_from([200.0, 700.0, 900.0, 4000.0]),
    turns=st.floats(1.5, 12.0),
    laps=st.integers(1, 3),
    measured=st.booleans(),
)
def test_no_hysteresis_is_larger_than_what_was_seen(bench, speed, acceleration, turns, laps, measured):
    seen = record(bench, speed, acceleration, turns, laps, measured)
    error = (seen.load_deg - seen.motor_deg / 20.0) * 3600.0
    try:
        result = fit([seen], 20.0, bench.options)
    except InputError as refusal:
        assert "slow" in str(refusal)  # noqa: PT017 - a refusal is as good as a cautious answer
        return
    names = [each.name for each in result.model.effects]
    if "hysteresis" in names:
        assert result.interval("hysteresis", "offset_arcsec").value <= np.ptp(error)
    else:
        assert any(each.startswith("hysteresis: left out") for each in result.warnings)


def test_fast_sweeps_still_determine_orders_and_offset(bench):
    result = fit([record(bench, 600.3, 4000.0, 12.0, 2, False)], 20.0, bench.options)
    found = {each.order.number: each.amplitude_arcsec for each in result.orders}
    assert found == pytest.approx({1: 5.0, 2: 9.0, 6: 3.0}, abs=0.3)
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.03)
    assert not result.interval("hysteresis", "exponent").identifiable
