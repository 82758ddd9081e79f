"""Truth files, read strictly."""

import re
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from hdbridge.axis import AxisConfig
from hdbridge.errors import InputError
from hdbridge.sim.truth import RollingFriction, Truth

ROOT = Path(__file__).parents[2]
ARTICLE = ROOT / "profiles" / "article" / "truth.yaml"


def changed(old: str, new: str) -> Truth:
    """The article's truth file with a piece of text replaced."""
    text = ARTICLE.read_text()
    assert text.count(old) == 1, f"the test expects '{old}' once in the article's truth file"
    return Truth.from_text(text.replace(old, new), "truth.yaml")


@pytest.mark.parametrize("profile", ["article", "demo"])
def test_a_profile_s_simulated_axis_is_the_one_that_its_axis_file_describes(profile: str) -> None:
    folder = ROOT / "profiles" / profile
    truth, axis = Truth.load(folder), AxisConfig.load(folder)
    assert truth.name == profile
    assert truth.gear.ratio == axis.gear.ratio
    assert truth.motor.rated_torque_nm == axis.drive.rated_torque_nm
    for there, here in (
        (truth.motor.encoder, axis.motor_encoder),
        (truth.load_.encoder, axis.load_encoder),
    ):
        assert (there.counts_per_turn, there.direction) == (here.counts_per_turn, here.direction)


def test_the_article_s_axis_has_tables_1_and_2_and_nothing_else_at_rest() -> None:
    truth = Truth.load(ARTICLE)
    orders = {each.order: (each.amplitude_arcsec, each.phase_deg) for each in truth.gear.motor_orders}
    assert orders == {
        1: (4.9, -126.8), 2: (9.33, -132.1), 3: (2.09, -96.2),
        4: (12.21, 105.7), 6: (3.18, -127.0), 8: (1.87, 124.3),
    }  # fmt: skip
    law = truth.gear.hysteresis
    assert isinstance(law, RollingFriction)
    assert (law.width_deg, law.offset_arcsec, law.exponent) == (20.0, 40.0, 1.6)
    assert truth.gear.load_orders == truth.gear.flexspline_orders == ()
    assert truth.load_.coulomb_nm == truth.load_.encoder.noise_arcsec == 0.0
    assert truth.temperature.zero_drift_arcsec_per_k == 0.0


def test_the_inertias_are_1_to_3_and_the_load_s_resonance_is_realistic() -> None:
    truth = Truth.load(ARTICLE)
    reflected = truth.load_.inertia_kg_m2 / truth.gear.ratio**2
    assert reflected / truth.motor.inertia_kg_m2 == pytest.approx(3.0)
    assert 20.0 < truth.load_frequency_hz < 60.0


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("coulomb_nm: 0.03", "coulomb: 0.03", r"truth.yaml:10:3: motor\.coulomb: unknown key; did you mean"),
        ("inertia_kg_m2: 3.0e-5 ", "inertia_kg_m2: -1 ", r"truth.yaml:8:18: motor\.inertia_kg_m2: found -1"),
        ("ratio: 50", "ratio: .nan", r"gear\.ratio"),
        (
            "exponent: 1.6",
            "exponent: 0.9",
            r"gear\.hysteresis\.exponent: found 0.9; expected a number from 1 to 10",
        ),
        ("law: rolling_friction", "law: rolling", r"gear\.hysteresis"),
        ("exponent: 1.6", "exponent: 1.6\n    start_arcsec: 41", r"41 arcsec lies outside"),
        ("order: 8", "order: 6", r"order 6 appears twice"),
        ("substep_ms: 0.5", "substep_ms: 5", r"substep_ms: found 5"),
        ("stiffness_nm_per_rad: 16000", "stiffness_nm_per_rad: 4.0e6", r"too long for a resonance"),
        ("hdbridge.truth/1", "hdbridge.truth/2", r"schema: found 'hdbridge.truth/2'"),
        ("name: article", "", r"key 'name' is missing"),
    ],
)
def test_a_wrong_truth_file_is_refused_with_location_and_reason(old: str, new: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint) as raised:
        changed(old, new)
    assert re.match(r"truth\.yaml:\d+:\d+: ", str(raised.value))
    assert "\n" not in str(raised.value)


def test_an_absent_truth_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Truth.load(tmp_path)


def parts(model: type[BaseModel]) -> set[type[BaseModel]]:
    """Returns a model and, recursively, all models in its fields."""
    found = {model}
    waiting: list[Any] = [field.annotation for field in model.model_fields.values()]
    while waiting:
        each = waiting.pop()
        if isinstance(each, type) and issubclass(each, BaseModel):
            found |= parts(each) if each not in found else set()
        else:
            waiting += get_args(each)
    return found


def test_every_key_is_described_in_the_reference() -> None:
    reference = (ROOT / "docs" / "ci.md").read_text()
    models = parts(Truth)
    keys = {field.alias or name for model in models for name, field in model.model_fields.items()}
    assert len(models) > 30
    assert len(keys) > 120
    assert [key for key in sorted(keys) if f"`{key}`" not in reference] == []


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            "  hysteresis:  ",
            "  stiffening: {first_torque_nm: 5, second_stiffness_nm_per_rad: 2.0e4, second_torque_nm: 4, "
            "third_stiffness_nm_per_rad: 3.0e4}\n  hysteresis:  ",
            "4 Nm is not above first_torque_nm, 5",
        ),
        ("  hysteresis:  ", "  torque_growth_per_nm: 0.5\n  hysteresis:  ", "expected less than 0.38"),
        (
            "    direction: 1",
            "    disc: {radius_mm: 10, eccentricity_um: 2000}\n    direction: 1",
            "2000 um is more than a tenth of the radius",
        ),
        (
            "  hysteresis:  ",
            "  stiffening: {first_torque_nm: 5, second_stiffness_nm_per_rad: 4.0e6, second_torque_nm: 9, "
            "third_stiffness_nm_per_rad: 3.0e4}\n  hysteresis:  ",
            "too long for a resonance",
        ),
    ],
)
def test_an_invalid_cause_is_refused(old: str, new: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        changed(old, new)


def test_provenance_of_twin_values_is_kept_and_has_no_effect() -> None:
    appended = "\nintervals: {gear.stiffness_nm_per_rad: [15500, 16400]}\nprovenance: {axis: article}\n"
    twin = Truth.from_text(ARTICLE.read_text() + appended)
    assert twin.intervals == {"gear.stiffness_nm_per_rad": (15500.0, 16400.0)}
    assert twin.provenance == {"axis": "article"}
    assert twin.model_copy(update={"intervals": {}, "provenance": {}}) == Truth.load(ARTICLE)
    with pytest.raises(InputError, match="expected lower, upper"):
        Truth.from_text(ARTICLE.read_text() + "\nintervals: {gear.ratio: [51, 49]}\n")


def test_a_fault_is_added_by_keys_of_a_section() -> None:
    truth = Truth.load(ARTICLE)
    assert truth.changed() is truth
    worn = truth.changed(gear={"backlash_arcsec": 12.0}, load={"coulomb_nm": 0.5})
    assert (worn.gear.backlash_arcsec, worn.load_.coulomb_nm) == (12.0, 0.5)
    assert worn.gear.model_copy(update={"backlash_arcsec": 0.0}) == truth.gear
    for wrong in ({"gear": {"backlash": 12.0}}, {"gears": {}}, {"gear": {"ratio": -1.0}}):
        with pytest.raises(InputError, match="changed truth"):
            truth.changed(**wrong)
