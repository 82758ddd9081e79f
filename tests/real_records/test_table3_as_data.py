"""Inference from four rows of scatter and mean to the runs behind them, tried on known runs."""

from pathlib import Path

import article_table3 as ARTICLE
import numpy as np
import pytest
import table3_budget as TOOL
from hypothesis import given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).parents[2]


ONE = "one error under four schemes"


def row(error: np.ndarray) -> tuple[float, float]:
    return 3.0 * float(np.std(error)), float(np.mean(error))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_ranges_contain_the_true_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 480
    share = rng.uniform(0.55, 0.98)
    one_way = np.where(np.arange(count) < share * count, 1.0, -1.0)
    wave = 17.0 * np.cos(rng.uniform(0.0, 2.0 * np.pi, count))
    correction = rng.uniform(20.0, 70.0) * one_way
    error = rng.uniform(0.3, 2.0) * wave + rng.uniform(0.3, 2.0) * correction + rng.normal(5.0, 8.0, count)
    table = {
        "none": row(error),
        "synchronous": row(error - wave),
        "hysteresis": row(error - correction),
        "both": row(error - wave - correction),
    }
    found = TOOL.budget(table, row(wave)[0], 40.0, 2.8)[ONE]
    assert found["means: they add up to within"] == pytest.approx(0.0, abs=1e-9)
    low, high = found["hysteresis correction, standard deviation"]
    assert 0.99 * low <= np.std(correction) <= 1.01 * high
    low, high = found["... if of two values: its size"]
    assert 0.99 * low <= abs(correction[0]) <= 1.01 * high
    low, high = found["... and the share of the steps one way, %"]
    assert low - 1.0 <= 100.0 * np.mean(one_way > 0.0) <= high + 1.0


def test_inconsistent_rows_are_reported() -> None:
    rows = {"none": (30.0, 0.0), "synchronous": (3.0, 0.0), "hysteresis": (3.0, 0.0), "both": (90.0, 0.0)}
    found = TOOL.budget(rows, 10.0, 40.0, 2.8)[ONE]
    assert "hysteresis correction: no variance of it is possible" in found


def test_the_page_matches_the_script() -> None:
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    computed = ARTICLE.figures()
    scatter = computed["computed"]["none"]["cw"][0]
    found = TOOL.budget(ARTICLE.TABLE_3, scatter, 40.0, computed["floor_arcsec"])[ONE]
    low, high = found["... and the share of the steps one way, %"]
    wave = found["wave of Table 1: it goes along with the error this many times its size"]
    assert f"({low:.1f} to {high:.1f} %), and the wave was {wave:.2f} times" in page
