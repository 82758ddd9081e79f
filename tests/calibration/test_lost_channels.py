"""A channel of the axis file that is lost while the axis is calibrated."""

from datetime import UTC, datetime

import yaml
from support.exercised import booted
from support.two_channels import CHANNELS, resumes, stops

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.calibration import Callbacks, Journal, measure
from hdbridge.motion.procedures.plan import Plan
from hdbridge.sim.truth import Truth


def measured(cell, silent_cycles):
    """`rec/`, measured by the short plan; the load torque is missing in some cycles."""
    path = cell.axis / "axis.yaml"
    path.write_text(path.read_text() + CHANNELS)
    axis, truth = AxisConfig.load(path), Truth.load(cell.axis / "truth.yaml")
    cycles = 0
    with booted(axis, truth, 1) as (drive, node):
        date = datetime(2026, 1, 2, tzinfo=UTC)
        plan = Plan.load(str(cell.folder / "short.yaml"))
        journal = Journal.create(cell.folder / "rec", axis, plan, date, drive.identity)

        def each_cycle():
            nonlocal cycles
            cycles += 1
            if cycles == 500:
                node.faults.drop_tpdos = 1
            if cycles in silent_cycles:
                stops(node)
            elif cycles - 1 in silent_cycles:
                resumes(node)
            return False

        measure(drive, journal, Callbacks(interrupted=each_cycle))
    about = yaml.safe_load((cell.folder / "rec" / "recording.yaml").read_text())
    survived = {each["file"]: each["survived"] for each in about["notes"]["tasks"] if "survived" in each}
    return {each["file"]: each["lost"] for each in about["notes"]["tasks"] if "lost" in each}, survived


def test_a_channel_lost_during_calibration_is_reported_and_remembered(cell):
    lost_in, survived_in = measured(cell, silent_cycles=range(1700, 1760))
    lost, channels = lost_in.popitem()
    assert channels == ["load_torque"]
    done = cell.run("report", "rec", "--json", "result.json")
    line = f"the load torque was lost during the test (rec/{lost}); the fit does without it"
    assert f"note: {line}" in done.stdout.splitlines()
    assert line in cell.json("result.json")["warnings"]
    assert line in (cell.folder / "rec" / "report.html").read_text()
    # The recording has the tolerated faults as well, in the same form.
    missing = [
        (name, row)
        for name, rows in survived_in.items()
        for row in rows
        if row["what"] == "a TPDO is missing"
    ]
    ((name, row),) = missing
    assert row["cycles"] == 1
    said = f"rec/{name} continued despite: a TPDO is missing, in 1 cycle (first: {row['first']})"
    assert any(each.startswith(f"note: {said}") for each in done.stdout.splitlines())
    assert any(each.startswith(said) for each in cell.json("result.json")["warnings"])
    assert said in (cell.folder / "rec" / "report.html").read_text()
    assert any("channel" in row["what"] or "load torque" in row["what"] for row in survived_in[lost])
