"""The blind suites: generation, judgement and tables."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind import axes, generate, score, tables, work
from blind import case as blindcase
from blind.case import Case, cases, make, record_of, unsealed
from blind.plant import PlantRig
from blind.verdict import Answer, Verdict, judged
from hypothesis import given
from hypothesis import strategies as st

from hdbridge import AxisConfig, Bench, Recording, Stepping, TransmissionModel, simulated
from hdbridge.files.profile import bundled_profile
from hdbridge.sim.truth import Truth

PLAN = """
schema: hdbridge.plan/1
name: tiny
reference_s: 0.3
procedures:
  - {procedure: standstill, duration_s: 1}
  - {procedure: sweep, motor_turns: 3, motor_turns_per_s: 0.5}
  - {procedure: sines, amplitudes_deg: [60, 10], frequency_hz: 0.1, periods: 2}
"""


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bench suite with a bench of half a minute."""
    drawn_plan = blindcase.drawn_plan

    def shorter(*arguments: Any) -> Any:
        changes = {"sweep_turns": 2.0, "slow_turns": 0.3, "sine_periods": 0.05, "steps": 1, "still_s": 0.5}
        return dataclasses.replace(drawn_plan(*arguments), **changes, depths_deg=(2.0,), holds_deg=())

    monkeypatch.setattr(blindcase, "drawn_plan", shorter)


def shorten(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Shortens everyday suites to some seconds of work and a calibration of a minute."""
    plan = folder / "tiny.yaml"
    plan.write_text(PLAN)
    axis_of = blindcase.axis_of
    monkeypatch.setattr(
        blindcase, "axis_of", lambda *which: dataclasses.replace(axis_of(*which), plan=str(plan))
    )
    monkeypatch.setattr(work, "LONGEST_S", 11.0)
    monkeypatch.setattr(work, "KINDS", ("moves", "daemon"))
    monkeypatch.setattr(blindcase, "WORK_KINDS", ("moves",))
    monkeypatch.setattr(blindcase, "SLOW_S", 10.0)


FILES = ("record.csv", "model.yaml", "sealed.json")


def contents(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in FILES]


@pytest.mark.usefixtures("short")
def test_a_case_is_reproducible_bit_for_bit(tmp_path: Path) -> None:
    case = Case("pair-007", "pair", ("wear", "count_loss"))
    first = contents(make(case, 5, tmp_path / "a"))
    assert contents(make(case, 5, tmp_path / "b")) == first
    other = contents(make(case, 6, tmp_path / "c"))
    assert all(here != there for here, there in zip(first, other, strict=True))


@pytest.mark.usefixtures("short")
def test_a_case_of_the_bench_suite_is_a_record_with_its_model_and_its_secret(tmp_path: Path) -> None:
    folder = make(Case("single-x", "single", ("compliance",)), 1, tmp_path)
    rows = np.genfromtxt(folder / "record.csv", delimiter=",", names=True)
    assert rows.dtype.names == (
        "time_s", "motor_position_deg", "load_position_deg", "motor_target_deg", "load_torque_nm",
        "motor_torque_nm", "temperature_c",
    )  # fmt: skip
    assert np.allclose(np.diff(rows["time_s"]), 0.02)
    secret = unsealed(folder)
    truth = Truth.model_validate(secret["truth"])
    error_deg = rows["load_position_deg"] - rows["motor_target_deg"] / truth.gear.ratio
    assert np.max(np.abs(error_deg)) * 3600.0 < 400.0
    assert TransmissionModel.load(folder / "model.yaml").ratio == truth.gear.ratio
    assert [each["cause"] for each in secret["hidden"]] == ["compliance"]
    assert secret["samples"] == len(rows)
    assert truth.load_.gravity is not None
    assert "compliance" not in (folder / "sealed.json").read_text()


def test_a_suite_has_the_requested_cases() -> None:
    wanted = {"single": 2, "pair": 40, "unknown": 4, "none": 3, "fault": 46, "flicker": 4}
    suite = list(cases(wanted, 1))
    kinds = [each.kind for each in suite]
    assert [kinds.count(each) for each in wanted] == [46, 40, 4, 3, 46, 8]
    assert len({each.name for each in suite}) == len(suite)
    pairs = [set(each.causes) for each in suite if each.kind == "pair"]
    assert all(len(each) == 2 and {"load_order", "compliance"} != each for each in pairs)
    assert len({each.causes for each in suite if each.kind == "unknown"}) == 4
    faults = [each for each in suite if each.kind == "fault"]
    assert len({each.causes for each in faults}) == 23
    assert len({each.axis for each in faults}) >= len(faults) / 5
    assert suite == list(cases(wanted, 1))
    # A larger suite of the same seed contains the smaller one, so a suite can be extended.
    assert set(cases({"fault": 10}, 1)) < set(cases({"fault": 20}, 1))
    with pytest.raises(ValueError, match="found 'singles'"):
        list(cases({"singles": 1}, 1))


def test_folders_of_a_held_out_suite_reveal_nothing(tmp_path: Path) -> None:
    (case,) = cases({"law": 1}, 1)
    assert case.folder(tmp_path, 999).name == "law-000"
    assert "law" not in case.folder(tmp_path, 1000).name
    assert case.folder(tmp_path, 1000) != case.folder(tmp_path, 1001)


def test_a_procedure_measures_the_same_without_a_bus_as_over_frames() -> None:
    profile = bundled_profile("article")
    axis, steps = AxisConfig.load(profile), Stepping(count=2)
    with simulated(axis) as drive:
        drive.boot()
        over_frames = Bench(drive).run(steps)
    bare = axes.EverydayAxis(axis, Truth.load(profile), "rolling_friction", 0.0, "quick")
    without = PlantRig(bare, 0).bench().run(steps)
    for one, other in zip(over_frames.outcome.cw, without.outcome.cw, strict=True):
        assert one.error_arcsec == pytest.approx(other.error_arcsec, abs=0.1)
    assert [each.kind for each in without.segments] == [each.kind for each in over_frames.segments]


def test_an_everyday_case_has_a_calibrated_model_its_cause_and_a_fresh_record(monkeypatch, tmp_path):
    """The record is one of work in which counts are lost; the fresh one has other noise only."""
    shorten(monkeypatch, tmp_path)
    folder = make(Case("fault-000", "fault", ("count_loss",), axis="fault-000"), 2, tmp_path / "a")
    secret = unsealed(folder)
    model = TransmissionModel.load(folder / "model.yaml")
    (offset,) = (each.parameters()["offset_arcsec"] for each in model.effects if each.name == "hysteresis")
    true = secret["truth"]["gear"]["hysteresis"]["offset_arcsec"]
    assert offset == pytest.approx(true, rel=0.2)
    assert offset != true
    (hidden,) = secret["hidden"]
    # Relative to its mean, the size of a step is between half and all of the stated size.
    assert 0.4 < secret["effect"]["peak_arcsec"] / hidden["size_arcsec"] < 1.1
    record, fresh = (Recording.load(*record_of(folder, name)).record for name in ("record", "fresh"))
    assert record.time_s[0] < hidden["parameters"]["time_s"] < record.time_s[-1]
    assert np.array_equal(record.time_s, fresh.time_s)
    noise = np.std(record.load_position_deg - fresh.load_position_deg) * 3600.0
    assert 0.0 < noise < 3.0 * secret["noise_arcsec"]


def test_a_suite_is_continued_and_belongs_to_one_seed(monkeypatch, tmp_path, capsys):
    made: list[str] = []

    def fake(case: Case, seed: int, out: Path) -> None:
        if case.name == "none-002":
            raise RuntimeError("no such axis")
        made.append(case.name)
        case.folder(out, seed).mkdir(parents=True)

    monkeypatch.setattr(generate, "make", fake)
    group = list(cases({"none": 4}, 1))
    generate.made(group[:2], 1, tmp_path)
    done = generate.made(group, 1, tmp_path)
    assert made == ["none-000", "none-001", "none-003"]
    assert [name for name, seconds in done if np.isnan(seconds)] == ["none-002"]
    assert "no such axis" in capsys.readouterr().err
    generate.claim(tmp_path, 1)
    generate.claim(tmp_path, 1)
    with pytest.raises(ValueError, match="seed 1"):
        generate.claim(tmp_path, 2)


def secret(*causes: str, also: tuple[str, ...] = (), kind: str = "single", **parameters: float) -> Any:
    return {
        "case": "a case",
        "kind": kind,
        "family": blindcase.KINDS[kind],
        "noise_arcsec": 1.0,
        "samples": 50_000,
        "hidden": [{"cause": each, "size_arcsec": 3.0, "parameters": parameters} for each in causes],
        "also": list(also),
    }


def finding(cause: str, *aliases: str, probability: float = 0.9, **parameters: Any) -> Any:
    return {
        "cause": cause,
        "probability": probability,
        "aliases": list(aliases),
        "parameters": parameters,
        "gain": {"held_out_rms_before_arcsec": 3.0, "held_out_rms_after_arcsec": 1.0},
    }


def document(*findings: Any) -> Any:
    return {"schema": "hdbridge.diagnosis/1", "findings": list(findings), "extended": {"rms_arcsec": 1.1}}


def verdict(hidden: Any, *findings: Any, model: Any = None, **answer: Any) -> Verdict:
    return judged(hidden, Answer(document(*findings), **answer), model)


@pytest.mark.parametrize(
    ("hidden", "findings", "first", "names", "wrong"),
    [
        (secret("wear"), [finding("wear")], "right", True, ()),
        (secret("wear"), [finding("ratio_error", "wear")], "right", False, ()),
        (secret("wear"), [finding("ratio_error")], "wrong", False, ("ratio_error",)),
        (secret("wear"), [], "nothing", False, ()),
        (secret("wear"), [finding("unexplained")], "unexplained", False, ()),
        (secret("wear"), [finding("unexplained"), finding("wear")], "unexplained", False, ()),
        (secret("wear"), [finding("wear"), finding("creep")], "right", True, ("creep",)),
        (secret("wear"), [finding("wear"), finding("ratio_error", "wear")], "right", True, ("ratio_error",)),
        (secret("wear"), [finding("creep", probability=0.5), finding("wear")], "right", True, ()),
        (secret("wear"), [finding("wear", probability=0.5)], "nothing", False, ()),
        (secret("wear", also=("creep",)), [finding("creep"), finding("wear")], "right", True, ()),
        (secret(kind="none"), [], "nothing", False, ()),
        (secret(kind="none"), [finding("backlash")], "wrong", False, ("backlash",)),
        (secret(kind="none", also=("backlash",)), [finding("backlash")], "nothing", False, ()),
        (secret(kind="law"), [finding("hysteresis_memory")], "right", True, ()),
        (secret(kind="law"), [finding("hysteresis_parameters")], "wrong", False, ("hysteresis_parameters",)),
        (secret("unexplained", kind="unknown"), [finding("unexplained")], "unexplained", False, ()),
        (secret("unexplained", kind="unknown"), [finding("creep")], "wrong", False, ("creep",)),
    ],
)
def test_a_case_is_judged_by_its_findings(hidden, findings, first, names, wrong):
    found = verdict(hidden, *findings)
    assert (found.first, found.first_names_it, found.wrong) == (first, names, wrong)


def test_several_causes_are_matched_once_each() -> None:
    hidden = secret("wear", "creep", kind="pair")
    both = verdict(hidden, finding("creep"), finding("ratio_error", "wear"))
    assert both.met == ("creep", "wear")
    assert both.wrong == ()
    one = verdict(hidden, finding("creep"), finding("vibration"))
    assert one.met == ("creep",)
    assert one.wrong == ("vibration",)


@pytest.mark.parametrize(
    ("reported", "peak_arcsec", "detectable"),
    [
        ({"wear": {"detectable": True, "detection_limit_arcsec": 1.0}}, 2.0, True),
        ({"wear": {"detectable": True, "detection_limit_arcsec": 3.0}}, 2.0, False),
        ({"wear": {"detectable": False, "detection_limit_arcsec": None}}, 2.0, False),
        # A ratio error is the structural twin of wear.
        ({"ratio_error": {"detectable": True, "detection_limit_arcsec": 1.0}}, 2.0, True),
        ({"creep": {"detectable": True, "detection_limit_arcsec": 1.0}}, 2.0, False),
    ],
)
def test_detectability_follows_the_reported_limit(reported, peak_arcsec, detectable):
    hidden = {**secret("wear", kind="fault"), "effect": {"peak_arcsec": peak_arcsec, "rms_arcsec": 0.5}}
    found = judged(hidden, Answer({**document(), "identifiability": reported}))
    assert found.detectable is detectable
    assert found.effect_over_noise == 0.5


def test_a_claimed_gain_is_checked_on_a_fresh_record() -> None:
    fresh = {
        "fresh_given": {"baseline": {"rms_arcsec": 3.1}},
        "fresh_extended": {"baseline": {"rms_arcsec": 1.21}},
    }
    found = verdict(secret("wear"), finding("wear"), **fresh)
    assert found.fresh_gain == pytest.approx((3.1**2 - 1.21**2) ** 0.5 / 8.0**0.5)
    assert found.fresh_left == pytest.approx(1.1)
    both = verdict(secret("wear"), finding("wear"), finding("creep"), **fresh)
    assert both.fresh_gain is None
    assert both.fresh_left == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("cause", "effects", "unwritten"),
    [
        ("wear", {"hysteresis": 20.0, "wear": 1.0}, ()),
        ("wear", {"hysteresis": 21.0}, ("wear",)),
        ("hysteresis_parameters", {"hysteresis": 21.0}, ()),
        ("hysteresis_parameters", {"hysteresis": 20.0}, ("hysteresis_parameters",)),
    ],
)
def test_named_causes_are_looked_up_in_the_written_model(cause, effects, unwritten):
    def model(values: dict[str, float]) -> Any:
        return {"effects": [{"effect": name, "parameters": {"x": each}} for name, each in values.items()]}

    given = model({"hysteresis": 20.0})
    found = verdict(secret("wear"), finding(cause), model=given, extended=model(effects))
    assert found.unwritten == unwritten


def test_parameters_are_compared_where_both_have_them() -> None:
    hidden = secret("channel_skew", delay_ms=-0.5)  # the age of the load's sample
    late = {"value": 0.55, "unit": "ms", "ci95": [0.45, 0.65]}
    found = verdict(hidden, finding("channel_skew", delay_ms=late))
    assert [(each.true, each.covered) for each in found.compared] == [(0.5, True)]
    assert found.compared[0].error == pytest.approx(0.1)
    early = {"value": -0.7, "unit": "ms", "ci95": [-0.8, -0.6]}
    found = verdict(hidden, finding("channel_skew", delay_ms=early))
    assert [each.covered for each in found.compared] == [False]
    assert verdict(hidden, finding("velocity_windup", delay_ms=late)).compared == ()


def value(value: float, half: float = 0.1) -> dict[str, Any]:
    return {"value": value, "ci95": [value - half, value + half]}


def test_friction_of_the_load_is_part_of_the_loop() -> None:
    """0.4 Nm on 206,265 Nm/rad wind the gear up by 0.4 arcsec, against the direction of motion."""
    hidden = secret("hysteresis_parameters", offset_arcsec=20.0, width_deg=10.0)
    truth = {"gear": {"stiffness_nm_per_rad": 206_264.8}, "load": {"coulomb_nm": 0.4}}
    found = finding("hysteresis_parameters", offset_arcsec=value(19.6), width_deg=value(10.0))
    compared = verdict({**hidden, "truth": truth}, found).compared
    assert {each.name: each.true for each in compared} == pytest.approx(
        {"offset_arcsec": 19.6, "width_deg": 10.0}
    )


def test_motor_order_changes_are_relative_to_the_given_model() -> None:
    hidden = secret("motor_encoder_eccentricity", amplitude_arcsec=2.0, second_arcsec=0.0)
    disc = {"radius_mm": 20.0, "eccentricity_um": 20e3 * 2.0 * 50 / 206264.8, "eccentric_at_deg": 30.0}
    truth = {
        "gear": {"ratio": 50.0, "motor_orders": [{"order": 1, "amplitude_arcsec": 3.0, "phase_deg": 60.0}]},
        "motor": {"encoder": {"disc": disc}},
    }
    given = {"orders": [{"order": 1, "amplitude_arcsec": 1.0, "phase_deg": 60.0}]}
    model = {"effects": [{"effect": "synchronous", "parameters": given}]}
    found = finding("motor_order", order_1_amplitude_arcsec=value(4.05), order_1_phase_deg=value(420.05))
    compared = verdict({**hidden, "truth": truth}, found, model=model).compared
    # The disc's -2 sin(a - 30) is 2 cos(a + 60), in phase with the 3 - 1 that is missing in the model.
    assert [each.true for each in compared] == pytest.approx([4.0, 420.0], abs=1e-3)
    assert all(each.covered for each in compared)


STAND_IN = """
import json, sys
from pathlib import Path
case = Path(sys.argv[1]).parent
if "broken" in case.name or "refused" in case.name:
    print("error: no such thing", file=sys.stderr)
    raise SystemExit(3 if "broken" in case.name else 2)
says = json.loads((case / "says.json").read_text())
extended = "extended" in sys.argv[sys.argv.index("--model") + 1]
rms = 1.0 if extended else 3.0
answer = {
    "schema": "hdbridge.diagnosis/1", "findings": says, "baseline": {"rms_arcsec": rms},
    "extended": {"rms_arcsec": 1.0},
}
Path(sys.argv[sys.argv.index("--json") + 1]).write_text(json.dumps(answer))
if "--extend" in sys.argv:
    text = json.dumps({"effects": [{"effect": each["cause"], "parameters": {}} for each in says]})
    Path(sys.argv[sys.argv.index("--extend") + 1]).write_text(text)
with (case / "runs").open("a") as file:
    file.write(Path(sys.argv[1]).name + "\\n")
"""


@pytest.fixture
def command(tmp_path: Path) -> str:
    """Command of a stand-in diagnosis, which prints the file next to the record."""
    path = tmp_path / "stand_in.py"
    path.write_text(STAND_IN)
    return f"{sys.executable} {path}"


def suite(folder: Path, cases: dict[str, tuple[Any, list[Any]]], seed: int = 1) -> None:
    folder.mkdir()
    generate.claim(folder, seed)
    for name, (hidden, findings) in cases.items():
        case = folder / name
        case.mkdir()
        blindcase.seal(case, seed, {**hidden, "case": name})
        (case / "says.json").write_text(json.dumps(findings))
        for record in ("record.csv", "fresh.csv") if hidden["hidden"] else ("record.csv",):
            (case / record).touch()


def test_a_suite_is_diagnosed_in_processes_and_reported_in_tables(tmp_path, command, capsys):
    folder = tmp_path / "suite"
    fault = secret("creep", kind="fault")
    suite(
        folder,
        {
            "a": (secret("wear"), [finding("wear", probability=0.97)]),
            "b": (secret("creep"), [finding("vibration", probability=0.6)]),
            "c": (secret(kind="none"), []),
            "d": (secret("wear", "creep", kind="pair"), [finding("wear"), finding("backlash")]),
            "e": (secret("unexplained", kind="unknown"), [finding("unexplained")]),
            "g": (secret(kind="healthy_work"), [finding("count_loss")]),
            "h": ({**fault, "effect": {"peak_arcsec": 2.0, "rms_arcsec": 1.5}}, [finding("creep")]),
            "refused": (secret(kind="healthy_work"), []),
        },
    )
    assert score.main([str(folder), "--command", command]) == 0
    said = capsys.readouterr().out
    for line in (
        "8 cases of seed 1 (development)",
        "| single: right first | 1 / 2 (50.0 %; 9.5 to 90.5) | 99 % |",
        "| single: wrong first | 1 / 2 (50.0 %; 9.5 to 90.5) |",
        "| nothing hidden: silent | 1 / 1 (100.0 %; 20.7 to 100.0) |",
        "| unknown: unexplained leads | 1 / 1 (100.0 %; 20.7 to 100.0) |",
        "| pair: recall | 1 / 2 (50.0 %; 9.5 to 90.5) | 97 % |",
        "| pair: precision | 1 / 2 (50.0 %; 9.5 to 90.5) | 97 % |",
        "| healthy, work: false name | 1 / 2 (50.0 %; 9.5 to 90.5) | at most 1 % |",
        "| one fault: right first | 1 / 1 (100.0 %; 20.7 to 100.0) |",
        "| a finding's gain holds on a fresh record | 1 / 1 (100.0 %; 20.7 to 100.0) | all |",
        "| refused | 1 / 3 (33.3 %; 6.1 to 79.2) |",
        "| 1 to 3 | 0 / 1 (0.0 %; 0.0 to 79.3) | 1 / 1 (100.0 %; 20.7 to 100.0) |",
    ):
        assert line in said, said
    assert "| d |" not in said
    assert score.main([str(folder), "--command", command, "--cases"]) == 0
    assert "| d | wear, creep | wear, backlash | missed creep; wrong backlash |" in capsys.readouterr().out
    # Once each; the fresh record only if a hidden cause was named.
    runs = {path.parent.name: path.read_text().split() for path in folder.glob("*/runs")}
    assert runs["a"] == ["record.csv", "fresh.csv", "fresh.csv"]
    assert runs["c"] == runs["e"] == runs["g"] == ["record.csv"]


def test_answers_are_kept_and_failures_reported(tmp_path, command, capsys):
    folder, answers = tmp_path / "suite", tmp_path / "before"
    suite(folder, {"broken": (secret("wear"), [])})
    arguments = [str(folder), "--answers", str(answers), "--cases"]
    assert score.main([*arguments, "--command", command]) == 1
    assert "| broken | wear | - | exit status 3; missed wear |" in capsys.readouterr().out
    assert "no such thing" in (answers / "broken" / "answer.json").read_text()
    assert score.main([*arguments, "--command", "/no/such/command"]) == 1
    assert score.main([str(tmp_path / "empty")]) == 2


def test_the_cases_of_a_held_out_suite_are_not_listed(tmp_path, command, capsys):
    folder = tmp_path / "suite"
    suite(folder, {"a": (secret("wear"), [finding("creep")])}, seed=1000)
    assert score.main([str(folder), "--command", command, "--cases"]) == 2
    said = capsys.readouterr()
    assert "held out" in said.err
    assert not said.out
    assert score.main([str(folder), "--command", command]) == 0
    assert "| single: wrong first | 1 / 1 (100.0 %; 20.7 to 100.0) |" in capsys.readouterr().out


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=40))
def test_every_name_is_counted_once_and_the_brier_score_is_right(pairs: list[tuple[float, bool]]) -> None:
    counts = [row[2].split(" (")[0].split(" / ") for row in tables.calibration(pairs)]
    assert sum(int(every) for _, every in counts) == len(pairs)
    assert sum(int(right) for right, _ in counts) == sum(right for _, right in pairs)
    score, number = tables.brier(pairs)[1].split(" of ")
    squares = [(chance - right) ** 2 for chance, right in pairs]
    assert float(score) == pytest.approx(sum(squares) / len(squares), abs=6e-4)
    assert int(number) == len(pairs)
