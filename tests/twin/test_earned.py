"""A fit includes a part only if the recording shows it: friction near rest, a different loop, a limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.demo import AXIS as DEMO
from support.demo import TRUTH
from support.exercised import booted
from support.keys import changed

from hdbridge.control.bench import Bench
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.encoder import TrueCoupling
from hdbridge.twin.fit import (
    LAWS,
    LOOP,
    Fitted,
    by_each_law,
    by_law_of,
    continued,
    free_parameters,
    loop_parameters,
    solve,
    start_of,
    with_limit,
    with_loop,
    with_optional_groups,
)
from hdbridge.twin.misfit import Replays, prepare
from hdbridge.twin.parameters import BY_NAME, named, value_in, with_load_encoder, with_values

AXIS = DEMO.model_copy(update={"drive": DEMO.drive.model_copy(update={"following_error_deg": 60.0})})
"""At its current limit, the drive falls behind, so the axis file allows a large following error."""
NAMES = ("Coulomb friction", "load inertia", "servo dead time")
LIMIT = "current limit"
LIMIT_PERCENT = 15.0
"""Current limit of the limited drive; the steps need 19 % on the demo axis."""
PARAMETERS = named(*NAMES)


def recorded(truth: Truth = TRUTH) -> Recording:
    """Records steps there and back on an axis."""
    return _recorded(truth.model_dump_json(by_alias=True, exclude_none=True))


@cache
def _recorded(truth: str) -> Recording:
    with booted(AXIS, Truth.from_text(truth)) as (drive, _):
        return Bench(drive).run(Stepping(1, step_deg=150.0))


def fitted(replays: Replays, start: Truth, steps: int = 2) -> Fitted:
    return solve(replays, start, PARAMETERS, steps)


def with_coupling(hz: float | None) -> Truth:
    """Returns the demo axis with a different coupling between load and load encoder; None: a rigid one."""
    coupling = None if hz is None else TrueCoupling(frequency_hz=hz, damping_ratio=0.1)
    return with_load_encoder(TRUTH, coupling=coupling)


def with_growth(per_k: float) -> Truth:
    """Returns the demo axis with a friction that changes with the temperature."""
    return changed(TRUTH, temperature__reference_c=22.0, temperature__friction_growth_per_k=per_k)


def warm_and_cold(truth: Truth) -> Recording:
    parts = []
    for warm_c in (22.0, 37.0):
        part = recorded(changed(truth, temperature__start_c=warm_c))
        reported_c = np.full(len(part.record), warm_c)
        parts.append(replace(part, record=Record({**part.record.columns, "temperature_c": reported_c})))
    return Recording.joined(parts)


STICKS = {"friction's rise at rest": 0.5, "Stribeck speed": 8.0}


@pytest.mark.parametrize(
    ("start", "axis", "record", "earned"),
    [
        (TRUTH, with_values(TRUTH, {**STICKS, "friction's rise at rest": 0.0}), recorded, {}),
        (TRUTH, with_values(TRUTH, STICKS), recorded, STICKS),
        (with_coupling(None), with_coupling(None), recorded, {}),
        (with_coupling(None), with_coupling(120.0), recorded, {"encoder coupling": 120.0}),
        (with_growth(0.0), with_growth(0.0), warm_and_cold, {}),
        (with_growth(0.0), with_growth(-0.012), warm_and_cold, {"friction growth": -0.012}),
    ],
)
def test_a_part_is_added_if_the_axis_has_it(
    start: Truth, axis: Truth, record: Callable[[Truth], Recording], earned: dict[str, float]
) -> None:
    with Replays(prepare(record(axis), AXIS, start), 1) as replays:
        found = with_optional_groups(replays, fitted(replays, start))
        assert {each.name for each in found.parameters} == {*NAMES, *earned}
        found = continued(replays, found, 4, near=found) if earned else found
    for name, value in earned.items():
        assert value_in(found.truth, BY_NAME[name]) == pytest.approx(value, rel=0.2), name
    assert found.truth.motor.coulomb_nm == pytest.approx(TRUTH.motor.coulomb_nm, rel=0.03)


def test_a_torque_limit_is_fitted_where_a_replay_without_it_leaves_more() -> None:
    limited = with_values(TRUTH, {LIMIT: LIMIT_PERCENT})
    with Replays(prepare(recorded(limited), AXIS, TRUTH), 1) as replays:
        read = start_of(TRUTH, replays.data, {}).servo.torque_limit_percent
        assert read == pytest.approx(LIMIT_PERCENT, rel=0.01)
        found = fitted(replays, with_values(TRUTH, {LIMIT: read}))
        found = with_limit(replays, found, TRUTH)
    assert [each.name for each in found.parameters] == [*NAMES, LIMIT]
    assert found.truth.servo.torque_limit_percent == pytest.approx(LIMIT_PERCENT, rel=0.002)
    lower, upper = found.intervals()[LIMIT]
    assert 0.0 < upper - lower < 0.05 * LIMIT_PERCENT


def test_a_peak_torque_is_not_a_limit() -> None:
    with Replays(prepare(recorded(), AXIS, TRUTH), 1) as replays:
        assert (
            start_of(TRUTH, replays.data, {}).servo.torque_limit_percent == TRUTH.servo.torque_limit_percent
        )
        highest_nm = max(float(np.max(np.abs(each.measured["motor torque"]))) for each in replays.data.pieces)
        within = with_values(TRUTH, {LIMIT: 100.0 * highest_nm / TRUTH.motor.rated_torque_nm})
        usual = with_limit(replays, fitted(replays, within), TRUTH)
    assert usual.parameters == PARAMETERS
    assert usual.truth.servo.torque_limit_percent == TRUTH.servo.torque_limit_percent


def test_another_hysteresis_law_is_adopted_if_the_load_shows_it() -> None:
    dahl = by_each_law(TRUTH)[-1]
    assert dahl.gear.hysteresis is not None
    assert dahl.gear.hysteresis.law == "dahl"
    assert TRUTH.gear.hysteresis is not None
    assert TRUTH.gear.hysteresis.law != "dahl"
    # The loop that a calibration with a different law would report: too low, with other zero crossings.
    wrong = with_values(TRUTH, {"loop offset": 0.93 * TRUTH.gear.hysteresis.offset_arcsec})
    with Replays(prepare(recorded(dahl), AXIS, wrong), 1) as replays:
        found = with_loop(replays, fitted(replays, wrong))
        assert found is not None
        assert found.truth.gear.hysteresis is not None
        assert found.truth.gear.hysteresis.law == "dahl"
        assert with_loop(replays, found) is None
    for name in ("loop offset", "loop yield"):
        assert value_in(found.truth, BY_NAME[name]) == pytest.approx(value_in(dahl, BY_NAME[name]), rel=0.03)


def test_a_sufficient_loop_is_unchanged() -> None:
    with Replays(prepare(recorded(), AXIS, TRUTH), 1) as replays:
        assert with_loop(replays, fitted(replays, TRUTH)) is None


@pytest.mark.parametrize("law", LAWS)
def test_a_loop_by_another_law_is_as_high_and_crossed_half_after_the_same_travel(law: str) -> None:
    there = next(
        each for each in by_each_law(TRUTH) if each.gear.hysteresis and each.gear.hysteresis.law == law
    )
    assert {each.name for each in loop_parameters(there)} >= {"loop offset", "loop exponent"}
    back = by_law_of(there, TRUTH)
    own = TRUTH.gear.hysteresis
    assert own is not None
    assert back.gear.hysteresis is not None
    assert value_in(back, BY_NAME["loop offset"]) == pytest.approx(own.offset_arcsec)
    again = by_law_of(back, there)
    assert again.gear.hysteresis is not None
    for each in loop_parameters(there):
        assert value_in(again, each) == pytest.approx(value_in(there, each), rel=1e-6)


def test_a_gear_without_a_loop_has_none_by_another_law() -> None:
    gear = TRUTH.gear.model_copy(update={"hysteresis": None})
    bare = TRUTH.model_copy(update={"gear": gear})
    assert by_each_law(bare) == []
    assert by_law_of(bare, TRUTH) is bare
    # A fit may reduce the offset of a loop below the size of its initial state.
    assert TRUTH.gear.hysteresis.start_arcsec == -9.0  # type: ignore[union-attr]
    lower = with_values(by_each_law(TRUTH)[0], {"loop offset": 5.0})
    assert value_in(lower, BY_NAME["loop offset"]) == 5.0


def test_the_loop_is_that_of_the_calibration_unless_the_recording_shows_another() -> None:
    assert not {*LOOP} & {each.name for each in free_parameters(TRUTH)}
