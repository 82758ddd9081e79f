"""An axis with a model and a hidden cause, and `hdbridge improve` on its simulated drive."""

import json
import random
import shutil
from copy import copy
from pathlib import Path

import pytest
from support.command import run_here
from support.hidden import Run, hide
from support.hidden_bench import bare_truth

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
MODEL = """\
schema: hdbridge.model/1
ratio: 50
effects:
  - effect: synchronous
    parameters:
      orders:
        - {order: 1, amplitude_arcsec: 6.3, phase_deg: 38.5}
        - {order: 2, amplitude_arcsec: 13.9, phase_deg: 161.0}
        - {order: 3, amplitude_arcsec: 1.5, phase_deg: -73.0}
        - {order: 4, amplitude_arcsec: 8.2, phase_deg: -23.0}
        - {order: 6, amplitude_arcsec: 4.15, phase_deg: 88.0}
        - {order: 8, amplitude_arcsec: 1.2, phase_deg: -150.0}
  - effect: hysteresis
    parameters: {offset_arcsec: 31.9, width_deg: 25.5, exponent: 1.71}
provenance: {reason: an earlier calibration}
"""
PLAN = """\
schema: hdbridge.plan/1
name: small
reference_s: 0.5
procedures:
  - {procedure: standstill, duration_s: 3}
  - {procedure: sweep, motor_turns: 4, motor_turns_per_s: 0.3}
  - {procedure: sines, amplitudes_deg: [180, 45, 5], frequency_hz: 0.1, periods: 1}
  - {procedure: reversals, depths_deg: [2, 5, 9, 16], reach_deg: 45, motor_deg_per_s: 25, beyond: true}
  - {procedure: sweep, load_turns: 1.05, motor_turns_per_s: 0.85}
validation: {count: 20, step_deg: 403.56, cycles: 0}
"""
NARROW = PLAN.replace("name: small", "name: narrow").replace(
    "  - {procedure: sweep, load_turns: 1.05, motor_turns_per_s: 0.85}\n", ""
)
COARSE = (("cycle_ms: 4", "cycle_ms: 20"), ("counts_per_turn: 8000", "counts_per_turn: 32768"))
"""Longer cycle and finer motor counts. The motor follows whole-count commands at a fixed fraction of a count;
with small counts, this biases a sweep only insignificantly.
"""


class Cell:
    """A folder for the improvement of an axis: `axis/` is the profile, `small.yaml` a plan."""

    def __init__(self, folder):
        self.folder = folder
        self.axis = folder / "axis"
        self.axis.mkdir(parents=True)
        text = (DEMO / "axis.yaml").read_text()
        for old, new in COARSE:
            assert old in text
            text = text.replace(old, new)
        (self.axis / "axis.yaml").write_text(text)
        (self.axis / "model.yaml").write_text(MODEL)
        (folder / "small.yaml").write_text(PLAN)
        (folder / "narrow.yaml").write_text(NARROW)
        self.hidden = self.hide()

    def hide(self, cause=None, size_arcsec=5.0, seed=1):
        """Writes the truth file with a hidden cause."""
        truth, hidden = bare_truth(), None
        if cause:
            truth, hidden = hide(truth, cause, random.Random(seed), size_arcsec, Run(duration_s=120.0))
        (self.axis / "truth.yaml").write_text(json.dumps(truth.model_dump(by_alias=True, mode="json")))
        return hidden

    def run(self, *arguments, status=0):
        """Runs `hdbridge ARGS...` in this folder; returns its standard output and standard error."""
        done = run_here(self.folder, *arguments, status=status)
        return done.stdout, done.stderr

    def improve(self, *arguments, status=0):
        """Runs `hdbridge improve`; returns the JSON result and the printed output."""
        options = ("--simulate", "--plan", "small.yaml", "--out", "rec", "--json", "result.json")
        options = () if "--resume" in arguments else options
        out, err = self.run("improve", "axis", *options, *arguments, status=status)
        return (self.json("result.json") if status == 0 else None), out, err

    def json(self, name):
        return json.loads((self.folder / name).read_text())

    def files(self):
        """Returns the files of the profile, byte for byte."""
        return {each.name: each.read_bytes() for each in self.axis.rglob("*") if each.is_file()}

    def copy(self, folder):
        shutil.copytree(self.folder, folder)
        cell = copy(self)
        cell.folder, cell.axis = folder, folder / "axis"
        return cell


@pytest.fixture
def cell(tmp_path):
    """A cell whose axis has nothing hidden in it yet."""
    return Cell(tmp_path / "cell")


@pytest.fixture(scope="session")
def improved_once(tmp_path_factory):
    """An axis with a hidden motor order, improved once for all tests."""
    cell = Cell(tmp_path_factory.mktemp("improved") / "cell")
    cell.hidden = cell.hide("motor_order")
    return cell, *cell.improve("--html", "page.html")


@pytest.fixture
def improved(improved_once, tmp_path):
    """A cell with a recording, `rec/`, and a pending model."""
    return improved_once[0].copy(tmp_path / "copy")
