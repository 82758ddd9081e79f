"""Fixtures: a calibrated axis, and the command line as a process."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from support.command import run_here

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
SHORT = """\
schema: hdbridge.plan/1
name: short
reference_s: 0.5
procedures:
  - {procedure: standstill, duration_s: 1}
  - {procedure: sweep, motor_turns: 5, motor_turns_per_s: 1.0}
  - {procedure: sines, amplitudes_deg: [60, 8], frequency_hz: 0.2, periods: 1}
  - {procedure: reversals, depths_deg: [8, 20], reach_deg: 50, motor_deg_per_s: 20}
validation: {count: 8, cycles: 2, travel_deg: 10}
"""


class Cell:
    """A folder for the calibration of an axis: `axis/` is the profile, `short.yaml` a plan."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.axis = folder / "axis"
        self.axis.mkdir(parents=True)
        for name in ("axis.yaml", "truth.yaml"):
            shutil.copy(DEMO / name, self.axis)
        self.edit("axis.yaml", "cycle_ms: 4", "cycle_ms: 10")  # enough samples for a short plan
        (folder / "short.yaml").write_text(SHORT)

    def edit(self, name: str, old: str, new: str) -> None:
        path = self.axis / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def run(self, *arguments: object, status: int = 0) -> subprocess.CompletedProcess[str]:
        return run_here(self.folder, *arguments, status=status)

    def calibrate(self, *arguments: object, status: int = 0):
        return self.run("calibrate", "axis", "--simulate", *arguments, status=status)

    def json(self, name: str):
        return json.loads((self.folder / name).read_text())


@pytest.fixture
def cell(tmp_path):
    """A cell whose axis has no model yet."""
    return Cell(tmp_path / "cell")


@pytest.fixture(scope="session")
def calibrated_once(tmp_path_factory):
    """Calibration that was run once, for all tests to copy, with the output of the command."""
    cell = Cell(tmp_path_factory.mktemp("calibrated") / "cell")
    done = cell.calibrate("--plan", "short.yaml", "--out", "rec", "--json", "result.json")
    return cell, done


@pytest.fixture
def calibrated(calibrated_once, tmp_path):
    """A cell whose axis has a pending model and a recording, `rec/`."""
    cell = Cell(tmp_path / "cell")
    shutil.copytree(calibrated_once[0].folder, cell.folder, dirs_exist_ok=True)
    return cell
