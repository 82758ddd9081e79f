"""The blind suite's generator and its scoring, the latter on answers made by hand."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

from hdbridge.model import TransmissionModel
from hdbridge.sim.truth import Truth

TOOLS = Path(__file__).parents[2] / "tools" / "blind"


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The suite's modules, by name."""
    monkeypatch.syspath_prepend(str(TOOLS))

    def load(name: str) -> ModuleType:
        return __import__(name)

    return load


@pytest.fixture
def short(tools: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`blindcase` with a bench of half a minute."""
    blindcase = tools("blindcase")
    drawn_plan = blindcase.drawn_plan

    def shorter(*arguments: Any) -> Any:
        changes = {"sweep_turns": 2.0, "slow_turns": 0.3, "sine_periods": 0.05, "steps": 1, "still_s": 0.5}
        return dataclasses.replace(drawn_plan(*arguments), **changes, depths_deg=(2.0,), holds_deg=())

    monkeypatch.setattr(blindcase, "drawn_plan", shorter)
    return blindcase


FILES = ("record.csv", "model.yaml", "hidden.yaml", "truth.yaml")


def contents(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in FILES]


def test_a_case_is_made_again_bit_for_bit_from_its_seed_and_name(short: Any, tmp_path: Path) -> None:
    case = short.Case("pair-007", "pair", ("wear", "count_loss"))
    first = contents(short.make(case, 5, tmp_path / "a"))
    assert contents(short.make(case, 5, tmp_path / "b")) == first
    other = contents(short.make(case, 6, tmp_path / "c"))
    assert all(here != there for here, there in zip(first, other, strict=True))


def test_a_case_is_a_record_with_its_model_and_its_secret(short: Any, tmp_path: Path) -> None:
    folder = short.make(short.Case("single-x", "single", ("compliance",)), 1, tmp_path)
    rows = np.genfromtxt(folder / "record.csv", delimiter=",", names=True)
    assert rows.dtype.names == (
        "time_s", "motor_position_deg", "load_position_deg", "motor_target_deg", "load_torque_nm",
        "motor_torque_nm", "temperature_c",
    )  # fmt: skip
    assert np.allclose(np.diff(rows["time_s"]), 0.02)
    truth = Truth.load(folder / "truth.yaml")
    error_deg = rows["load_position_deg"] - rows["motor_target_deg"] / truth.gear.ratio
    assert np.max(np.abs(error_deg)) * 3600.0 < 400.0
    model = TransmissionModel.load(folder / "model.yaml")
    assert model.ratio == truth.gear.ratio
    secret = yaml.safe_load((folder / "hidden.yaml").read_text())
    assert [each["cause"] for each in secret["hidden"]] == ["compliance"]
    assert secret["hidden"][0]["twins"] == ["load_order"]
    assert secret["samples"] == len(rows)
    assert truth.load_.gravity is not None


def test_without_a_torque_channel_there_is_no_such_column(short: Any, tmp_path: Path) -> None:
    folder = short.make(short.Case("no_torque-000", "no_torque", ("load_order",)), 1, tmp_path)
    with (folder / "record.csv").open() as file:
        assert "load_torque_nm" not in file.readline()


def test_a_suite_has_the_cases_asked_for(tools: Any) -> None:
    blindcase = tools("blindcase")
    suite = list(blindcase.cases({"single": 2, "power": 1, "pair": 40, "unknown": 4, "none": 3}, 1))
    kinds = [each.kind for each in suite]
    assert [kinds.count(each) for each in ("single", "power", "pair", "unknown", "none")] == [
        46,
        92,
        40,
        4,
        3,
    ]
    assert len({each.name for each in suite}) == len(suite)
    pairs = [set(each.causes) for each in suite if each.kind == "pair"]
    assert all(len(each) == 2 and {"load_order", "compliance"} != each for each in pairs)
    assert len({each.causes for each in suite if each.kind == "unknown"}) == 4
    assert suite == list(blindcase.cases({"single": 2, "power": 1, "pair": 40, "unknown": 4, "none": 3}, 1))
    with pytest.raises(ValueError, match="found 'singles'"):
        list(blindcase.cases({"singles": 1}, 1))


@pytest.mark.parametrize("law", ["maxwell_slip", "bouc_wen", "dahl", "rolling_friction"])
def test_the_model_s_loop_is_near_the_plant_s_whatever_its_law(tools: Any, law: str) -> None:
    import random

    blindaxis = tools("blindaxis")
    axis = blindaxis.drawn_axis(random.Random(4), "x", law)
    offset, width, exponent = blindaxis.nearest_loop(axis.truth)
    model = yaml.safe_load(axis.model_yaml)
    believed = model["effects"][1]["parameters"]
    assert believed["offset_arcsec"] == pytest.approx(offset, rel=0.12)
    assert believed["width_deg"] == pytest.approx(width, rel=0.15)
    assert believed["exponent"] == pytest.approx(exponent, abs=0.08)
    assert believed["offset_arcsec"] != offset


def secret(*causes: str, also: tuple[str, ...] = (), kind: str = "single", **parameters: float) -> Any:
    return {
        "case": "a case",
        "kind": kind,
        "law": "rolling_friction",
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


def answer(*findings: Any) -> Any:
    return {"schema": "hdbridge.diagnosis/1", "findings": list(findings), "extended": {"rms_arcsec": 1.1}}


@pytest.mark.parametrize(
    ("hidden", "findings", "right", "names", "wrong", "unexplained"),
    [
        (secret("wear"), [finding("wear")], True, True, (), False),
        (secret("wear"), [finding("ratio_error", "wear")], True, False, (), False),
        (secret("wear"), [finding("ratio_error")], False, False, ("ratio_error",), False),
        (secret("wear"), [], False, False, (), False),
        (secret("wear"), [finding("unexplained")], False, False, (), True),
        (secret("wear"), [finding("unexplained"), finding("wear")], False, False, (), True),
        (secret("wear"), [finding("wear"), finding("creep")], True, True, ("creep",), False),
        (
            secret("wear"),
            [finding("wear"), finding("ratio_error", "wear")],
            True,
            True,
            ("ratio_error",),
            False,
        ),
        (secret("wear", also=("creep",)), [finding("creep"), finding("wear")], True, True, (), False),
        (secret(kind="none"), [], False, False, (), False),
        (secret(kind="none"), [finding("backlash")], False, False, ("backlash",), False),
        (secret(kind="none", also=("backlash",)), [finding("backlash")], False, False, (), False),
        (secret("unexplained", kind="unknown"), [finding("unexplained")], False, False, (), True),
        (secret("unexplained", kind="unknown"), [finding("creep")], False, False, ("creep",), False),
    ],
)
def test_a_case_is_judged_by_what_its_findings_name(
    tools: Any,
    hidden: Any,
    findings: Any,
    right: bool,
    names: bool,
    wrong: tuple[str, ...],
    unexplained: bool,
) -> None:
    verdict = tools("blindscore").judged(hidden, answer(*findings), 5.0)
    assert (verdict.first_is_right, verdict.first_names_it) == (right, names)
    assert verdict.wrong == wrong
    assert verdict.unexplained == unexplained
    assert verdict.unexplained_leads == (bool(findings) and findings[0]["cause"] == "unexplained")


def test_several_causes_are_met_once_each(tools: Any) -> None:
    judged = tools("blindscore").judged
    hidden = secret("wear", "creep", kind="pair")
    both = judged(hidden, answer(finding("creep"), finding("ratio_error", "wear")), 1.0)
    assert both.met == ("creep", "wear")
    assert both.wrong == ()
    one = judged(hidden, answer(finding("creep"), finding("vibration")), 1.0)
    assert one.met == ("creep",)
    assert one.wrong == ("vibration",)


def test_parameters_are_compared_where_both_have_them(tools: Any) -> None:
    judged = tools("blindscore").judged
    hidden = secret("channel_skew", delay_ms=-0.5)  # the age of the load's sample
    late = {"value": 0.55, "unit": "ms", "ci95": [0.45, 0.65]}
    verdict = judged(hidden, answer(finding("channel_skew", delay_ms=late)), 1.0)
    assert [(each.true, each.covered) for each in verdict.compared] == [(0.5, True)]
    assert verdict.compared[0].error == pytest.approx(0.1)
    early = {"value": -0.7, "unit": "ms", "ci95": [-0.8, -0.6]}
    verdict = judged(hidden, answer(finding("channel_skew", delay_ms=early)), 1.0)
    assert [each.covered for each in verdict.compared] == [False]
    verdict = judged(hidden, answer(finding("velocity_windup", delay_ms=late)), 1.0)
    assert verdict.compared == ()


def value(value: float, half: float = 0.1) -> dict[str, Any]:
    return {"value": value, "ci95": [value - half, value + half]}


def test_a_change_of_a_motor_order_is_that_against_the_given_model(tools: Any) -> None:
    hidden = secret("motor_encoder_eccentricity", amplitude_arcsec=2.0, second_arcsec=0.0)
    disc = {"radius_mm": 20.0, "eccentricity_um": 20e3 * 2.0 * 50 / 206264.8, "eccentric_at_deg": 30.0}
    truth = {
        "gear": {"ratio": 50.0, "motor_orders": [{"order": 1, "amplitude_arcsec": 3.0, "phase_deg": 60.0}]},
        "motor": {"encoder": {"disc": disc}},
    }
    given = {"orders": [{"order": 1, "amplitude_arcsec": 1.0, "phase_deg": 60.0}]}
    model = {"effects": [{"effect": "synchronous", "parameters": given}]}
    found = finding("motor_order", order_1_amplitude_arcsec=value(4.05), order_1_phase_deg=value(420.05))
    verdict = tools("blindscore").judged(hidden, answer(found), 1.0, "", truth, model)
    # The disc's -2 sin(a - 30) is 2 cos(a + 60), in phase with the 3 - 1 that the model is short of.
    assert [each.true for each in verdict.compared] == pytest.approx([4.0, 420.0], abs=1e-3)
    assert all(each.covered for each in verdict.compared)


def test_a_spring_is_compared_as_soft_as_a_cause_hidden_after_it_has_left_it(tools: Any) -> None:
    hidden = secret("compliance", compliance_arcsec_per_nm=0.5, stiffness_nm_per_rad=412529.6)
    truth = {"gear": {"stiffness_nm_per_rad": 206264.8}}
    found = answer(finding("compliance", c1_arcsec_per_nm=value(1.0)))
    (compared,) = tools("blindscore").judged(hidden, found, 1.0, "", truth, {}).compared
    assert compared.true == pytest.approx(1.0)


def test_an_interpolation_error_is_compared_by_its_harmonics_and_not_by_its_signals(tools: Any) -> None:
    signals = {"lines_per_turn": 2000, "sine_offset": 0.1, "gain_mismatch": 0.2}
    names = [f"order_{order}_amplitude_arcsec" for order in (1, 2)]
    hidden, truth = (
        secret("subdivisional_error", lines_per_turn=2000),
        {"load": {"encoder": {"signals": signals}}},
    )
    found = finding("subdivisional_error", **dict.fromkeys(names, value(10.0)))
    compared = tools("blindscore").judged(hidden, answer(found), 1.0, "", truth, {}).compared
    # The reading is the angle of exp(i p) (1 + u z + w z^2), z = exp(-i p), to u z + (w - u^2 / 2) z^2.
    u, w = 0.1 / 1.1, 0.1 / 1.1
    expected = [u * 206264.8 / 2000, (w - 0.5 * u**2) * 206264.8 / 2000]
    assert [each.true for each in compared] == pytest.approx(expected, rel=1e-6)


def test_growths_are_compared_in_per_cent_and_springs_as_compliances(tools: Any) -> None:
    judged = tools("blindscore").judged
    hidden = secret("torque_modulation", also=("compliance",), growth_per_nm=0.03)
    truth = {"gear": {"stiffness_nm_per_rad": 206264.8}}
    found = [
        finding("torque_modulation", growth_percent_per_nm=value(3.05)),
        finding("compliance", c1_arcsec_per_nm=value(1.2)),
    ]
    compared = judged(hidden, answer(*found), 1.0, "", truth, {}).compared
    assert {each.name: (pytest.approx(each.true), each.covered) for each in compared} == {
        "growth_percent_per_nm": (3.0, True),
        "c1_arcsec_per_nm": (1.0, False),
    }


def test_of_several_lost_counts_the_one_nearest_in_time_is_compared(tools: Any) -> None:
    hidden = secret("count_loss", time_s=100.0, step_arcsec=5.0)
    steps = {
        "step_1_time_s": value(30.0),
        "step_1_size_arcsec": value(0.5),
        "step_2_time_s": value(100.05),
        "step_2_size_arcsec": value(5.02),
    }
    compared = tools("blindscore").judged(hidden, answer(finding("count_loss", **steps)), 1.0).compared
    assert {each.name for each in compared} == {"step_2_time_s", "step_2_size_arcsec"}
    assert all(each.covered for each in compared)


def test_the_share_recovered_is_that_of_what_the_noise_leaves(tools: Any) -> None:
    recovered = finding("wear")
    recovered["gain"]["held_out_rms_after_arcsec"] = 1.5
    verdict = tools("blindscore").judged(secret("wear"), answer(recovered), 1.0)
    assert verdict.recovered == pytest.approx((9.0 - 2.25) / (9.0 - 1.0))
    assert verdict.rms_over_noise == pytest.approx(1.1)


STAND_IN = """
import json, sys
from pathlib import Path
case = Path(sys.argv[1]).parent
if "broken" in case.name:
    print("error: no such thing", file=sys.stderr)
    raise SystemExit(2)
name = json.loads((case / "says.json").read_text())
answer = {"schema": "hdbridge.diagnosis/1", "findings": name, "extended": {"rms_arcsec": 1.0}}
Path(sys.argv[sys.argv.index("--json") + 1]).write_text(json.dumps(answer))
"""


def suite(folder: Path, cases: dict[str, tuple[Any, list[Any]]]) -> None:
    for name, (hidden, findings) in cases.items():
        case = folder / name
        case.mkdir(parents=True)
        (case / "hidden.yaml").write_text(yaml.safe_dump({**hidden, "case": name}))
        (case / "says.json").write_text(json.dumps(findings))


def test_a_suite_is_diagnosed_in_processes_and_told_in_tables(
    tools: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "suite"
    power = {**secret("creep", kind="power"), "over_noise": 3.0}
    suite(
        folder,
        {
            "a": (secret("wear"), [finding("wear", probability=0.97)]),
            "b": (secret("creep"), [finding("vibration", probability=0.6)]),
            "c": (secret(kind="none"), []),
            "d": (secret("wear", "creep", kind="pair"), [finding("wear"), finding("backlash")]),
            "e": (secret("unexplained", kind="unknown"), [finding("unexplained")]),
            "f": (power, [finding("creep")]),
        },
    )
    stand_in = tmp_path / "stand_in.py"
    stand_in.write_text(STAND_IN)
    command = f"{sys.executable} {stand_in}"
    score = tools("score")
    assert score.main([str(folder), "--command", command, "--json", str(tmp_path / "out.json")]) == 0
    said = capsys.readouterr().out
    for line in (
        "| single: right name or right alias set first | 1 / 2 (50 %) |",
        "| single: wrong name first, of all | 1 / 2 (50 %) |",
        "| none, law of the model: false name | 0 / 1 (0 %) |",
        "| unknown: unexplained leads | 1 / 1 (100 %) |",
        "| two or three at once: recall | 0.50 of 2 |",
        "| two or three at once: precision | 0.50 of 2 |",
        "| `creep` | 1 / 1 (100 %) |",
        "| d | wear, creep | wear, backlash | missed creep; wrong backlash |",
    ):
        assert line in said, said
    verdicts = json.loads((tmp_path / "out.json").read_text())
    assert [each["case"] for each in verdicts] == list("abcdef")
    assert all(each["seconds"] > 0.0 for each in verdicts)


def test_answers_are_used_again_and_failures_are_told(
    tools: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite(tmp_path, {"broken": (secret("wear"), [])})
    stand_in = tmp_path / "stand_in.py"
    stand_in.write_text(STAND_IN)
    command = f"{sys.executable} {stand_in}"
    score = tools("score")
    assert score.main([str(tmp_path), "--command", command]) == 1
    assert "| broken | wear | - | exit status 2 |" in capsys.readouterr().out
    assert "no such thing" in (tmp_path / "broken" / "diagnosis.yaml").read_text()
    stand_in.unlink()
    assert score.main([str(tmp_path), "--command", command, "--reuse"]) == 1
    assert score.main([str(tmp_path / "empty")]) == 2
