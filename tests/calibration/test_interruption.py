"""Interrupted calibrations keep their measurements and can be resumed."""

import signal

import yaml
from support.command import started
from support.patience import until

from hdbridge.records.recording import Recording

LONG = """\
schema: hdbridge.plan/1
name: long
reference_s: 0.3
procedures:
  - {procedure: standstill, duration_s: 1}
  - {procedure: sines, amplitudes_deg: [60, 8], frequency_hz: 0.2, periods: 1}
  - {procedure: sweep, motor_turns: 12, motor_turns_per_s: 0.5}
validation: {count: 4, cycles: 0}
"""


def begun(cell, *arguments):
    """Starts a calibration; returns its process once the third task, which is long, begins."""
    (cell.folder / "long.yaml").write_text(LONG)
    process = started(
        cell.folder, "calibrate", "axis", "--simulate", "--plan", "long.yaml", "--out", "rec", *arguments
    )
    about = cell.folder / "rec" / "recording.yaml"
    until(lambda: process.poll() is not None or (about.exists() and "02-sines.csv.gz" in about.read_text()))
    return process


def tasks(cell):
    notes = yaml.safe_load((cell.folder / "rec" / "recording.yaml").read_text())["notes"]
    return {(each["task"], each["complete"], each["session"]) for each in notes["tasks"]}


def test_ctrl_c_keeps_the_record_and_resume_completes_it(cell):
    process = begun(cell)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert "--resume rec" in err
    assert "Traceback" not in err
    # A signal before the first sample of the sweep leaves no record of it.
    assert tasks(cell) - {("03-sweep", False, 1)} == {("01-standstill", True, 1), ("02-sines", True, 1)}
    kept = Recording.load(cell.folder / "rec")
    assert kept.segments[-1].kind in {"sine", "sweep", "move", "precondition", "reference"}
    first = (cell.folder / "rec" / "01-standstill.csv.gz").read_bytes()

    done = cell.calibrate("--resume", "rec", "--json", "result.json")
    assert "2 tasks are there already" in done.stderr
    assert {("03-sweep", True, 2), ("04-reference", True, 2)} <= tasks(cell)
    assert (cell.folder / "rec" / "01-standstill.csv.gz").read_bytes() == first
    whole = Recording.load(cell.folder / "rec")
    assert len(whole.record) > len(kept.record)
    assert (whole.record.time_s[1:] > whole.record.time_s[:-1]).all()
    result = cell.json("result.json")
    assert {each["effect"] for each in result["parameters"]} == {"synchronous", "hysteresis"}
    assert result["stepping"]["before"]["pooled"]["three_sigma_arcsec"] > 80


def test_a_kill_keeps_every_finished_task(cell):
    process = begun(cell)
    process.kill()
    process.communicate()
    assert tasks(cell) == {("01-standstill", True, 1), ("02-sines", True, 1)}
    kept = Recording.load(cell.folder / "rec")
    assert kept.segments[-1].kind == "sine"
    assert not (cell.axis / "pending.yaml").exists()


def test_a_fault_of_the_axis_keeps_what_was_measured(cell):
    hasty = (cell.folder / "short.yaml").read_text().replace("1.0}", "2.0}")
    (cell.folder / "short.yaml").write_text(hasty + "acceleration_deg_s2: 200\n")
    cell.edit("axis.yaml", "following_error_deg: 5.0", "following_error_deg: 1.2")
    done = cell.calibrate("--plan", "short.yaml", "--out", "rec", status=5)
    assert "following_error_deg" in done.stderr
    assert "--resume rec" in done.stderr
    kept = yaml.safe_load((cell.folder / "rec" / "recording.yaml").read_text())["notes"]["tasks"]
    assert [(each["task"], each["complete"]) for each in kept] == [("01-standstill", False)]
    assert len(Recording.load(cell.folder / "rec").record) > 10
