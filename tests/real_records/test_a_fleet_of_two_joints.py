"""A fleet of two measured joints: what it says, and what it refuses to say.

Four one-way moves of a second each, all within minutes: nothing can have changed, so nobody is to be listed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from support.command import run_here

from hdbridge.fleet.dataset import Dataset

FOLDER = Path(os.environ.get("HDBRIDGE_REAL_RECORDS", "/nowhere")) / "cobot"
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="HDBRIDGE_REAL_RECORDS names no folder of measured records"
)


@pytest.fixture(scope="module")
def out(tmp_path_factory, request):
    """The result of a run without models, and of one with a model that has a ratio and nothing else."""
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("cobot")
    rows = [
        f"{FOLDER / f'joint{joint}-{number}.csv'},joint{joint},100,{number}"
        for joint in (4, 5)
        for number in range(1, 5)
    ]
    (folder / "m.csv").write_text("\n".join(["path,joint,ratio,hours", *rows]) + "\n")
    (folder / "model.yaml").write_text("schema: hdbridge.model/1\nratio: 100.0\neffects: []\n")
    for name, options in (("unfitted", []), ("bare", ["--model", "model.yaml"])):
        done = run_here(
            folder, "fleet", "run", "--manifest", "m.csv", "--out", name, "--workers", "1", *options
        )
        assert done.returncode == 0, done.stderr
        assert "No joint stands out." in done.stdout
    return folder


def test_without_a_model_it_says_that_the_moves_do_not_make_one(out):
    for row in Dataset(out / "unfitted").recordings():
        assert row["reason"].startswith("no model could be fitted")
        assert "slow sweeps" in row["reason"]


def test_it_names_what_a_recording_shows_but_lists_nobody_and_gives_no_hours(out):
    rows = Dataset(out / "bare").recordings()
    assert [row["reason"] for row in rows] == [None] * 8
    named = [each for row in rows for each in row["findings"] if each["cause"] != "unexplained"]
    assert named
    assert max(each["probability"] for each in named) <= 0.6
    run_here(out, "fleet", "report", "bare", "--json", "fleet.json")
    found = json.loads((out / "fleet.json").read_text())
    assert found["first"] == []
    assert found["mistaken"] == []
    assert found["odd"] == []


def test_an_identity_is_not_claimed_of_a_motor_turn(out):
    """Below two turns the orders of the motor are not separable."""
    assert all(row["orders"] == [] for row in Dataset(out / "bare").recordings())
