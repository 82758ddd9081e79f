"""The figures about the article's Table 3, and the inference from its four rows to the runs behind them."""

from pathlib import Path

import article_table3
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from table3_budget import budget

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def figures():
    return article_table3.figures()


def test_the_documented_figures_of_test_and_law(figures):
    assert figures["steps_that_end_saturated"] == figures["steps"] == 480
    assert figures["load_turns_spanned"] == pytest.approx(0.58, abs=0.005)
    gap = figures["without_return_point_memory_after_a_2_deg_back_step_arcsec"]
    assert gap == pytest.approx(10.2, abs=0.05)


def test_without_quantisation_only_the_exact_inverse_is_perfect():
    tool = article_table3
    model = tool.TransmissionModel.load(tool.bundled_profile("article") / "model.yaml")
    fine = 8000 * 1024
    exact = tool.statistics(*tool.step_errors(model, model, fine))["pooled"][0]
    printed = tool.statistics(*tool.step_errors(model, model, fine, tool.as_printed))["pooled"][0]
    load_count = 3 * 0.45 / 12**0.5
    assert exact == pytest.approx(load_count, rel=0.15)
    assert printed > 3 * load_count


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
    found = budget(table, row(wave)[0], 40.0, 2.8)[ONE]
    assert found["means: they add up to within"] == pytest.approx(0.0, abs=1e-9)
    low, high = found["hysteresis correction, standard deviation"]
    assert 0.99 * low <= np.std(correction) <= 1.01 * high
    low, high = found["... if of two values: its size"]
    assert 0.99 * low <= abs(correction[0]) <= 1.01 * high
    low, high = found["... and the share of the steps one way, %"]
    assert low - 1.0 <= 100.0 * np.mean(one_way > 0.0) <= high + 1.0


def test_inconsistent_rows_are_reported() -> None:
    rows = {"none": (30.0, 0.0), "synchronous": (3.0, 0.0), "hysteresis": (3.0, 0.0), "both": (90.0, 0.0)}
    found = budget(rows, 10.0, 40.0, 2.8)[ONE]
    assert "hysteresis correction: no variance of it is possible" in found


def test_the_page_matches_the_script(figures) -> None:
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    found = article_table3.as_data(figures)[ONE]
    low, high = found["... and the share of the steps one way, %"]
    wave = found["wave of Table 1: it goes along with the error this many times its size"]
    assert f"({low:.1f} to {high:.1f} %), and the wave was {wave:.2f} times" in page
