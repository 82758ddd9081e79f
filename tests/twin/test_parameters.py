"""The table of a twin's adjustable parameters."""

from __future__ import annotations

import pytest
from support.demo import TRUTH

from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import by_each_law
from hdbridge.twin.parameters import (
    BY_NAME,
    PARAMETERS,
    Parameter,
    at_coordinates,
    coordinates,
    value_in,
    with_sections,
    with_values,
)

DEMO = with_sections(TRUTH, PARAMETERS)
DAHL = by_each_law(DEMO)[-1]
"""The demo's truth with a hysteresis law that has a yield in place of a width."""


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda each: each.name)
def test_each_row_names_a_value_of_the_truth_file_within_its_bounds(parameter: Parameter) -> None:
    truth = DEMO if value_in(DEMO, parameter) is not None else DAHL
    value = value_in(truth, parameter)
    assert value is not None
    assert parameter.least <= value <= parameter.most
    assert parameter.value(parameter.coordinate(value)) == pytest.approx(value)
    other = 0.9 * value + 0.001
    assert value_in(with_values(truth, {parameter.name: other}), parameter) == pytest.approx(other)


@pytest.mark.parametrize("truth", [DEMO, DAHL], ids=["demo", "dahl"])
def test_coordinates_round_trip(truth: Truth) -> None:
    parameters = [each for each in PARAMETERS if value_in(truth, each) is not None]
    place = coordinates(truth, parameters)
    again = at_coordinates(truth, parameters, place)
    assert coordinates(again, parameters) == pytest.approx(place)


def test_an_existing_section_needs_no_addition() -> None:
    assert DEMO.motor.stribeck is not None
    assert DEMO.motor.stribeck.rise == 0.0
    assert with_sections(DEMO, PARAMETERS) is DEMO


def test_a_missing_section_has_no_value() -> None:
    bare = DEMO.model_copy(update={"servo": DEMO.servo.model_copy(update={"load_feedforward": None})})
    assert value_in(bare, BY_NAME["load feed-forward"]) is None


def test_a_fit_may_ask_for_a_stiffer_spring_than_the_time_step_resolves() -> None:
    parameters = [BY_NAME["gear stiffness"], BY_NAME["load inertia"]]
    stiff = [each.coordinate(value) for each, value in zip(parameters, (1e8, 0.01), strict=True)]
    made = at_coordinates(DEMO, parameters, stiff)
    assert made.load_.inertia_kg_m2 == pytest.approx(0.01)
    assert made.gear.stiffness_nm_per_rad == pytest.approx(0.98**2 * made.highest_stiffness_nm_per_rad)
