"""The fleet as a prior of one joint: it weighs supported causes and adds none."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command import run_here
from support.fleet import MODEL, record

from hdbridge.analysis.acceptance import Gate
from hdbridge.analysis.findings import UNWEIGHED, Finding, Parameter
from hdbridge.analysis.probability import Prior, weighed
from hdbridge.analysis.scales import Scales
from hdbridge.fleet.prior import read_prior, write_prior
from hdbridge.fleet.summary import summarise

SCALES = Scales()
SHARES = st.floats(1e-6, 1.0 - 1e-6)


def finding(peak_arcsec=2.0, robust=400.0, parameters=None):
    return Finding(
        "motor_order", UNWEIGHED, (), parameters or {}, None, "", peak_arcsec, robust, gate=Gate(robust, 25.0)
    )


def weigh(each, prior=None):
    return weighed([each], False, SCALES, prior)[0]


@given(SHARES, SHARES, st.floats(0.01, 30.0), st.floats(1.0, 1e5))
def test_a_larger_share_never_makes_a_name_less_likely(one, other, peak_arcsec, robust):
    each = finding(peak_arcsec, robust)
    low, high = sorted((one, other))
    probabilities = [weigh(each, Prior({"motor_order": share}, {})).probability for share in (low, high)]
    assert probabilities == sorted(probabilities)
    assert probabilities[1] <= SCALES.surest


@given(SHARES, st.floats(0.01, 30.0), st.floats(0.1, 1e5))
def test_no_prior_makes_a_name_likely_that_the_record_alone_does_not_support(share, peak_arcsec, robust):
    each = finding(peak_arcsec, robust)
    if weigh(each).probability < SCALES.named_from:
        assert weigh(each, Prior({"motor_order": share}, {})).probability <= 0.5


def test_a_fleet_like_the_records_of_the_formula_changes_nothing():
    each = finding()
    same = weigh(each, Prior({"motor_order": SCALES.right}, {}))
    assert same.probability == pytest.approx(weigh(each).probability)
    assert weigh(each, Prior({}, {})).probability == weigh(each).probability


@given(st.floats(-50, 50), st.floats(0.01, 10), st.floats(-50, 50), st.floats(0.01, 10))
def test_fleet_ranges_never_widen_an_interval(value, own, middle, deviation):
    given_ = Parameter(value, "arcsec", value - 1.96 * own, value + 1.96 * own)
    found = given_.combined(middle, deviation)
    assert found.high - found.low <= given_.high - given_.low + 1e-9
    if abs(value - middle) > 3.0 * math.hypot(own, deviation) * 1.001:
        assert found == given_
    else:
        assert min(value, middle) - 1e-6 <= found.value <= max(value, middle) + 1e-6


def test_intervals_with_the_fleet_range_have_nominal_coverage():
    rng = np.random.default_rng(3)
    true = rng.normal(8.0, 1.0, 2000)
    seen = true + rng.normal(0.0, 1.5, 2000)
    found = [Parameter(each, "", each - 2.94, each + 2.94).combined(8.0, 1.0) for each in seen]
    held = np.mean([each.low <= one <= each.high for each, one in zip(found, true, strict=True)])
    assert 0.93 <= held <= 0.97
    assert np.mean([each.high - each.low for each in found]) < 0.6 * 5.88


def row(joint, number, cause=None, batch="A", peak=5.0):
    """Returns a row of a data set, with the columns that the prior reads."""
    parameters = [{"name": "amplitude", "value": peak, "low": peak - 1, "high": peak + 1, "unit": "arcsec"}]
    found = {"cause": cause, "rank": 1, "peak_arcsec": peak, "parameters": parameters, "aliases": []}
    same = dict.fromkeys(("figures", "temperature_c", "remarks"))
    same |= {"limits": [{"cause": "motor_order", "arcsec": 0.5}], "rms_arcsec": 0.6}
    same |= {"reason": None, "duplicate_of": None, "orders": [], "date": None, "gear": "ratio 50"}
    same |= {"cell": None, "lubricant": None, "batch": batch, "hours": 100.0 * number}
    return {
        **same, "joint": joint, "key": f"{joint}{number}", "path": f"{joint}-{number}",
        "findings": [found] if cause else [],
    }  # fmt: skip


@pytest.fixture
def prior(tmp_path):
    """Forty joints: nine of the twenty in batch B have an order of the motor; creep is named at random."""
    rng = np.random.default_rng(1)
    rows = []
    for joint in range(40):
        batch = "B" if joint < 20 else "A"
        for number in range(5):
            ill = "motor_order" if joint < 9 else "creep" if rng.random() < 0.15 else None
            rows.append(row(f"J{joint}", number, ill, batch, 5.0 + 0.3 * (joint % 9)))
    write_prior(tmp_path / "fleet.parquet", rows)
    return tmp_path / "fleet.parquet"


def test_the_prior_holds_group_rates_and_meaningless_names(prior):
    everyone, ill, well = (read_prior(prior, of) for of in ({}, {"batch": "B"}, {"batch": "A"}))
    assert well.right["motor_order"] < everyone.right["motor_order"] < ill.right["motor_order"]
    assert ill.right["motor_order"] > 0.99
    assert everyone.right["creep"] < 0.3
    assert "of batch B" in ill.words["motor_order"]
    middle, deviation = everyone.ranges["motor_order", "amplitude"]
    assert everyone.ranges.keys() == {("motor_order", "amplitude")}
    assert middle == pytest.approx(6.2, abs=0.3)
    assert 0.3 < deviation < 1.5


def test_causes_invisible_at_first_are_not_reported_as_new():
    rows = []
    for joint, peak in enumerate((0.5, 6.0, *[0.0] * 30)):
        for number in range(5):
            rows.append(row(joint, number, "motor_order" if peak and number else None, peak=peak))
    (listed,) = summarise([{**each, "joint": f"J{each['joint']}"} for each in rows], 10.0).first
    assert (listed.joint, listed.cause) == ("J1", "motor_order")


def test_diagnose_shows_the_prior_and_refuses_a_wrong_one(prior, tmp_path):
    (tmp_path / "model.yaml").write_text(MODEL)
    record(4, extra_arcsec=4.0).write_csv(tmp_path / "a.csv")
    command = ["diagnose", "a.csv", "--model", "model.yaml", "--json", "d.json", "--prior", "fleet.parquet"]
    done = run_here(tmp_path, *command, "--group", "batch=B", "--html", "d.html")
    assert "prior: " in done.stdout
    assert "of joints of batch B have it" in done.stdout
    assert "of batch B" in (tmp_path / "d.html").read_text()
    (found,) = json.loads((tmp_path / "d.json").read_text())["findings"]
    assert "batch B" in found["prior"]
    for wrong, complaint in (
        (["--group", "batch=C"], "no batch 'C'; expected A, B"),
        (["--group", "colour=C"], "--group: found 'colour=C'"),
        (["--prior", "model.yaml"], "cannot be read"),
        (["--prior", "none.parquet"], "cannot be read"),
    ):
        done = run_here(tmp_path, *command, *wrong, status=2)
        assert complaint in done.stderr
    done = run_here(tmp_path, *command[:-2], "--group", "batch=B", status=2)
    assert "--group needs --prior" in done.stderr
