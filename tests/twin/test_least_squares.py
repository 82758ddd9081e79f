"""Slopes of a misfit that is rough, or that ends where the loops are unstable."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from hdbridge.twin.fit import slopes_at

Rows = NDArray[np.float64]
TRUE = np.random.default_rng(3).standard_normal((400, 2))
BOUNDS = (np.full(2, -5.0), np.full(2, 5.0))


def sight(shape: Callable[[Rows], Rows]) -> Callable[[Sequence[Rows]], list[Rows]]:
    return lambda places: [shape(place) for place in places]


def test_wide_differences_see_through_what_differs_from_replay_to_replay() -> None:
    rng = np.random.default_rng(4)
    where, rough = rng.uniform(size=400), 0.2

    def shape(place: Rows) -> Rows:
        """Rows that break away sooner or later, however little the place has changed."""
        return TRUE @ place + rough * np.sin(2e3 * where * (1.0 + place.sum()))

    moves = 0.05 * np.eye(2)
    off = [
        float(
            np.linalg.norm(
                slopes_at(sight(shape), shape(np.zeros(2)), np.zeros(2), moves, BOUNDS, wide=wide) - TRUE
            )
        )
        for wide in (True, False)
    ]
    assert off[0] < 0.4 * off[1]


@pytest.mark.parametrize("wide", [True, False])
def test_a_bound_leaves_the_slopes_the_other_way(wide: bool) -> None:
    place = np.array([5.0, 0.0])
    now = TRUE @ place
    found = slopes_at(sight(lambda at: TRUE @ at), now, place, 0.01 * np.eye(2), BOUNDS, wide=wide)
    np.testing.assert_allclose(found, TRUE, atol=1e-9)


def test_no_slope_is_taken_from_where_the_loops_are_unstable() -> None:
    def shape(place: Rows) -> Rows:
        return TRUE @ place + (1e9 * np.sin(np.arange(400.0)) if place[0] > 0.05 else 0.0)

    found = slopes_at(sight(shape), shape(np.zeros(2)), np.zeros(2), 0.03 * np.eye(2), BOUNDS, wide=True)
    np.testing.assert_allclose(found, TRUE, atol=1e-9)
