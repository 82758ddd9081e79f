"""The figures about the article's Table 3."""

import article_table3
import pytest


@pytest.fixture(scope="module")
def tool():
    return article_table3


@pytest.fixture(scope="module")
def figures(tool):
    return tool.figures()


def test_every_step_of_the_test_ends_saturated_so_it_cannot_see_the_shape(figures):
    assert figures["steps_that_end_saturated"] == figures["steps"] == 480
    assert figures["largest_change_with_widths_5_to_40_and_n_1.2_to_2.5_arcsec"] < 1e-9


def test_without_quantisation_only_the_exact_inverse_is_perfect(tool):
    model = tool.TransmissionModel.load(tool.bundled_profile("article") / "model.yaml")
    fine = 8000 * 1024
    exact = tool.statistics(*tool.step_errors(model, model, fine))["pooled"][0]
    printed = tool.statistics(*tool.step_errors(model, model, fine, tool.as_printed))["pooled"][0]
    load_count = 3 * 0.45 / 12**0.5
    assert exact == pytest.approx(load_count, rel=0.15)
    assert printed > 3 * load_count


def test_aliased_orders_appear_as_documented(figures):
    assert figures["aliases"]["6"] == pytest.approx(2.26, abs=0.005)
    assert figures["aliases"]["8"] == pytest.approx(0.26, abs=0.005)
    assert figures["aliases"]["4"] == 4


def test_the_law_as_printed_and_the_law_without_memory(figures):
    starts = figures["saturation_from_rest_deg"]
    assert starts["the formula as printed"] == pytest.approx(2.2, abs=0.05)
    assert starts["a virgin curve"] == pytest.approx(10.0, abs=0.01)
    gaps = figures["without_return_point_memory_arcsec"]
    assert gaps["one 2 deg back-step"] == pytest.approx(10.2, abs=0.05)
    assert gaps["1 / 0.5 deg staircase"] == pytest.approx(26.9, abs=0.05)
