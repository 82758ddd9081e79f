"""Numbers for readers: only significant digits, and no small number shown as zero."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.units import figure, with_interval


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (10609.744, "10610"),
        (123456.7, "123500"),
        (3.3727e-5, "3.373e-05"),
        (0.00024, "0.00024"),
        (-161.4978, "-161.5"),
        (8000.0, "8000"),
        (2e7, "2e+07"),
        (0.0, "0"),
        (math.inf, "inf"),
    ],
)
def test_a_figure_has_four_digits_and_an_exponent_only_far_from_one(value, text):
    assert figure(value) == text


@pytest.mark.parametrize(
    ("value", "half_width", "texts"),
    [
        (31.6192, 0.2791, ("31.62", "0.28")),
        (3.3727e-5, 1.9e-6, ("3.37e-05", "1.9e-06")),
        (0.04999, 5.6e-5, ("0.049990", "0.000056")),
        (10609.7, 73.78, ("10610", "74")),
        (15217.0, 234.0, ("15220", "230")),
        (31.6192, math.inf, ("31.62", "inf")),
    ],
)
def test_values_are_rounded_to_their_interval(value, half_width, texts):
    assert with_interval(value, half_width) == texts


@given(st.floats(1e-9, 1e9), st.floats(1e-6, 1.0))
def test_rounding_loses_a_small_part_of_the_interval(value, share):
    half_width = share * value
    text, half = with_interval(value, half_width)
    assert abs(float(text) - value) <= 0.06 * half_width
    assert float(half) == pytest.approx(half_width, rel=0.06)
