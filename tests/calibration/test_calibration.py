"""Calibration as a person runs it: the command as a process, the simulated drive, real files."""

import numpy as np
import pytest
import yaml

from hdbridge.axis.model import TransmissionModel
from hdbridge.records.recording import Recording


def truth(cell):
    """Values that only the simulated drive knows."""
    return yaml.safe_load((cell.axis / "truth.yaml").read_text())["gear"]


def test_a_new_axis_gets_a_pending_model(calibrated_once):
    cell, done = calibrated_once
    result = cell.json("result.json")
    assert result["schema"] == "hdbridge.calibration/1"
    assert result["offered"] is True
    assert result["plan"] == "short"
    assert (cell.axis / "pending.yaml").exists()
    assert not (cell.axis / "model.yaml").exists()
    assert "hdbridge model commit" in done.stdout
    assert "hysteresis" in done.stdout
    assert "100 %" in done.stderr


def test_model_matches_the_simulated_gear(calibrated_once):
    cell, _ = calibrated_once
    model = TransmissionModel.load(cell.axis / "pending.yaml")
    parts = {each.name: each.parameters() for each in model.effects}
    known = truth(cell)
    found = {each["order"]: each["amplitude_arcsec"] for each in parts["synchronous"]["orders"]}
    for each in known["motor_orders"]:
        assert found[each["order"]] == pytest.approx(each["amplitude_arcsec"], abs=0.4)
    assert parts["hysteresis"]["offset_arcsec"] == pytest.approx(
        known["hysteresis"]["offset_arcsec"], rel=0.05
    )
    assert parts["hysteresis"]["width_deg"] == pytest.approx(known["hysteresis"]["width_deg"], rel=0.2)


def test_model_improves_positioning(calibrated_once):
    stepping = calibrated_once[0].json("result.json")["stepping"]
    before, after = (stepping[name]["pooled"]["three_sigma_arcsec"] for name in ("before", "after"))
    assert before > 80
    assert after < 2.0 * stepping["floor_arcsec"]
    assert 2.8 < stepping["floor_arcsec"] < 3.2
    assert len(stepping["after"]["errors_arcsec"][0]) == 8
    accuracy = stepping["accuracy"]
    assert accuracy["after"]["accuracy_arcsec"] < 0.3 * accuracy["before"]["accuracy_arcsec"]
    assert accuracy["before"]["reversal_arcsec"] > 50


def test_recording_is_kept_with_its_segments(calibrated_once):
    cell, _ = calibrated_once
    recording = Recording.load(cell.folder / "rec")
    assert recording.axis == "demo"
    assert recording.ratio == 50
    assert recording.drive.serial is not None
    assert recording.notes["plan"]["name"] == "short"
    kinds = {each.kind for each in recording.segments}
    assert {"precondition", "reference", "standstill", "sweep", "sine", "reversal"} <= kinds
    assert np.all(np.diff(recording.record.time_s) > 0)
    for _, piece in recording.pieces():
        assert len(piece)
    assert (cell.folder / "rec" / "stepping-after.csv.gz").exists()


def test_measure_records_the_same_without_fitting(calibrated_once, cell):
    done = cell.run("measure", "axis", "--simulate", "--plan", "short.yaml", "--out", "rec")
    assert "recording: rec, 5 tasks" in done.stdout
    assert "hdbridge twin axis rec" in done.stdout
    assert sorted(each.name for each in cell.axis.iterdir()) == ["axis.yaml", "truth.yaml"]
    measured = Recording.load(cell.folder / "rec")
    assert measured.record == Recording.load(calibrated_once[0].folder / "rec").record
    again = cell.run("measure", "axis", "--simulate", "--resume", "rec")
    assert "0 tasks (5 tasks are there already)" in again.stderr


def test_model_states_its_provenance(calibrated_once):
    cell, _ = calibrated_once
    source = TransmissionModel.load(cell.axis / "pending.yaml").provenance
    assert source["recordings"] == ["rec"]
    assert source["axis"] == "demo"
    assert source["drive"]["product_code"] == 0x402
    assert source["gear"]["ratio"] == 50
    assert "hdbridge" in source["versions"]
    assert source["held_out"]["after_arcsec"] < source["held_out"]["before_arcsec"]
    assert "3 sigma" in source["reason"]


def test_report_reproduces_the_calibration_without_an_axis(calibrated):
    before = calibrated.json("result.json")
    done = calibrated.run("report", "rec", "--json", "again.json")
    again = calibrated.json("again.json")
    assert again["parameters"] == before["parameters"]
    assert again["stepping"] == before["stepping"]
    assert again["offered"] is True
    assert "hysteresis" in done.stdout


def test_step_uses_the_committed_model(calibrated):
    calibrated.run("model", "commit", "axis")
    calibrated.run("step", "axis", "--simulate", "--count", 8, "--json", "step.json", "--scheme", "both")
    assert calibrated.json("step.json")["both"]["pooled"]["three_sigma_arcsec"] < 6.0


def test_a_model_without_improvement_is_not_proposed(calibrated):
    calibrated.run("model", "commit", "axis")
    active = (calibrated.axis / "model.yaml").read_bytes()
    done = calibrated.calibrate("--resume", "rec", "--json", "again.json")
    result = calibrated.json("again.json")
    assert result["offered"] is False
    assert result["pending"] is None
    assert "not offered" in result["reason"]
    assert "not offered" in done.stdout
    assert "model commit" not in done.stdout
    assert not (calibrated.axis / "pending.yaml").exists()
    assert (calibrated.axis / "model.yaml").read_bytes() == active


def test_models_of_other_drives_are_not_compared(calibrated):
    calibrated.run("model", "commit", "axis")
    path = calibrated.axis / "model.yaml"
    text = path.read_text()
    assert "serial: 0x1" in text
    path.write_text(text.replace("serial: 0x1", "serial: 0x99"))
    done = calibrated.calibrate("--resume", "rec", "--json", "again.json")
    assert "serial" in done.stderr
    result = calibrated.json("again.json")
    assert result["changes"] == []
    assert result["stepping"]["before"]["model"] == "no compensation"


def test_the_recording_of_another_axis_is_refused(calibrated):
    calibrated.edit("axis.yaml", "name: demo", "name: other")
    done = calibrated.calibrate("--resume", "rec", status=2)
    assert "axis demo" in done.stderr
    assert "other" in done.stderr


def test_recordings_are_never_overwritten(calibrated):
    before = (calibrated.folder / "rec" / "recording.yaml").read_bytes()
    done = calibrated.calibrate("--plan", "short.yaml", "--out", "rec", status=2)
    assert "--resume" in done.stderr
    assert (calibrated.folder / "rec" / "recording.yaml").read_bytes() == before


def test_a_modified_recording_is_detected(calibrated):
    path = calibrated.folder / "rec" / "02-sweep.csv.gz"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    done = calibrated.calibrate("--resume", "rec", status=2)
    assert "changed since" in done.stderr
