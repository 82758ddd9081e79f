"""Unwrapping a counter of any width along any path."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.cia301 import wrap_int32
from hdbridge.drive.unwrap import Unwrap

HALF = 2**31


@given(start=st.integers(-HALF, HALF - 1), moves=st.lists(st.integers(-HALF, HALF - 1), max_size=30))
def test_any_path_of_moves_below_half_the_range_is_followed(start: int, moves: list[int]) -> None:
    unwrap = Unwrap()
    position = unwrap.update(start)
    assert position == start
    for move in moves:
        position += move
        assert unwrap.update(wrap_int32(position)) == position


@given(st.integers())
def test_wrapping_stays_in_int32_and_is_modular(value: int) -> None:
    assert -HALF <= wrap_int32(value) < HALF
    assert (wrap_int32(value) - value) % 2**32 == 0


def test_reset_starts_at_the_given_position() -> None:
    unwrap = Unwrap()
    unwrap.update(5)
    unwrap.reset()
    assert unwrap.update(7) == 7
    unwrap.reset(2**40)
    assert unwrap.update(3) == 2**40 + 3
    with pytest.raises(ValueError, match="at least 2"):
        Unwrap(1)
