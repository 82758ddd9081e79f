"""ISO 230-2 figures against numbers worked out by hand."""

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.commissioning.evaluation.accuracy import axis_accuracy
from hdbridge.errors import InputError

# Two targets, two runs each way; standard deviations of a pair are |difference| / sqrt(2).
#              target 0           target 90
# forward    1, 3   mean 2     5, 5  mean 5
# backward  -4, -2  mean -3   -1, 1  mean 0
TARGET = [0.0, 0.0, 0.0, 0.0, 90.0, 90.0, 90.0, 90.0]
DEVIATION = [1.0, 3.0, -4.0, -2.0, 5.0, 5.0, -1.0, 1.0]
FORWARD = [True, True, False, False, True, True, False, False]
S = 2.0**0.5


def test_matches_an_example_worked_by_hand():
    found = axis_accuracy(TARGET, DEVIATION, FORWARD)
    assert found.reversal_arcsec == pytest.approx(5.0)
    assert found.mean_reversal_arcsec == pytest.approx(5.0)
    assert found.systematic_arcsec == pytest.approx(5.0 - -3.0)
    assert found.systematic_forward_arcsec == pytest.approx(3.0)
    assert found.systematic_backward_arcsec == pytest.approx(3.0)
    assert found.range_arcsec == pytest.approx(2.5 - -0.5)
    assert found.repeatability_forward_arcsec == pytest.approx(4.0 * S)
    assert found.repeatability_backward_arcsec == pytest.approx(4.0 * S)
    assert found.repeatability_arcsec == pytest.approx(2.0 * S + 2.0 * S + 5.0)
    assert found.accuracy_forward_arcsec == pytest.approx(5.0 - (2.0 - 2.0 * S))
    assert found.accuracy_backward_arcsec == pytest.approx((0.0 + 2.0 * S) - (-3.0 - 2.0 * S))
    assert found.accuracy_arcsec == pytest.approx(5.0 - (-3.0 - 2.0 * S))
    assert (found.targets, found.runs) == (2, 2)


def test_bidirectional_repeatability_is_never_below_either_direction():
    found = axis_accuracy(
        [0.0, 0.0, 0.0, 0.0, 9.0, 9.0, 9.0, 9.0], [-10.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], FORWARD
    )
    assert found.repeatability_arcsec == pytest.approx(4.0 * 10.0 * S)


def test_a_target_approached_from_one_side_only_is_refused_with_its_place():
    with pytest.raises(InputError, match=r"target at 90 deg .* 2 times forwards and 0 times backwards"):
        axis_accuracy(TARGET[:6], DEVIATION[:6], FORWARD[:6])


def test_a_single_target_is_refused():
    with pytest.raises(InputError, match="1 targets"):
        axis_accuracy(TARGET[:4], DEVIATION[:4], FORWARD[:4])


def test_arrays_of_different_length_are_refused():
    with pytest.raises(InputError, match="one of each"):
        axis_accuracy(TARGET, DEVIATION[:-1], FORWARD)


@given(st.randoms(use_true_random=False), st.floats(-500.0, 500.0))
def test_order_and_a_common_zero_do_not_matter(random, zero):
    places = list(range(len(TARGET)))
    random.shuffle(places)
    plain = axis_accuracy(TARGET, DEVIATION, FORWARD)
    other = axis_accuracy(
        [TARGET[at] for at in places], [DEVIATION[at] + zero for at in places], [FORWARD[at] for at in places]
    )
    assert asdict(other) == pytest.approx(asdict(plain), abs=1e-9)


@given(st.lists(st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6), min_size=2, max_size=8))
def test_figures_keep_the_order_that_the_definitions_give_them(rows):
    targets = np.repeat(np.arange(len(rows), dtype=float), 6)
    found = axis_accuracy(
        targets, np.ravel(rows), np.tile([True, True, True, False, False, False], len(rows))
    )
    slack = 1e-9
    assert found.accuracy_arcsec + slack >= max(found.accuracy_forward_arcsec, found.accuracy_backward_arcsec)
    assert found.accuracy_arcsec + slack >= found.systematic_arcsec
    assert found.systematic_arcsec + slack >= max(
        found.range_arcsec, found.systematic_forward_arcsec, found.reversal_arcsec
    )
    assert found.repeatability_arcsec + slack >= max(
        found.repeatability_forward_arcsec, found.reversal_arcsec
    )
    assert found.reversal_arcsec + slack >= abs(found.mean_reversal_arcsec)
