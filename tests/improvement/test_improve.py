"""`hdbridge improve` on the simulated drive: the hidden cause is named and positioning improves."""

import json

import pytest

from hdbridge.axis.model import TransmissionModel
from hdbridge.records.recording import Recording


def causes(result):
    return [each["cause"] for each in result["diagnosis"]["findings"]]


def test_a_hidden_cause_is_named_and_positioning_improves(improved_once):
    cell, result, out, err = improved_once
    assert result["schema"] == "hdbridge.improvement/1"
    assert causes(result) == ["motor_order"]
    order, size = cell.hidden.parameters["order"], cell.hidden.size_arcsec
    found = result["diagnosis"]["findings"][0]["parameters"][f"order_{order}_amplitude_arcsec"]
    assert found["value"] == pytest.approx(size, abs=0.2)
    assert result["offered"] is True
    assert result["improves"] is True
    stepping = result["stepping"]
    before, after = (stepping[name]["pooled"]["three_sigma_arcsec"] for name in ("before", "after"))
    assert before > 6.0
    assert after < 1.3 * stepping["floor_arcsec"]
    assert len(stepping["after"]["errors_arcsec"][0]) == 20
    assert stepping["after"]["targets_deg"] == stepping["before"]["targets_deg"]
    assert "motor_order" in out
    assert "hdbridge model commit" in out
    assert "100 %" in err


def test_the_model_states_its_provenance_and_is_pending(improved_once):
    cell, *_ = improved_once
    assert (cell.axis / "model.yaml").read_text().endswith("{reason: an earlier calibration}\n")
    model = TransmissionModel.load(cell.axis / "pending.yaml")
    assert "motor_order" in [each.name for each in model.effects]
    source = model.provenance
    assert source["recordings"] == ["rec"]
    assert source["axis"] == "demo"
    assert source["drive"]["product_code"] == 0x402
    (found,) = source["found"]
    assert found["cause"] == "motor_order"
    assert found["probability"] > 0.9
    assert source["held_out"]["after_arcsec"] < source["held_out"]["before_arcsec"]
    assert "motor_order" in source["reason"]
    assert "3 sigma" in source["reason"]


def test_the_record_is_kept_with_both_models(improved_once):
    cell, result, *_ = improved_once
    folder = cell.folder / "rec"
    assert {"sweep", "sine", "reversal", "standstill"} <= {
        each.kind for each in Recording.load(folder).segments
    }
    for name in ("stepping-1-before", "stepping-1-after", "stepping-4-after", "small-steps-after"):
        assert (folder / f"{name}.csv.gz").exists()
    assert TransmissionModel.load(folder / "active.yaml").only(["motor_order"]).effects == ()
    assert json.loads((folder / "improvement.json").read_text()) == result
    page = (cell.folder / "page.html").read_text()
    assert "motor_order" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_reviewed_committed_stepped_and_rolled_back_as_any_model(improved):
    out, _ = improved.run("model", "diff", "axis", "--json", "diff.json")
    assert "motor_order" in out
    new = [each for each in improved.json("diff.json")["parameters"] if each["effect"] == "motor_order"]
    assert all(each["before"] is None and each["half_width"] > 0.0 for each in new)
    assert len(new) == 2
    before = (improved.axis / "model.yaml").read_bytes()
    improved.run("model", "commit", "axis")
    improved.run(
        "step", "axis", "--simulate", "--count", 8, "--step-deg", 403.56, "--json", "step.json",
        "--scheme", "both", "--scheme", "extended",
    )  # fmt: skip
    stepped = improved.json("step.json")
    both, extended = (stepped[name]["pooled"]["three_sigma_arcsec"] for name in ("both", "extended"))
    assert extended < 0.5 * both
    improved.run("model", "rollback", "axis", "--reason", "as a trial")
    assert (improved.axis / "model.yaml").read_bytes() == before


def test_from_a_recording_nothing_is_measured_first(improved):
    (improved.axis / "pending.yaml").unlink()
    result, _, err = improved.improve("--from", "rec", "--out", "again")
    assert causes(result) == ["motor_order"]
    assert result["offered"] is True
    assert result["recordings"] == ["rec"]
    assert "no measurement first" in err
    assert not (improved.folder / "again" / "recording.yaml").exists()
    assert (improved.folder / "again" / "stepping-1-after.csv.gz").exists()


def test_an_improved_axis_yields_no_further_finding(improved):
    improved.run("model", "commit", "axis")
    profile = improved.files()
    result, *_ = improved.improve("--from", "rec", "--out", "again")
    assert causes(result) == []
    assert improved.files() == profile


@pytest.mark.slow
def test_with_nothing_hidden_nothing_is_proposed_and_no_file_changes(cell):
    profile = cell.files()
    result, out, _ = cell.improve()
    assert causes(result) == []
    assert result["offered"] is False
    assert result["stepping"] is None
    assert "nothing found" in result["reason"]
    assert "Nothing found" in out
    assert cell.files() == profile
    assert (cell.folder / "rec" / "recording.yaml").exists()


@pytest.mark.slow
def test_compensable_causes_bring_stepping_back_to_the_floor(cell):
    cell.hide("hysteresis_memory", 15.0)
    result, *_ = cell.improve()
    assert causes(result) == ["hysteresis_memory"]
    assert result["offered"] is True
    assert result["stepping"]["of_floor"] < 1.3
    assert (
        result["small_steps"]["after"]["pooled"]["three_sigma_arcsec"]
        < 1.5 * (result["stepping"]["floor_arcsec"])
    )


def test_auto_runs_the_separating_experiment(cell):
    """On four motor turns, an eccentric disc of the load encoder looks like a wrong ratio."""
    cell.hide("load_order", 12.0, seed=3)
    result, _, err = cell.improve("--plan", "narrow.yaml", "--auto", "--rounds", 1)
    (one,) = result["rounds"]
    assert "ratio_error or load_order" in one["separates"]
    assert "round 1" in err
    assert causes(result) == ["load_order"]
    assert result["recordings"] == ["rec", "rec/round-1"]
    assert Recording.load(cell.folder / "rec" / "round-1").notes["plan"]["name"] == one["experiment"]
    assert result["offered"] is False
    assert "load_order is not compensated" in result["reason"]

    narrow, out, _ = cell.improve("--from", "rec", "--out", "again")
    assert "load_order" in narrow["not_told_from"]["ratio_error"]
    assert narrow["offered"] is False
    assert "not yet separated from load_order" in out
    assert "--auto" in out
    assert "ratio_error or load_order" in narrow["further"]["separates"]
