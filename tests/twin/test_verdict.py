"""Judgement: a twin is better than the simulation before it, or not."""

from __future__ import annotations

import pytest

from hdbridge.twin.compare import ALL, Comparison, Row
from hdbridge.twin.twin import HELD_OUT, better

UNITS = {"load_error": "arcsec", "following_error": "motor deg", "motor_torque": "Nm", "temperature": "K"}


def comparison(kind: str = HELD_OUT, **differences: float) -> Comparison:
    rows = [Row(name, kind, UNITS[name], 10.0, 10.0, value, 0.1, 100) for name, value in differences.items()]
    return Comparison(tuple(rows), {}, {})


def test_smaller_differences_on_held_out_legs_are_better() -> None:
    gain = better(comparison(load_error=4.0, motor_torque=1.0), comparison(load_error=1.0, motor_torque=1.0))
    assert gain.better
    assert "50 % smaller" in gain.text
    assert "has not seen" in gain.text


@pytest.mark.parametrize(
    ("now", "says"),
    [
        ({"load_error": 1.0, "motor_torque": 1.2}, "motor torque differs by 1.2 Nm, before by 1"),
        ({"load_error": 4.0, "motor_torque": 1.0}, "no nearer"),
    ],
)
def test_what_is_worse_or_no_nearer_is_not_kept(now: dict[str, float], says: str) -> None:
    gain = better(comparison(load_error=4.0, motor_torque=1.0), comparison(**now))
    assert not gain.better
    assert says in gain.text


def test_below_the_noise_nothing_is_lost() -> None:
    before, after = (
        comparison(load_error=4.0, motor_torque=0.02),
        comparison(load_error=1.0, motor_torque=0.04),
    )
    assert better(before, after).better


def test_below_what_counts_as_noise_there_may_be_much_to_gain() -> None:
    """Rounding, and what a reversal leaves in third differences: a replay of the true axis has both."""
    gain = better(comparison(motor_torque=0.08), comparison(motor_torque=0.02))
    assert gain.better
    assert "75 % smaller" in gain.text


def test_a_temperature_counts_beyond_the_step_of_its_reading() -> None:
    """Share for 0.1 K."""
    cold, near = comparison(load_error=4.0, temperature=0.05), comparison(load_error=1.0, temperature=0.09)
    assert "75 % smaller" in better(cold, near).text
    far = comparison(load_error=1.0, temperature=0.4)
    assert "temperature differs by 0.4 K, before by 0.05" in better(cold, far).text
    # Each a quarter: of the temperature 0.4 to 0.1, for what is within a step is none.
    assert "75 % smaller" in better(comparison(load_error=4.0, temperature=0.4), near).text


def test_without_held_out_legs_all_of_them_count_and_it_is_said() -> None:
    gain = better(comparison(ALL, load_error=4.0), comparison(ALL, load_error=1.0))
    assert gain.better
    assert "that it was fitted to" in gain.text
