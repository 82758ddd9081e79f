"""Judgement of measured figures: the keys that are at fault, and the limits between pass and fail."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.bringup.checks import Check, Outcome, Verdict, failed, passed, run_checks
from hdbridge.commissioning.bringup.judge import (
    LOAD_COUNTS,
    MOTOR_COUNTS,
    RATIO,
    Turned,
    judge_following,
    judge_hold,
    judge_nudge,
    judge_rest,
    judge_settling,
    judge_stop,
    judge_torque,
    judge_turn,
    suspect_entries,
)
from hdbridge.commissioning.bringup.slow import plan_travel
from hdbridge.errors import DriveError, SafetyStop
from hdbridge.files.profile import bundled_profile

ARTICLE = (bundled_profile("article") / "axis.yaml").read_text()
TEETH = "  teeth: {flexspline: 100, circular_spline: 102, output: flexspline}\n"


def axis(**changes: str) -> AxisConfig:
    text = ARTICLE
    for old, new in changes.items():
        text = text.replace(OLD[old], new)
    return AxisConfig.from_text(text)


OLD = {
    "ratio": "ratio: 50\n",
    "teeth": TEETH,
    "motor": "counts_per_turn: 8000         # one count is 3.24 arcsec at the load\n  direction: 1",
    "load": "counts_per_turn: 2880000      # one count is 0.45 arcsec\n  direction: 1",
    "minimum": "position_min_deg: -400",
    "maximum": "position_max_deg: 400",
}


def file(ratio, motor, load, motor_direction=1, load_direction=1):
    return axis(
        teeth="",
        ratio=f"ratio: {ratio}\n",
        motor=f"counts_per_turn: {motor}\n  direction: {motor_direction}",
        load=f"counts_per_turn: {load}\n  direction: {load_direction}",
        minimum="position_min_deg: -10",
        maximum="position_max_deg: 10",
    )


def turned(truth: AxisConfig, by: AxisConfig, motor_deg: float = 360.0) -> Turned:
    """Returns the readings of the axis ``truth`` when commanded through the axis file ``by``."""
    counts = by.motor_encoder.counts(motor_deg)
    true_motor_deg = truth.motor_encoder.degrees(counts)
    return Turned(counts, truth.load_encoder.counts(true_motor_deg / truth.gear.ratio))


def opposite(way: Turned) -> Turned:
    return Turned(-way.motor_counts, -way.load_counts)


@given(
    ratio=st.integers(30, 200),
    motor=st.sampled_from([4000, 8000, 10000, 65536, 131072]),
    load=st.sampled_from([65536, 1 << 20, 2880000, 360000]),
    signs=st.tuples(st.sampled_from([1, -1]), st.sampled_from([1, -1])),
    backwards=st.booleans(),
)
def test_any_correct_file_passes(ratio, motor, load, signs, backwards):
    one = file(ratio, motor, load, *signs)
    way = turned(one, one, -360.0 if backwards else 360.0)
    verdict = judge_turn(one, way, opposite(way))
    assert verdict.outcome is Outcome.PASS
    assert verdict.figures["ratio_measured"] == pytest.approx(ratio)


@given(ratio=st.integers(30, 200), signs=st.tuples(st.sampled_from([1, -1]), st.sampled_from([1, -1])))
def test_a_wrong_direction_is_always_reported_as_direction(ratio: int, signs: tuple[int, int]) -> None:
    said, true = file(ratio, 8000, 2880000, *signs), file(ratio, 8000, 2880000, signs[0], -signs[1])
    way = turned(true, said)
    verdict = judge_turn(said, way, opposite(way))
    assert verdict.outcome is Outcome.FAIL
    assert len(verdict.remedies) == 1
    assert f"load_encoder.direction: found {signs[1]}, expected {-signs[1]}" in verdict.remedies[0]


@pytest.mark.parametrize(
    ("said", "true", "key", "expected", "confirmed"),
    [
        ((50, 8000, 720_000), (50, 8000, 2_880_000), LOAD_COUNTS, 2_880_000, ()),
        ((50, 8000, 2_880_000), (50, 8000, 720_000), LOAD_COUNTS, 720_000, ()),
        ((50, 8000, 2_880_000), (50, 8000, 1_440_000), LOAD_COUNTS, 1_440_000, ()),
        ((50, 2000, 2_880_000), (50, 8000, 2_880_000), MOTOR_COUNTS, 8000, (LOAD_COUNTS,)),
        ((50, 8000, 2_880_000), (50, 10000, 2_880_000), MOTOR_COUNTS, 10000, ()),
        ((50, 8000, 2_880_000), (51, 8000, 2_880_000), RATIO, 51, ()),
        ((101, 8000, 2_880_000), (100, 8000, 2_880_000), RATIO, 100, ()),
        ((160, 8000, 2_880_000), (161, 8000, 2_880_000), RATIO, 161, ()),
        ((50, 8000, 2_880_000), (80, 8000, 2_880_000), RATIO, 80, ()),
        ((50, 8000, 2_880_000), (120, 8000, 2_880_000), RATIO, 120, (MOTOR_COUNTS, LOAD_COUNTS)),
        ((50, 8000, 2_880_000), (100, 8000, 2_880_000), RATIO, 100, (MOTOR_COUNTS, LOAD_COUNTS)),
        ((50, 8000, 2_880_000), (50, 8000, 1 << 20), LOAD_COUNTS, 1 << 20, (MOTOR_COUNTS, RATIO)),
    ],
)
def test_most_likely_key_is_reported_first(said, true, key, expected, confirmed):
    by, real = file(*said), file(*true)
    way = turned(real, by, 360.0 * max(1, round(said[0] / 50)))
    verdict = judge_turn(by, way, opposite(way), frozenset(confirmed))
    assert verdict.outcome is Outcome.FAIL
    assert (
        f"{key}: found {said[(RATIO, MOTOR_COUNTS, LOAD_COUNTS).index(key)]}, expected {expected} "
        in (verdict.remedies[0])
    )
    assert len(verdict.remedies) == 3  # the remedies for the other keys are reported as well


@given(factor=st.floats(0.05, 20.0))
def test_each_suspected_key_explains_the_factor(factor: float) -> None:
    one, tolerance = file(50, 8000, 2_880_000), 0.007
    suspects = suspect_entries(one, factor, tolerance)
    assert len({each.key for each in suspects}) == 3
    for each in suspects:
        ratio = each.expected / each.found
        explained = ratio if each.key == LOAD_COUNTS else 1.0 / ratio
        assert abs(explained / factor - 1.0) <= 2.0 * tolerance


def test_a_slipping_load_encoder_is_not_a_wrong_key() -> None:
    one = axis()
    verdict = judge_turn(one, Turned(8000, 57600 * 1.04), Turned(-8000, -57600 * 0.96))
    assert verdict.outcome is Outcome.FAIL
    assert "lost counts" in verdict.remedies[0]


@pytest.mark.parametrize(("motor", "load", "ok"), [(1, 2, True), (9, 2, False), (1, 200, False)])
def test_rest(motor: int, load: int, ok: bool) -> None:
    verdict = judge_rest(axis(), [0, motor] * 50, [0, load] * 50)
    assert (verdict.outcome is Outcome.PASS) is ok
    assert verdict.figures["load_noise_arcsec"] == pytest.approx(load / 2 * 0.45)


@pytest.mark.parametrize(("moved", "ok"), [(2, True), (400, False)])
def test_hold(moved: int, ok: bool) -> None:
    verdict = judge_hold(axis(), Turned(0, 0), [Turned(0, 0), Turned(-moved, 0)])
    assert (verdict.outcome is Outcome.PASS) is ok


@pytest.mark.parametrize(
    ("out", "back", "text"),
    [(44, -45, ""), (0, 0, "does not move"), (90, -90, "does not follow"), (-44, 44, "does not follow")],
)
def test_nudge(out: int, back: int, text: str) -> None:
    verdict = judge_nudge(axis(), 44.4, out, back)
    assert (verdict.outcome is Outcome.PASS) is (not text)
    assert text in verdict.measured


def test_limits_of_following_torque_and_settling() -> None:
    one = axis()
    assert judge_following(one, [0, -50]).outcome is Outcome.PASS
    assert "following_error_deg: found 5" in judge_following(one, [0, -80]).remedies[0]
    assert judge_torque(one, [100, -440], 50).outcome is Outcome.PASS
    assert judge_torque(one, [100, -460], 50).outcome is Outcome.FAIL
    ringing = [round(1000 * math.exp(-n / 10) * math.cos(n)) for n in range(200)]
    settled = judge_settling(one, ringing, 0.004, 0.0)
    assert settled.outcome is Outcome.PASS
    assert 0.1 < float(settled.figures["settling_s"] or 0) < 0.25
    hunting = [round(100 * math.cos(n / 3)) for n in range(200)]
    assert judge_settling(one, hunting, 0.004, 0.0).outcome is Outcome.FAIL


@pytest.mark.parametrize(
    ("distance_deg", "time_s", "ok"), [(2.0, 0.02, True), (40.0, 0.02, False), (2.0, 0.9, False)]
)
def test_a_stop(distance_deg: float, time_s: float, ok: bool) -> None:
    assert (judge_stop(axis(), 120.0, distance_deg, time_s, "x", 0.0).outcome is Outcome.PASS) is ok


@given(here=st.floats(-490.0, 490.0), ratio=st.integers(30, 200))
def test_a_travel_stays_within_the_limits(here: float, ratio: int) -> None:
    one = file(ratio, 8000, 2_880_000)
    plan = plan_travel(one, here)
    least, greatest = -10.0 * ratio, 10.0 * ratio
    if plan is None:
        assert max(greatest - here, here - least) < 21.0 or not least <= here <= greatest
        return
    assert plan.lead_deg * plan.span_deg > 0
    if least <= here <= greatest:
        assert least <= here + plan.lead_deg + plan.span_deg <= greatest
    if abs(plan.span_deg) >= 360.0:
        assert plan.span_deg % 360.0 == 0.0


def test_checks_run_in_order_with_their_prerequisites() -> None:
    def broken(_: None) -> object:
        raise DriveError("no answer")

    checks = [
        Check("a", "A", lambda _: passed("fine")),
        Check("b", "B", broken, ("a",)),  # type: ignore[arg-type]
        Check("c", "C", lambda _: passed("never"), ("b",)),
        Check("d", "D", lambda _: failed("bad", "do this"), ("a",), moves=True),
        Check("e", "E", lambda _: passed("never"), moves=True),
    ]
    reported: list[str] = []
    rows = run_checks(None, checks, notify=lambda row: reported.append(row.check.name))
    assert reported == list("abcde")
    assert [row.verdict.outcome.value for row in rows] == ["pass", "fail", "not possible", "fail", "pass"]
    assert rows[1].verdict.measured == "no answer"
    assert "'B'" in rows[2].verdict.measured

    asked: list[int] = []
    rows = run_checks(None, checks, permitted=lambda: asked.append(1) or "no")
    assert [row.verdict.measured for row in rows][3:] == ["no", "no"]
    assert asked == [1]


def test_nothing_moves_after_a_safety_stop() -> None:
    def stopped(_: None) -> Verdict:
        raise SafetyStop("node 1: TPDO 1 is missing")

    checks = [
        Check("a", "A", stopped, moves=True),
        Check("b", "B", lambda _: passed("moved"), moves=True),
        Check("c", "C", lambda _: passed("read")),
    ]
    for permission in (None, "not now"):
        rows = run_checks(None, checks, permitted=lambda answer=permission: answer)
        assert "moved" not in [row.verdict.measured for row in rows]
        assert rows[2].verdict.measured == "read"
    assert rows[1].verdict.measured == "not now"
    assert "fault in 'A'" in run_checks(None, checks)[1].verdict.measured
