"""The model file: exact round trip, one exact line for errors, binding to its drive."""

# ruff: noqa: E501  (the table of complaints shows each on one line)

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.effects import CATALOGUE, Hysteresis, Motion, MotorOrder, Start, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.files.expectation import expected_words, field_at
from hdbridge.files.profile import bundled_profile

from .conftest import AXIS

GOOD = """\
schema: hdbridge.model/1
ratio: 50
effects:
  - effect: synchronous
    parameters:
      orders:
        - {order: 1, amplitude_arcsec: 4.9, phase_deg: -126.8}
  - effect: hysteresis
    parameters: {offset_arcsec: 40, width_deg: 20, exponent: 1.6}
    uncertainty: {offset_arcsec: 0.2}
provenance:
  axis: test
"""

IDENTIFIED = AXIS.replace("0x402}", "0x402, revision: 1, serial: 17}").replace(
    "  ratio: 50", "  ratio: 50\n  teeth: {flexspline: 100, circular_spline: 102}"
)


WORDS = {
    "catalogue": ", ".join(CATALOGUE),
    "order": expected_words(field_at(Synchronous, ("orders", 0, "order"))),
    **{name: expected_words(field_at(Hysteresis, (name,))) for name in Hysteresis.model_fields},
}
"""Descriptions of the effects' own fields."""


def test_fields_are_described_by_type_range_and_text():
    assert WORDS["exponent"] == "a number above 1, at most 6 (shape n of the branch)"


@pytest.fixture
def axis(tmp_path) -> AxisConfig:
    (tmp_path / "test.eds").write_text("")
    (tmp_path / "axis.yaml").write_text(IDENTIFIED)
    return AxisConfig.load(tmp_path)


@pytest.mark.parametrize(
    ("wanted", "given", "expected"),
    [
        ("effect: hysteresis", "effect: hysteresys", "8:13: effects[1].effect: no effect is called 'hysteresys'; expected one of {catalogue}; did you mean 'hysteresis'?"),
        ("effect: hysteresis", "effect: synchronous", "8:13: effects[1].effect: 'synchronous' appears twice; expected each effect once"),
        ("width_deg", "width", "9:37: effects[1].parameters.width: unknown key; did you mean 'width_deg'?"),
        ("width_deg: 20, ", "", "9:17: effects[1].parameters: key 'width_deg' is missing; expected {width_deg}"),
        ("exponent: 1.6", "exponent: 1", "9:62: effects[1].parameters.exponent: found 1; expected {exponent}"),
        ("offset_arcsec: 40", "offset_arcsec: forty", "9:33: effects[1].parameters.offset_arcsec: found 'forty'; expected {offset_arcsec}"),
        ("offset_arcsec: 40", "offset_arcsec: .nan", "9:33: effects[1].parameters.offset_arcsec: found .nan; expected a finite number from -3600 to 3600 (half the height of the loop, at the load; negative if the load lags)"),
        ("order: 1,", "order: 1.5,", "7:19: effects[0].parameters.orders[0].order: found 1.5; expected {order}"),
        ("amplitude_arcsec", "amplitude_arcmin", "7:22: effects[0].parameters.orders[0].amplitude_arcmin: unknown key; did you mean 'amplitude_arcsec'?"),
        ("-126.8}", "-126.8}\n        - {order: 1, amplitude_arcsec: 1, phase_deg: 0}", "7:9: effects[0].parameters.orders: each order may appear only once"),
        ("    parameters: {offset", "    parametres: {offset", "9:5: effects[1].parametres: unknown key; did you mean 'parameters'?"),
        ("uncertainty: {offset_arcsec: 0.2}", "uncertainty: {offset: 0.2}", "10:19: effects[1].uncertainty.offset: unknown parameter of hysteresis; did you mean 'offset_arcsec'?"),
        ("uncertainty: {offset_arcsec: 0.2}", "uncertainty: {offset_arcsec: -1}", "10:34: effects[1].uncertainty.offset_arcsec: found -1; expected a half width of at least 0"),
        ("ratio: 50", "ratio: 0", "2:8: ratio: found 0; expected a number above 0, at most 1000 (N: motor turns per load turn)"),
        ("ratio: 50\n", "", "1:1: key 'ratio' is missing; expected a number above 0, at most 1000 (N: motor turns per load turn)"),
        ("axis: test", "axis: 5", "12:9: provenance.axis: found 5; expected text (name of the axis)"),
        ("axis: test", "drive: {vendor: 1}", "12:11: provenance.drive.vendor: unknown key; did you mean 'vendor_id'?"),
        ("hdbridge.model/1", "hdbridge.model/2", "1:9: schema: found 'hdbridge.model/2'; expected "
            "'hdbridge.model/1' (schema and version of this file)"),
    ],
)  # fmt: skip
def test_a_wrong_file_gets_one_exact_line(tmp_path, wanted, given, expected):
    assert wanted in GOOD
    path = tmp_path / "model.yaml"
    path.write_text(GOOD.replace(wanted, given, 1))
    with pytest.raises(InputError) as caught:
        TransmissionModel.load(path)
    said = str(caught.value).split(" (and ")[0]
    assert said == f"{path}:{expected.format_map(WORDS)}"


NUMBER = st.floats(0, 3600)
ORDERS = st.lists(
    st.builds(MotorOrder, order=st.integers(1, 1000), amplitude_arcsec=NUMBER, phase_deg=st.floats(-360, 360)),
    unique_by=lambda each: each.order,
    max_size=5,
).map(tuple)  # fmt: skip
EFFECTS = st.lists(
    st.builds(Synchronous, orders=ORDERS)
    | st.builds(
        Hysteresis,
        offset_arcsec=NUMBER,
        width_deg=st.floats(1e-6, 3600),
        exponent=st.floats(1, 6, exclude_min=True),
    ),
    unique_by=lambda each: each.name,
    max_size=2,
).map(tuple)


@given(
    st.floats(0, 1000, exclude_min=True),
    EFFECTS,
    NUMBER,
    st.dictionaries(
        st.text(min_size=1).filter(lambda key: key not in {"axis", "drive", "gear", "date", "reason"}),
        st.text() | st.floats(allow_nan=False) | st.lists(st.integers()),
    ),
)
def test_writing_and_reading_gives_the_same_model_to_the_last_bit(ratio, effects, half_width, more):
    uncertainty = {each.name: {"width_deg": half_width} for each in effects if each.name == "hysteresis"}
    provenance = {"reason": "ä", "drive": {"vendor_id": 0x4844, "product_code": 0x402, "serial": 3}} | more
    model = TransmissionModel(ratio, effects, uncertainty, provenance)
    assert TransmissionModel.from_text(model.dump()) == model


def test_a_saved_model_reads_well_and_predicts_the_same(tmp_path):
    model = TransmissionModel.from_text(GOOD).bound_to(
        AxisConfig.from_text((IDENTIFIED).replace("test.eds", __file__))
    )
    path = tmp_path / "model.yaml"
    model.save(path)
    assert [each.name for each in tmp_path.iterdir()] == ["model.yaml"]
    assert (
        "    vendor_id: 0x4844\n    product_code: 0x402\n    revision: 0x1\n    serial: 0x11\n"
        in path.read_text()
    )
    again = TransmissionModel.load(path)
    motion = Motion(np.linspace(-500.0, 700.0, 50))
    assert (again.predict(motion, Start.FORWARD) == model.predict(motion, Start.FORWARD)).all()
    assert again.uncertainty == {"hysteresis": {"offset_arcsec": 0.2}}
    assert again.path == path


def test_the_articles_model_holds_tables_1_and_2():
    model = TransmissionModel.load(bundled_profile("article") / "model.yaml")
    assert model.ratio == 50
    assert [each.name for each in model.effects] == ["synchronous", "hysteresis"]
    turn = Motion(np.linspace(0.0, 360.0, 3601))
    synchronous = model.only(["synchronous"]).predict(turn)
    assert np.ptp(synchronous) == pytest.approx(42.9, abs=0.05)
    assert model.effects[1] == Hysteresis(offset_arcsec=40, width_deg=20, exponent=1.6)


BOUND = replace(
    TransmissionModel.from_text(GOOD),
    provenance={
        "axis": "test",
        "drive": {"vendor_id": 0x4844, "product_code": 0x402, "revision": 9, "serial": 17},
        "gear": {"ratio": 50, "teeth": {"flexspline": 100, "circular_spline": 102}},
    },
)


def test_a_model_of_this_axis_is_accepted_whatever_the_firmware(axis):
    BOUND.check_bound_to(axis)
    BOUND.check_bound_to(axis, Identity(vendor_id=0x4844, product_code=0x402, revision=5))
    replace(BOUND, provenance={}).check_bound_to(axis)


@pytest.mark.parametrize(
    ("model", "identity", "expected"),
    [
        (replace(BOUND, ratio=40.0), None, "ratio: this model is of a gear with ratio 40, but {axis} says 50; use the model of this gear, or calibrate it"),
        (replace(BOUND, provenance={"axis": "other"}), None, "provenance.axis: this model was made for 'other', but the axis here is 'test' ({axis}); use the model of this axis, or calibrate it (if it is the same gear, correct provenance.axis in the model's file)"),
        (BOUND, Identity(vendor_id=0x4844, product_code=0x402, serial=18), "provenance.drive: this model was made for serial 0x11, but the drive here is 0x12 ({axis}); use the model of this drive, or calibrate it (if it is the same gear, correct provenance.drive in the model's file)"),
        (BOUND, Identity(vendor_id=0x4844, product_code=0x403), "provenance.drive: this model was made for product_code 0x402, but the drive here is 0x403 ({axis}); use the model of this drive, or calibrate it (if it is the same gear, correct provenance.drive in the model's file)"),
        (replace(BOUND, provenance={"gear": {"ratio": 50, "teeth": {"flexspline": 98, "circular_spline": 100, "output": "circular_spline"}}}), None, "provenance.gear: this model was made for 98/100 teeth, circular_spline output, but the gear here is 100/102 teeth, flexspline output ({axis}); use the model of this gear, or calibrate it (if it is the same gear, correct provenance.gear in the model's file)"),
    ],
)  # fmt: skip
def test_a_model_of_another_axis_is_refused_with_the_reason(axis, model, identity, expected):
    with pytest.raises(InputError) as caught:
        model.check_bound_to(axis, identity)
    assert str(caught.value) == "model.yaml: " + expected.format(axis=axis.path)


def test_binding_a_model_keeps_the_rest_of_its_provenance(axis):
    model = TransmissionModel(50.0, provenance={"reason": "why"})
    bound = model.bound_to(axis, Identity(vendor_id=1, product_code=2, serial=3))
    assert bound.provenance["reason"] == "why"
    assert bound.provenance["drive"] == {"vendor_id": 1, "product_code": 2, "serial": 3}
    with pytest.raises(InputError, match="vendor_id 0x1"):
        bound.check_bound_to(axis)


def test_mutually_exclusive_effects_are_refused():
    text = (
        "schema: hdbridge.model/1\nratio: 50\neffects:\n"
        "- effect: hysteresis\n  parameters: {offset_arcsec: 40, width_deg: 20, exponent: 1.6}\n"
        "- effect: hysteresis_memory\n  parameters: {offset_arcsec: 40, width_deg: 20, exponent: 1.6}\n"
    )
    with pytest.raises(InputError, match=r"model\.yaml:4:1: .*'hysteresis_memory' replaces 'hysteresis'"):
        TransmissionModel.from_text(text, "model.yaml")
