"""Models of a different gear, axis or drive cause no motion; limits that cut a model are reported."""

from dataclasses import replace
from pathlib import Path

import pytest
from support.exercised import booted

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.effects import Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import Bench, compensation_for
from hdbridge.control.caps import cap_remark
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.errors import InputError
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.sim.truth import Truth

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
AXIS = AxisConfig.load(PROFILE)
MODEL = TransmissionModel.load(PROFILE / "model.yaml")
BOUND = MODEL.bound_to(AXIS, Identity(vendor_id=0x4844, product_code=0x402, serial=7))
FOREIGN = replace(MODEL, provenance={"axis": "elbow"})


def test_a_foreign_model_compensates_nothing():
    """`files.test_model_files` has every reason."""
    with pytest.raises(InputError, match="'elbow'"):
        compensation_for(AXIS, FOREIGN)


def test_drive_identity_is_checked_even_for_custom_compensations():
    truth = Truth.load(PROFILE / "truth.yaml")
    with booted(AXIS, truth) as (drive, _):
        assert drive.identity.serial not in {None, 7}
        before = drive.read_positions().motor_counts
        own = Compensation(FOREIGN, CompensationLimits(), AXIS.drive.cycle_s)
        for compensation, words in ((compensation_for(AXIS, BOUND), "serial 0x7"), (own, "'elbow'")):
            with pytest.raises(InputError, match=words):
                Bench(drive, compensation).run(Stepping(count=2))
        assert drive.read_positions().motor_counts == before
        for model in (replace(MODEL, provenance={}), MODEL.bound_to(AXIS, drive.identity)):
            assert Bench(drive, compensation_for(AXIS, model)).run(Stepping(count=2)).segments


def test_a_cap_that_limits_the_model_is_reported():
    assert cap_remark(AXIS, MODEL) is None
    orders = {"orders": [{"order": 2, "amplitude_arcsec": 400, "phase_deg": 0}]}
    large = replace(MODEL, effects=(Synchronous.model_validate(orders),))
    said = cap_remark(AXIS, large)
    assert said is not None
    assert "axis.yaml:" in said
    assert "maximum_arcsec: 300 arcsec cut" in said
    assert "reaches 400 arcsec" in said
