"""``hdbridge twin``: recordings against the simulated drive of a profile."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from support.command import run_here
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.model import TransmissionModel
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth

DEMO = Path(__file__).parents[2] / "profiles" / "demo"


def moves(bench: Exercise) -> None:
    for distance in (400.0, -250.0, 300.0, -450.0):
        bench.move(distance, 600.0, 6000.0)
        bench.hold(0.6)
    bench.hold(0.5)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's own axis, recorded."""
    folder = tmp_path_factory.mktemp("recorded") / "recording"
    record = record_of(Truth.load(DEMO), moves)
    legs = (Segment(kind="step", start_s=0.0, end_s=float(record.time_s[-1])),)
    Recording(record, legs, axis="demo", ratio=50.0).save(folder)
    return folder


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """The demo's profile, whose truth file says twice the friction."""
    folder = tmp_path / "demo"
    shutil.copytree(DEMO, folder)
    text = (folder / "truth.yaml").read_text()
    (folder / "truth.yaml").write_text(text.replace("coulomb_nm: 0.034", "coulomb_nm: 0.068"))
    return folder


def figures(told: dict[str, Any], which: str) -> dict[str, dict[str, Any]]:
    return {each["channel"]: each for each in told[which]["figures"] if each["kind"] == "all"}


def test_what_the_simulation_gets_wrong_is_told_channel_by_channel(profile: Path, recording: Path) -> None:
    done = run_here(profile, "twin", profile, recording, "--json", "told.json", "--html", "page.html")
    assert done.returncode == 0, done.stderr
    told = json.loads((profile / "told.json").read_text())
    assert told["schema"] == "hdbridge.twin/1"
    before = figures(told, "before")
    assert before["motor_torque"]["difference"] > 0.015
    assert before["load_error"]["difference"] < 3.0
    assert "motor torque" in done.stdout
    page = (profile / "page.html").read_text()
    assert "Twin of axis" in page
    assert "truth.yaml" in page


def test_an_active_model_says_how_the_simulation_errs(profile: Path, recording: Path) -> None:
    run_here(profile, "twin", profile, recording, "--json", "without.json")
    orders = tuple(MotorOrder(order=k, amplitude_arcsec=30.0, phase_deg=0.0) for k in (2, 5))
    loop = Hysteresis(offset_arcsec=31.5, width_deg=26.0, exponent=1.72)
    TransmissionModel(50.0, (Synchronous(orders=orders), loop)).bound_to(AxisConfig.load(profile)).save(
        profile / "model.yaml"
    )
    run_here(profile, "twin", profile, recording, "--json", "with.json")
    without, wrong = (
        figures(json.loads((profile / name).read_text()), "before")["load_error"]["difference"]
        for name in ("without.json", "with.json")
    )
    assert wrong > without + 15.0, "orders that the axis has not"
    rows = json.loads((profile / "with.json").read_text())["from_model"]
    assert {row["effect"]: row["counterpart"] for row in rows} == {
        "synchronous": "gear.motor_orders",
        "hysteresis": "gear.hysteresis",
    }


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--afresh", "--truth", "truth.yaml"), "leave out --truth"),
        (("--html", "recording.csv", "nowhere"), "no such file"),
    ],
)
def test_what_makes_no_sense_is_refused(
    profile: Path, recording: Path, options: tuple[str, ...], complaint: str
) -> None:
    done = run_here(profile, "twin", profile, recording, *options)
    assert done.returncode == 2
    assert complaint in done.stderr


def test_a_recording_of_another_axis_or_without_commands_is_refused(profile: Path, tmp_path: Path) -> None:
    record = record_of(Truth.load(DEMO), moves)
    Recording(record, axis="arm", ratio=50.0).save(tmp_path / "other")
    done = run_here(profile, "twin", profile, tmp_path / "other")
    assert done.returncode == 2
    assert "a recording of axis 'arm'" in done.stderr
    bare = {name: column for name, column in record.columns.items() if name != "motor_target_deg"}
    type(record)(bare).write_csv(tmp_path / "bare.csv")
    done = run_here(profile, "twin", profile, tmp_path / "bare.csv")
    assert done.returncode == 2
    assert "no column motor_target_deg" in done.stderr
