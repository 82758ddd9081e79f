"""``hdbridge twin``: recordings against the simulated drive of a profile."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.command import run_here
from support.demo import AXIS, DEMO, TRUTH
from support.exercised import moved, record_of

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.files.csvfile import write_columns
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import compare
from hdbridge.twin.misfit import ChannelResidual
from hdbridge.twin.naming import Finding, Moved
from hdbridge.twin.parameters import with_values
from hdbridge.twin.replay import replay
from hdbridge.twin.twin import Twin, TwinFile, impossible

moves = moved((400.0, 600.0, 6000.0, 0.6), (-450.0, 600.0, 6000.0, 0.6))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's own axis, recorded."""
    folder = tmp_path_factory.mktemp("recorded") / "recording"
    record = record_of(TRUTH, moves)
    legs = (Segment(kind="step", start_s=0.0, end_s=float(record.time_s[-1])),)
    Recording(record, legs, axis="demo", ratio=50.0).save(folder)
    return folder


TRIPS = ((400.0, 600.0), (-450.0, 600.0), (90.0, 120.0), (-150.0, 120.0), (700.0, 1500.0), (-600.0, 1500.0))
"""Moves (degrees of the motor) and speeds (deg/s) that determine a twin well enough to check the axis."""


def trips(truth: Truth, folder: Path) -> Path:
    """Records the `TRIPS`, a leg for each."""
    ends = [0.0]

    def lead(bench: Exercise) -> None:
        for distance, speed in TRIPS:
            bench.move(distance, speed, 10.0 * speed)
            bench.hold(0.6)
            ends.append(bench.samples * bench.cycle_s)

    led = record_of(truth, lead)
    legs = tuple(Segment(kind="step", start_s=a, end_s=b) for a, b in pairwise(ends))
    # A drive receives whole counts; the command here has fractions of them.
    record = replay(Recording(led, legs, axis="demo", ratio=50.0), AXIS, truth)
    Recording(record, legs, axis="demo", ratio=50.0).save(folder)
    return folder


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """Profile of the demo, with twice the friction in its truth file."""
    folder = tmp_path / "demo"
    shutil.copytree(DEMO, folder)
    text = (folder / "truth.yaml").read_text()
    (folder / "truth.yaml").write_text(text.replace("coulomb_nm: 0.034", "coulomb_nm: 0.068"))
    return folder


def figures(report: dict[str, Any], which: str) -> dict[str, dict[str, Any]]:
    return {each["channel"]: each for each in report[which]["figures"] if each["kind"] == "all"}


def test_simulation_errors_are_reported_by_channel(profile: Path, recording: Path) -> None:
    done = run_here(
        profile, "twin", profile, recording, "--compare", "--json", "report.json", "--html", "page.html"
    )
    assert "no transmission error is simulated" not in done.stderr, "the truth file has it"
    report = json.loads((profile / "report.json").read_text())
    assert report["schema"] == "hdbridge.twin/1"
    before = figures(report, "before")
    assert before["motor_torque"]["difference"] > 0.015
    assert before["load_error"]["difference"] < 3.0
    assert "motor torque" in done.stdout
    page = (profile / "page.html").read_text()
    assert "Twin of axis" in page
    assert "truth.yaml" in page
    # Without a transmission error, its torque and following error would be attributed to motor and loops.
    (profile / "truth.yaml").unlink()
    done = run_here(profile, "twin", profile, recording, "--compare")
    assert "no transmission error is simulated" in done.stderr
    assert f"hdbridge calibrate {profile}" in done.stderr


def test_the_active_model_explains_the_simulation_error(profile: Path, recording: Path) -> None:
    run_here(profile, "twin", profile, recording, "--compare", "--json", "without.json")
    orders = tuple(MotorOrder(order=k, amplitude_arcsec=30.0, phase_deg=0.0) for k in (2, 5))
    loop = Hysteresis(offset_arcsec=31.5, width_deg=26.0, exponent=1.72)
    TransmissionModel(50.0, (Synchronous(orders=orders), loop)).bound_to(AxisConfig.load(profile)).save(
        profile / "model.yaml"
    )
    run_here(profile, "twin", profile, recording, "--compare", "--json", "with.json")
    without, wrong = (
        figures(json.loads((profile / name).read_text()), "before")["load_error"]["difference"]
        for name in ("without.json", "with.json")
    )
    assert wrong > without + 15.0, "orders that the axis does not have"
    rows = json.loads((profile / "with.json").read_text())["from_model"]
    assert {row["effect"]: row["counterpart"] for row in rows} == {
        "synchronous": "gear.motor_orders",
        "hysteresis": "gear.hysteresis",
    }


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--afresh", "--truth", "truth.yaml"), "leave out --truth"),
        (("--check", "--afresh"), "leave out the other options"),
        (("--check",), "there is no active twin to check"),
        (("--html", "recording.csv", "nowhere"), "no such file"),
    ],
)
def test_invalid_options_are_refused(
    profile: Path, recording: Path, options: tuple[str, ...], complaint: str
) -> None:
    done = run_here(profile, "twin", profile, recording, *options, status=2)
    assert complaint in done.stderr


def test_a_recording_of_another_axis_or_without_commands_is_refused(profile: Path, tmp_path: Path) -> None:
    record = record_of(TRUTH, moves)
    Recording(record, axis="arm", ratio=50.0).save(tmp_path / "other")
    bare = {name: column for name, column in record.columns.items() if name != "motor_target_deg"}
    write_columns(tmp_path / "bare.csv", bare)
    write_columns(tmp_path / "named.csv", {**bare, "demand": record.columns["motor_target_deg"]})
    named = ("named.csv", "--columns", "target=demand", "--units", "target=deg", "--check")
    for (path, *options), complaint in (
        (("other",), "a recording of axis 'arm'"),
        (("bare.csv",), "no column motor_target_deg"),
        (("bare.csv",), "pass --columns target=COLUMN"),
        (named, "there is no active twin"),
    ):
        done = run_here(profile, "twin", profile, tmp_path / path, *options, status=2)
        assert complaint in done.stderr


def fitted(
    truth: Truth, values: str = "axis", times_noise: float = 2.5, scatter: float = 1.0
) -> Callable[..., Twin]:
    """Result of a fit, which itself would take minutes."""

    def fit_twin(recordings: Any, axis: AxisConfig, start: Truth, progress: Any) -> Twin:
        (recording,) = recordings
        before, after = (
            compare(recording.record, replay(recording, axis, each), recording.segments, 50.0)
            for each in (start, truth)
        )
        moved = Moved("Coulomb friction", "Nm", start.motor.coulomb_nm, truth.motor.coulomb_nm, 0.033, 0.035)
        finding = Finding("friction", (moved,))
        about = {"values": values, "fit": {"parameters": ["Coulomb friction"]}}
        intervals = {"motor.coulomb_nm": (0.033, 0.035)} if values == "axis" else {}
        known = truth.model_copy(update={"intervals": intervals, "provenance": about})
        left = (ChannelResidual("motor torque", 0.04, times_noise, "step"),)
        findings = (finding,) if values == "axis" and "values" not in start.provenance else ()
        wrong = impossible(truth, axis, 0.01) if values == "replay" else ()
        return Twin(known, findings, (), left, before, after, scatter, wrong)

    return fit_twin


Run = Callable[..., tuple[str, dict[str, Any], str]]


@pytest.fixture
def run(profile: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command with this fit; returns its output, its data and its page."""

    def run(fit: Callable[..., Twin], *options: str) -> tuple[str, dict[str, Any], str]:
        monkeypatch.setattr("hdbridge.twin.twin.fit_twin", fit)
        files = ("--json", "report.json", "--html", "page.html")
        done = run_here(profile, "twin", profile, recording, *files, *options)
        report = json.loads((profile / "report.json").read_text())
        return done.stdout, report, (profile / "page.html").read_text()

    return run


def test_a_better_twin_is_kept_as_pending(profile: Path, recording: Path, run: Run) -> None:
    said, report, page = run(fitted(TRUTH))
    assert "friction: Coulomb friction 0.068 -> 0.034 Nm" in said
    assert "unexplained: motor torque: residual is 2.5 times the noise" in said
    assert f"hdbridge model commit {profile} --twin" in said
    pending = TwinFile.load(profile / "pending-twin.yaml")
    assert pending.truth.motor.coulomb_nm == 0.034
    assert pending.provenance["recordings"] == [str(recording)]
    assert pending.provenance["axis"] == "demo"
    assert figures(report, "after")["motor_torque"]["difference"] < 0.008
    (friction,) = report["parameters"]
    assert (friction["before"], friction["value"], friction["ci95"]) == (0.068, 0.034, [0.033, 0.035])
    assert "Errors of the initial simulation" in page
    assert "model commit" in page


def test_a_twin_without_improvement_is_not_kept(profile: Path, run: Run) -> None:
    said, report, page = run(fitted(Truth.load(profile)))
    assert "not kept" in said
    assert "Coulomb friction" not in said, "its cause is unknown"
    assert "unexplained: motor torque" in said
    assert [each["cause"] for each in report["findings"]] == ["unexplained"]
    assert report["parameters"] == []
    assert "What the plant is" not in page
    assert not (profile / "pending-twin.yaml").exists()


def test_values_fitting_the_replay_only_are_offered_as_such(profile: Path, run: Run) -> None:
    said, report, page = run(fitted(TRUTH, "replay", 22.0))
    headline = (
        "The twin replays this drive (motor torque to 4 %), but its values are not the axis's: motor torque: "
        "residual is 22 times the noise; the twin is kept as pending:"
    )
    assert said.startswith(headline)
    assert "friction:" not in said, "no value is called a finding"
    assert report["values"] == "replay"
    assert report["verdict"].lower().startswith(headline.lower())
    assert [(each["channel"], each["explained"]) for each in report["left"]] == [("motor torque", False)]
    assert [each["cause"] for each in report["findings"]] == ["unexplained"]
    assert [each["ci95"] for each in report["parameters"]] == [None]
    assert headline.replace("'", "&#x27;") in page or headline.replace("'", "&#39;") in page
    assert "They are not the axis" in page
    pending = TwinFile.load(profile / "pending-twin.yaml").truth
    assert pending.provenance["values"] == "replay"
    assert pending.intervals == {}


def test_a_twin_whose_legs_disagree_replays_only(profile: Path, run: Run) -> None:
    said, report, _ = run(fitted(TRUTH, "replay", 0.9, scatter=16.0))
    assert "but its values are not the axis's: the legs disagree about its parameters: 4 times their" in said
    assert [each["explained"] for each in report["left"]] == [True]


def test_implausible_values_are_refused(profile: Path, run: Run) -> None:
    for values, complaint in (
        ({"friction feed-forward": 3.0}, "friction feed-forward 3 Nm; expected at most the friction"),
        ({"motor inertia": 1e-3}, "motor inertia 0.001 kg m2; expected within a decade"),
        ({"load inertia": 10.0}, "load inertia seen by the motor"),
    ):
        said, *_ = run(fitted(with_values(TRUTH, values), "replay"))
        assert said.startswith("The twin is not kept: no axis has these values:")
        assert complaint in said
        assert not (profile / "pending-twin.yaml").exists()
    late = with_values(TRUTH, {"servo dead time": 5.0})
    assert impossible(late, AXIS, 0.0025) == ()
    assert impossible(late, AXIS, 0.002) == ("dead time 5 ms; expected at most two cycles, 4",)


def test_from_usual_values_a_fit_gives_estimates_and_no_changes(run: Run) -> None:
    said, report, _ = run(fitted(TRUTH), "--afresh")
    assert "estimate: Coulomb friction 0.034 Nm (0.033 to 0.035)" in said
    assert "->" not in said
    (friction,) = report["parameters"]
    assert friction["before"] is None


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_an_axis_is_learned_and_a_later_change_of_it_is_named(profile: Path) -> None:
    """Runs the whole procedure including the fit, some 150 seconds of CPU time."""
    recording = trips(TRUTH, profile / "recording")
    run_here(profile, "twin", profile, recording)
    learned = TwinFile.load(profile / "pending-twin.yaml").truth
    lower, upper = learned.intervals["motor.coulomb_nm"]
    assert lower < 0.036
    assert upper > 0.032
    assert learned.motor.coulomb_nm == pytest.approx(0.034, rel=0.1)
    assert learned.motor.inertia_kg_m2 == pytest.approx(3.4e-5, rel=0.3)
    run_here(profile, "model", "commit", profile, "--twin")
    same = run_here(profile, "twin", profile, recording, "--check")
    assert same.stdout.startswith("Nothing has changed since the twin was made")
    later = trips(with_values(TRUTH, {"Coulomb friction": 0.068}), profile / "later")
    changed = run_here(profile, "twin", profile, later, "--check")
    assert "friction" in changed.stdout
