"""Choice of the next experiment: the shortest one that is predicted to separate causes."""

from dataclasses import dataclass

import pytest

from hdbridge.analysis.findings import Finding
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.improvement import choose, unseparated
from hdbridge.commissioning.improvement.further import machine_for_unexplained, machine_plans
from hdbridge.control.bench import axis_view
from hdbridge.motion.procedures.plan import Plan

PROFILE = "profiles/article"


@dataclass
class Left:
    """Stub of a diagnosis with the attributes that the choice uses."""

    findings: tuple


def choice_of(left, known, done=()):
    return choose(left, unseparated(left, *known), *known, done)


def found(cause, *aliases, lives_in=""):
    return Finding(cause, 0.9, aliases, {}, None, "", 5.0, lives_in=lives_in)


@pytest.fixture(scope="module")
def known(pytestconfig):
    folder = pytestconfig.rootpath / PROFILE
    return TransmissionModel.load(folder / "model.yaml"), axis_view(AxisConfig.load(folder))


def test_two_load_turn_sweeps_answer_their_questions(known):
    choice = choice_of(Left((found("ratio_error", "load_order"),)), known)
    assert "load-turn" in choice.plan.name
    assert choice.separates == ("ratio_error or load_order",)
    assert choice.duration_s > 60


def test_the_shortest_sufficient_experiment_is_chosen_once(known):
    left = Left((found("velocity_windup", "channel_skew"),))
    first = choice_of(left, known)
    second = choice_of(left, known, done={first.plan.name})
    assert second is None or second.duration_s >= first.duration_s
    assert second is None or second.plan.name != first.plan.name


def test_questions_only_a_person_can_answer_cause_no_motion(known):
    assert choice_of(Left((found("motor_order", "motor_encoder_eccentricity"),)), known) is None
    assert choice_of(Left((found("load_order", "compliance"),)), known) is None


def test_with_nothing_open_there_is_nothing_to_run(known):
    assert choice_of(Left(()), known) is None
    assert choice_of(Left((found("motor_order"),)), known) is None


def test_unexplained_residuals_are_measured_at_their_coordinate(known):
    left = Left((found("unexplained", lives_in="load angle"),))
    assert choice_of(left, known).plan.name == machine_for_unexplained("load angle") == "two-load-turns"
    assert choice_of(left, known, done={"two-load-turns"}) is None


@pytest.mark.parametrize("name", list(machine_plans()))
def test_every_experiment_suits_a_real_axis(known, name):
    plan = machine_plans()[name]
    tasks = plan.tasks(known[1])
    assert plan.about
    assert len(tasks.tasks) == len(plan.procedures) + 1


def test_insufficient_travel_yields_no_answer(known):
    short = Plan.model_validate(
        {
            "schema": "hdbridge.plan/1",
            "name": "short",
            "procedures": [{"procedure": "sweep", "motor_turns": 4, "motor_turns_per_s": 0.3}],
        }
    )
    left = Left((found("ratio_error"),))
    assert unseparated(left, *known) == {}
    assert "load_order" in unseparated(left, *known, [short])["ratio_error"]
    assert unseparated(left, *known, [short, machine_plans()["two-load-turns"]]) == {}
