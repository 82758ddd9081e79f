"""`hdbridge setup`: unattended on a simulated drive, interrupted, resumed, and its questions."""

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command import run_here, started

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.cli.setup import QUESTIONS, value_of, with_value
from hdbridge.files.profile import bundled_profile

PLAN = """schema: hdbridge.plan/1
name: short
procedures:
  - {procedure: standstill, duration_s: 1}
  - {procedure: sweep, motor_turns: 5, motor_turns_per_s: 1.0}
  - {procedure: sines, amplitudes_deg: [60, 8], frequency_hz: 0.2, periods: 1}
validation: {count: 8, cycles: 2, travel_deg: 10}
"""
STEPS = ("new", "check", "doctor", "calibrate", "model diff", "model commit", "move")
ARTICLE = (bundled_profile("article") / "axis.yaml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A completed set-up of a simulated axis."""
    folder = tmp_path_factory.mktemp("setup")
    (folder / "short.yaml").write_text(PLAN)
    return folder, run_here(folder, "setup", "arm", "--simulate", "--yes", "--plan", "short.yaml")


def steps(text: str) -> list[str]:
    return [
        next(each for each in STEPS if line.startswith(each))
        for line in re.findall(r"^\$ hdbridge (.*)", text, re.M)
    ]


def test_sets_up_a_compensated_axis_from_scratch(finished):
    folder, done = finished
    assert steps(done.stdout) == list(STEPS)
    TransmissionModel.load(folder / "arm" / "model.yaml").check_bound_to(AxisConfig.load(folder / "arm"))
    assert (folder / "arm" / "setup-calibration" / "report.html").exists()
    assert "hdbridge run arm --page --simulate" in done.stdout


def test_prints_ordinary_commands(finished, tmp_path):
    """The first three printed commands, run in a different folder, have the same effect."""
    _, done = finished
    for line in re.findall(r"^\$ hdbridge (.*)", done.stdout, re.M)[:3]:
        again = run_here(tmp_path, *line.split())
    assert "all right" in again.stdout


def test_finished_steps_are_not_repeated(finished):
    folder, _ = finished
    again = run_here(folder, "setup", "arm")
    assert steps(again.stdout) == ["check"]


def test_a_changed_axis_file_is_checked_again(finished, tmp_path):
    folder, _ = finished
    shutil.copytree(folder / "arm", tmp_path / "arm")
    path = tmp_path / "arm" / "axis.yaml"
    path.write_text(with_value(path.read_text(), "load_encoder.direction", "-1"))
    again = run_here(tmp_path, "setup", "arm", "--yes", status=4)
    assert steps(again.stdout) == ["check", "doctor"]
    assert "resume: hdbridge setup arm" in again.stderr


def test_an_interrupted_calibration_is_resumed(tmp_path):
    (tmp_path / "short.yaml").write_text(PLAN)
    command = ("setup", "arm", "--simulate", "--yes", "--plan", "short.yaml")
    process = started(tmp_path, *command, stdin=subprocess.DEVNULL)
    recording = tmp_path / "arm" / "setup-calibration" / "recording.yaml"
    while not recording.exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert "resume: hdbridge setup arm" in err
    again = run_here(tmp_path, *command)
    assert "$ hdbridge calibrate arm --resume arm/setup-calibration" in again.stdout
    assert steps(again.stdout) == ["check", "calibrate", "model diff", "model commit", "move"]


@given(st.sampled_from([key for key, _ in QUESTIONS]), st.floats(0.1, 1000).map(lambda x: f"{x:.6g}"))
def test_an_answer_changes_its_value_and_nothing_else(key, value):
    text = with_value(ARTICLE, key, value)
    assert value_of(text, key) == (value, False)
    changed = [(a, b) for a, b in zip(ARTICLE.splitlines(), text.splitlines(), strict=True) if a != b]
    assert len(changed) <= 1
    assert value_of(with_value(text, key, value_of(ARTICLE, key)[0]), key) == value_of(ARTICLE, key)


def test_values_to_fill_in_are_marked():
    text = ARTICLE.replace("  ratio: 50", "  ratio: 0         # fill in: motor turns per load turn")
    assert value_of(text, "gear.ratio") == ("0", True)
    assert "fill in" not in with_value(text, "gear.ratio", "50")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("arm",), 2, "give --interface and --channel"),
        (
            ("arm", "--interface", "socketcan", "--channel", "nocan7"),
            3,
            "sudo ip link set nocan7 up type can",
        ),
        (("arm", "--simulate"), 2, "Answer on a terminal, or give --yes"),
    ],
)
def test_missing_requirements_are_reported(arguments, status, said, tmp_path):
    done = run_here(tmp_path, "setup", *arguments, status=status)
    assert said in done.stderr


def test_nothing_moves_without_consent(tmp_path):
    """On a terminal, the user answers no to the first question."""
    parent, child = pty.openpty()
    process = started(tmp_path, "setup", "arm", "--simulate", stdin=child)
    os.write(parent, b"n\n")
    out, err = process.communicate()
    os.close(parent)
    os.close(child)
    assert process.returncode == 130
    assert steps(out) == ["new", "check"]
    assert "Move now?" in err
    assert json.loads((tmp_path / "arm" / "setup.json").read_text())["done"].keys() == {"facts"}
