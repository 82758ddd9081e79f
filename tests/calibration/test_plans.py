"""Plans are data; planning keeps to the axis's travel and speed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.analysis.identifiability import plan_report
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.files.yamlfile import document_from_text
from hdbridge.motion.procedures.moves import AxisView, MotionLimits, MoveTo, Sample
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import rehearse
from hdbridge.motion.procedures.sweep import Sweep

WIDE = MotionLimits(-400.0, 400.0, 20.0, 200.0, 4000.0)


def plan_of(procedures: str, more: str = "") -> Plan:
    text = f"schema: hdbridge.plan/1\nname: own\n{more}procedures:\n{procedures}"
    return document_from_text(text, "own.yaml").validate(Plan)


def sweeps(tasks):
    return [part for task in tasks.tasks for part in task.procedure.parts if isinstance(part, Sweep)]


def beyond(entry):
    return getattr(entry, "beyond", False)


@pytest.mark.parametrize("name", ["quick", "full"])
@pytest.mark.parametrize("ratio", [30.0, 50.0, 160.0])
def test_bundled_plans_suit_a_calibration(name, ratio):
    tasks = Plan.load(name).tasks(AxisView(ratio, WIDE))
    found = sweeps(tasks)
    assert max(each.high_deg - each.low_deg for each in found) == pytest.approx(720)
    assert len({each.velocity_deg_s for each in found}) >= 2
    words = " ".join(task.name for task in tasks.tasks)
    for procedure in ("standstill", "sweep", "sines", "reversals", "stepping", "reference"):
        assert procedure in words


def test_quick_plan_shows_return_point_memory():
    plan = Plan.load("quick")
    model = TransmissionModel(50.0, (Hysteresis(offset_arcsec=30, width_deg=20, exponent=1.6),))
    only = plan.model_copy(update={"procedures": tuple(each for each in plan.procedures if not beyond(each))})
    seen, unseen = (plan_report(each, model)["identifiability"]["hysteresis_memory"] for each in (plan, only))
    assert seen["detectable"] is True
    assert seen["detection_limit_arcsec"] < 5.0
    assert unseen["detectable"] is False


def test_quick_plan_takes_minutes_and_the_full_plan_longer():
    axis = AxisView(50.0, WIDE)
    quick, full = (
        sum(rehearse(each.procedure, axis).duration_s for each in Plan.load(name).tasks(axis).tasks)
        for name in ("quick", "full")
    )
    assert quick < 900 < 1800 < full


@given(
    low=st.floats(-1000, 1000),
    travel=st.floats(8.0, 2000),
    speed=st.floats(0.5, 100),
    ratio=st.floats(30, 160),
    start=st.floats(0, 1),
)
def test_plans_stay_within_limits_from_any_start(low, travel, speed, ratio, start):
    axis = AxisView(ratio, MotionLimits(low, low + travel, speed, 200.0, 4000.0))
    plan = Plan.load("quick")
    try:
        tasks = plan.tasks(axis).tasks
    except InputError:
        assert travel * ratio < 2 * (90 + 1.02 * plan.precondition_deg)
        return
    begin = low + start * travel
    tests = (plan.stepping(axis), plan.positioning(axis))
    for procedure in (*(task.procedure for task in tasks), *tests):
        walked = rehearse(procedure, axis, begin)
        assert low <= walked.lowest_deg
        assert walked.highest_deg <= low + travel


def test_shortened_tasks_are_reported():
    tasks = Plan.load("quick").tasks(AxisView(50.0, MotionLimits(0.0, 100.0, 2.0, 200.0, 4000.0)))
    (sweep, _) = sweeps(tasks)
    assert 90 < sweep.high_deg - sweep.low_deg < 100
    assert sweep.velocity_deg_s <= 2.0
    notes = " ".join(tasks.notes)
    assert "02-sweep" in notes
    assert "720" in notes
    assert "slowed" in notes


def test_every_task_starts_from_the_same_pose_and_direction():
    axis = AxisView(50.0, WIDE)
    tasks = Plan.load("quick").tasks(axis).tasks
    assert tasks
    for task in tasks:
        moves = task.procedure.moves(axis)
        first = next(moves)
        second = moves.send(())
        assert (first.kind, second.kind) == ("precondition", "precondition")
        assert first.load_deg < second.load_deg == 0.0


@pytest.mark.parametrize(
    ("procedures", "words"),
    [
        ("  - {procedure: sweep, load_turns: 2, speed: 1}", ("own.yaml:4", "speed", "unknown key")),
        ("  - {procedure: sweeep, load_turns: 2}", ("own.yaml:4:17", "expected one of standstill, sweep,")),
        ("  - {load_turns: 2}", ("own.yaml:4", "no such procedure", "sines")),
        ("  - {procedure: sweep}", ("load_turns", "motor_turns")),
        ("  - {procedure: sweep, load_turns: 1, motor_turns: 1}", ("expected one of",)),
        ("  - {procedure: sines, amplitudes_deg: []}", ("amplitudes_deg",)),
        ("  - {procedure: stepping, count: 1}", ("count",)),
        ("  - {procedure: standstill, duration_s: -1}", ("duration_s",)),
        ("  []", ("procedures",)),
    ],
)
def test_a_wrong_plan_is_refused_with_its_location(procedures, words):
    with pytest.raises(InputError) as caught:
        plan_of(procedures)
    for word in words:
        assert word in str(caught.value)


def test_an_unknown_plan_lists_the_known_ones():
    with pytest.raises(InputError, match=r"quik: no such plan; .*full, quick; did you mean 'quick'"):
        Plan.load("quik")


def test_a_plan_survives_being_written_into_a_recording():
    plan = Plan.load("full")
    assert Plan.model_validate(plan.as_dict()) == plan


@pytest.mark.parametrize(("travel", "count"), [(80.0, 3), (170.0, 5), (360.0, 8)])
def test_positioning_test_has_the_number_of_targets_of_the_standard(travel, count):
    axis = AxisView(50.0, WIDE)
    plan = plan_of("  - {procedure: standstill}\n", f"validation: {{travel_deg: {travel}}}\n")
    places = plan.positioning(axis).targets_deg
    assert len(places) == count
    assert list(places) == sorted(places)
    assert max(map(abs, places)) <= travel / 2
    phases = {round(each * 50.0 % 360.0, 3) for each in places}
    assert len(phases) == count


def test_every_target_is_approached_from_either_side_five_times():
    axis = AxisView(50.0, WIDE)
    procedure = Plan.load("quick").positioning(axis)
    place, seen, steps, reply = 0.0, [], procedure.moves(axis), None
    while True:
        try:
            move = steps.send(reply)
        except StopIteration as end:
            approaches = end.value
            break
        path = move.path(place, axis.limits)
        if move.kind == "step":
            seen.append((move.load_deg, move.load_deg > place))
        place = path.at(path.duration_s)
        reply = [Sample(0.01 * i, place, 0.0, 0.0, place + 1 / 3600, 0.0) for i in range(20)]
    assert [(each.target_deg, each.forward) for each in approaches] == seen
    for target in procedure.targets_deg:
        assert seen.count((target, True)) == seen.count((target, False)) == 5
    assert all(each.error_arcsec == pytest.approx(1.0) for each in approaches)


def test_a_move_exactly_at_its_limits_is_planned():
    path = MoveTo(16.5).path(15.499999999999998, MotionLimits(0.0, 20.0, 10.0, 200.0, 4000.0))
    assert path.duration_s == pytest.approx(0.2, abs=1e-4)
    assert path.at(path.duration_s) == 16.5
