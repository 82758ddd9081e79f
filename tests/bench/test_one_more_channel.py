"""An additional measured channel is one row of one table, from the drive's object to record and effects."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROW = '    HUMIDITY = "humidity_percent", "humidity of the grease", "%", 40.0, "humidity"\n'
USE = """
import sys
from typing import ClassVar

import numpy as np
from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.control.bench import Bench, compensation_for
from hdbridge.drive.drive import Drive
from hdbridge.axis.effects import Channel
from hdbridge.axis.effects.base import Angleless, Linear
from hdbridge.axis.effects.described import Compensable
from hdbridge.axis.effects.motion import SLOT
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_profile
from hdbridge.axis.model import TransmissionModel
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.record import Record
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.truth import Truth


class Swelling(Angleless, Linear):
    name = "swelling"
    linear = ("swelling_arcsec_per_percent",)
    channels = frozenset({Channel.HUMIDITY})
    compensable = Compensable(True, "the load moves")
    swelling_arcsec_per_percent: float

    def columns(self, motion, start=None):
        return motion.channel(Channel.HUMIDITY, self.name)[:, None]

    def at(self, motor_deg, moment):
        return self.swelling_arcsec_per_percent * moment.measured[SLOT[Channel.HUMIDITY]]

    def bound_arcsec(self):
        return 100.0 * abs(self.swelling_arcsec_per_percent)


file = bundled_profile("article") / "axis.yaml"
text = file.read_text()
bare = AxisConfig.from_text(text, file)
lines = "\\nhumidity:\\n  source: {index: 0x2100, type: int16}\\n  per_count: 0.1\\n"
axis = AxisConfig.from_text(text + lines, file)
assert list(axis.channels) == ["humidity"]
model = TransmissionModel(axis.gear.ratio, (Swelling(swelling_arcsec_per_percent=10.0),))
try:
    compensation_for(bare, model)
except InputError as error:
    print("refused:", error)
truth = Truth.load(file.parent)
compensation = compensation_for(axis, model)
with (
    simulated_bench(truth, axis.eds_path, axis.drive.node_id, 1) as (bus, clock, node),
    Drive(bus, axis, clock) as drive,
):
    drive.boot()
    run = Bench(drive, compensation).run(Stepping(count=2))
run.record.write_csv(sys.argv[1])
record = Record.read_csv(sys.argv[1])
print("column:", float(np.median(record.columns["humidity_percent"])))
print("motion:", Channel.HUMIDITY in record.motion().available())
print("correction:", compensation.correction_arcsec)
"""


def test_a_new_channel_needs_one_table_row(tmp_path):
    package = tmp_path / "hdbridge"
    shutil.copytree(ROOT / "hdbridge", package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("eds", "profiles"):
        shutil.copytree(ROOT / folder, package / "_bundled" / folder)
    table = package / "axis" / "effects" / "motion.py"
    text = table.read_text(encoding="utf-8")
    last = next(line for line in text.splitlines(keepends=True) if line.startswith("    TEMPERATURE = "))
    table.write_text(text.replace(last, last + ROW), encoding="utf-8")

    done = subprocess.run(
        [sys.executable, "-c", USE, str(tmp_path / "record.csv")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    assert "add 'humidity' to" in said["refused"]
    assert float(said["column"]) > 20.0  # value of the simulated drive's object 2100h, here in per cent
    assert said["motion"] == "True"
    assert float(said["correction"]) == pytest.approx(10.0 * float(said["column"]), rel=0.02)
