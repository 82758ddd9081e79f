"""A twin is fitted to an axis, states its uncertainty, and detects changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.demo import AXIS, TRUTH
from support.exercised import booted

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import ChannelSource, Temperature
from hdbridge.control.bench import Bench
from hdbridge.errors import InputError
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.check import Check, check
from hdbridge.twin.fit import lag_s, solve
from hdbridge.twin.misfit import (
    CHANNELS,
    Replays,
    Values,
    channel_residuals,
    noise_floor,
    noise_in_motion,
    prepare,
    residuals,
    values_of,
)
from hdbridge.twin.naming import growth, scales_by_kind
from hdbridge.twin.parameters import BY_NAME, named, value_in, with_values
from hdbridge.twin.twin import with_knowledge

SENSOR = ChannelSource(index=0x2100, type="int16", via="tpdo")
WITH_SENSOR = AXIS.model_copy(update={"temperature": Temperature(source=SENSOR, celsius_per_count=0.1)})
NAMES = ("Coulomb friction", "load inertia", "servo dead time")


@cache
def recorded(seed: int = 0, count: int = 3, **changes: float) -> Recording:
    """Records long steps each way on the demo axis, with some of its values changed (keywords are their
    names).
    """
    values = {name.replace("_", " "): value for name, value in changes.items()}
    return benched(AXIS, with_values(TRUTH, values) if values else TRUTH, seed, count)


def benched(axis: AxisConfig, truth: Truth, seed: int, count: int) -> Recording:
    with booted(axis, truth, seed) as (drive, _):
        return Bench(drive).run(Stepping(count, step_deg=150.0))


@cache
def twin(filter_ms: float = TRUTH.servo.command_filter_ms) -> Truth:
    """Fits a twin to the demo axis; the fit starts at the truth, except for the command filter."""
    parameters, start = (
        named(*NAMES),
        with_values(TRUTH, {"command filter": filter_ms}),
    )
    with Replays(prepare(recorded(), AXIS, start), 1) as replays:
        return with_knowledge(solve(replays, start, parameters, 2), replays.data)


def test_a_replay_of_the_true_axis_leaves_rounding_and_noise() -> None:
    data = prepare(recorded(), AXIS, TRUTH)
    left, floor = residuals(data, TRUTH), noise_floor(data)
    for name in CHANNELS:
        inside = left[name][left[name] != 0.0]
        assert np.median(np.abs(inside)) < 2.0 * floor[name], name


def test_torque_counts_after_the_motor_leaves_its_initial_state() -> None:
    data = prepare(recorded(), AXIS, TRUTH)
    travelled_deg = np.cumsum(np.abs(np.diff(recorded().record.motor_position_deg, prepend=0.0)))
    counts = data.counts["motor torque"]
    assert not counts[travelled_deg < 59.0].any()
    assert counts[(travelled_deg > 61.0) & (travelled_deg < 0.9 * travelled_deg[-1])].any()


def test_the_age_of_the_demand_is_read_from_the_recording() -> None:
    found = lag_s(prepare(recorded(), AXIS, TRUTH))
    assert found == pytest.approx(2e-3 * TRUTH.servo.command_filter_ms, rel=0.1)


def test_least_squares_lead_from_wrong_values_to_the_true_ones() -> None:
    parameters = named(*NAMES)
    wrong = with_values(TRUTH, {"Coulomb friction": 0.045, "load inertia": 0.18, "servo dead time": 0.6})
    with Replays(prepare(recorded(), AXIS, wrong), 1) as replays:
        fitted = solve(replays, wrong, parameters, 8)
    for each in parameters:
        true, found = value_in(TRUTH, each), value_in(fitted.truth, each)
        assert found == pytest.approx(true, rel=0.03, abs=0.05), each.name


def test_a_twin_has_encoder_noise_and_uncertainty() -> None:
    known = twin()
    assert known.load_.encoder.noise_arcsec == pytest.approx(TRUTH.load_.encoder.noise_arcsec, rel=0.15)
    for name in NAMES:
        lower, upper = known.intervals[BY_NAME[name].path]
        found = value_in(known, BY_NAME[name])
        assert found is not None
        assert lower <= found <= upper, name


def test_a_check_is_silent_without_a_change() -> None:
    checked = check(recorded(seed=1), AXIS, twin(), workers=1)
    assert checked.changes == ()
    # The feed-forwards leave little to the loops, no step comes near the limit, and the demo's friction does
    # not depend on its temperature.
    assert checked.unseen == ("servo gains", "friction feed-forward", "current limit", "warmth")
    assert checked.sentence == (
        "Nothing has changed since the twin was made, unless it is one of these, which this recording does "
        "not show: servo gains, friction feed-forward, current limit, warmth."
    )


def test_recorded_warmth_is_not_a_change() -> None:
    """Warming by 20 K lowers the friction by a fifth, so the check must take it into account."""
    grows = TRUTH.temperature.model_copy(update={"friction_growth_per_k": -0.01, "reference_c": 22.0})
    warm = TRUTH.model_copy(update={"temperature": grows.model_copy(update={"start_c": 42.0})})
    intervals = {**twin().intervals, "temperature.ambient_c": (21.0, 23.0)}
    known = twin().model_copy(update={"temperature": grows, "intervals": intervals})
    found = check(benched(WITH_SENSOR, warm, 3, 1), WITH_SENSOR, known, workers=1)
    assert found.changes == ()
    assert "warmth" not in found.unseen


def disturbed(recording: Recording) -> Recording:
    """Shifts some torques by a thousand scales, as if a stuck motor broke away at a different time."""
    torque = recording.record.columns["motor_torque_nm"].copy()
    torque[np.argmax(np.abs(torque)) :][:6] = 0.0
    return with_torque(recording, torque)


def with_torque(recording: Recording, torque: np.ndarray) -> Recording:
    columns = {**recording.record.columns, "motor_torque_nm": torque}
    return replace(recording, record=replace(recording.record, columns=columns))


@pytest.mark.parametrize("seen", [lambda recording: recording, disturbed])
def test_a_check_names_changes_not_misfit(
    seen: Callable[[Recording], Recording],
) -> None:
    # The twin's command filter is insignificantly shorter on its own recording; with more inertia, other rows
    # show the difference.
    near = twin(0.9 * TRUTH.servo.command_filter_ms)
    changed = recorded(seed=2, count=1, load_inertia=1.5 * TRUTH.load_.inertia_kg_m2)
    checked = check(seen(changed), AXIS, near, workers=1)
    assert [each.cause for each in checked.changes] == ["load inertia"]
    (inertia,) = checked.changes[0].parameters
    assert inertia.after == pytest.approx(1.5 * TRUTH.load_.inertia_kg_m2, rel=0.05)
    assert "load inertia" in checked.sentence


def test_a_load_that_rings_out_of_step_has_changed() -> None:
    """With 1.5 times the inertia, at 8 Hz, the residual is so large that slopes are meaningless."""
    gear, stiffness = TRUTH.gear, TRUTH.load_.whole_inertia_kg_m2 * (math.tau * 8.0) ** 2
    damping = 0.3 * gear.damping_nm_s_per_rad * math.sqrt(stiffness / gear.stiffness_nm_per_rad)
    soft = {"gear stiffness": stiffness, "gear damping": damping}
    heavier = with_values(TRUTH, {**soft, "load inertia": 1.5 * TRUTH.load_.inertia_kg_m2})
    checked = check(benched(AXIS, heavier, 2, 1), AXIS, with_values(twin(), soft), workers=1)
    assert [each.cause for each in checked.changes] == ["load inertia"]
    (inertia,) = checked.changes[0].parameters
    assert inertia.after == pytest.approx(1.5 * TRUTH.load_.inertia_kg_m2, rel=0.05)
    assert checked.unexplained == {}


@cache
def replay_only() -> Truth:
    """Returns a twin with wrong control loops, whose residual is several times the noise."""
    wrong = with_values(TRUTH, {"position gain": 80.0, "integral time": 40.0, "motor inertia": 6e-5})
    parameters = named(*NAMES)
    with Replays(prepare(recorded(), AXIS, wrong), 1) as replays:
        fitted = solve(replays, wrong, parameters, 6)
        left = channel_residuals(replays.data, fitted.residuals, noise_in_motion(replays.data))
        assert values_of(left, 1.0) is Values.REPLAY
        return with_knowledge(fitted, replays.data, Values.REPLAY)


def test_a_replay_only_twin_is_checked_against_its_original_misfit() -> None:
    checked = check(recorded(seed=1), AXIS, replay_only(), workers=1)
    assert checked.changes == ()
    assert checked.sentence.startswith("Nothing has changed since the twin was made")
    assert max(checked.growth_before.values()) < 1.1


def test_a_change_that_the_twin_s_own_error_hides_is_not_ruled_out() -> None:
    """The dead time of the axis falls from 1.2 to 0 ms; the twin's wrong 0.6 ms differs equally from both."""
    early = with_values(TRUTH, {"servo dead time": 0.6})
    with Replays(prepare(recorded(servo_dead_time=1.2), AXIS, early), 1) as replays:
        known = with_knowledge(
            solve(replays, early, (BY_NAME["Coulomb friction"],), 2), replays.data, Values.REPLAY
        )
    checked = check(recorded(seed=1, servo_dead_time=0.0), AXIS, known, workers=1)
    assert checked.changes == ()
    assert max(checked.growth_before.values()) < 1.5
    assert "servo dead time" in checked.unseen
    assert "servo dead time" in checked.sentence


def test_a_replay_only_twin_names_a_change_by_its_ratio() -> None:
    doubled = recorded(seed=2, Coulomb_friction=2.0 * TRUTH.motor.coulomb_nm)
    checked = check(doubled, AXIS, replay_only(), workers=1)
    assert [each.cause for each in checked.changes] == ["friction"]
    friction = next(each for each in checked.changes[0].parameters if each.name == "Coulomb friction")
    assert friction.after == pytest.approx(2.0, rel=0.2)
    assert "times what it was" in checked.sentence


@pytest.mark.parametrize("twin_of", [twin, replay_only])
def test_increased_misfit_is_never_silent(twin_of: Callable[[], Truth]) -> None:
    """The changed axis has a hunting torque, which no parameter of the simulated drive can cause."""
    recording = recorded(seed=1, count=1)
    torque = recording.record.columns["motor_torque_nm"]
    hunts = torque + 0.05 * np.sin(np.arange(len(torque)) / 2.0) * (torque != 0.0)
    checked = check(with_torque(recording, hunts), AXIS, twin_of(), workers=1)
    assert checked.growth_before["motor torque"] > 1.5
    assert "Nothing has changed" not in checked.sentence
    assert "motor torque" in checked.sentence


def test_growth_follows_a_change_of_any_size_and_not_a_single_reading() -> None:
    with Replays(prepare(recorded(), AXIS, TRUTH), 1) as replays:
        data = replays.data
    noise, rng = noise_in_motion(data), np.random.default_rng(3)
    scale = scales_by_kind(data, {}, noise)
    white = {name: each * rng.standard_normal(len(each)) for name, each in scale.items()}
    for factor in (1.0, 3.0, 30.0):
        found = growth(data, {name: factor * each for name, each in white.items()}, scale)
        assert found == pytest.approx(dict.fromkeys(found, factor), rel=0.1)
    stray = {name: each.copy() for name, each in white.items()}
    for each in stray.values():
        each[len(each) // 2] *= 1e3
    assert max(growth(data, stray, scale).values()) < 1.1


def test_a_twin_that_leaves_all_of_a_signal_shows_only_measured_changes() -> None:
    known = replay_only()
    about = known.provenance["fit"]
    assert about["mechanics"]
    huge = {name: {kind: 1e6 * rms for kind, rms in by.items()} for name, by in about["misfit"].items()}
    for mechanics in (about["mechanics"], {}):
        fit = {**about, "misfit": huge, "mechanics": mechanics}
        lost = known.model_copy(update={"provenance": {**known.provenance, "fit": fit}})
        checked = check(recorded(seed=1), AXIS, lost, workers=1)
        assert not checked.changes
        if mechanics:
            assert not {"friction", "load inertia", "gear stiffness"} & {*checked.unseen}
        else:
            assert checked.sentence == "The twin explains too little of this axis to show a change."


def test_unexplained_changes_are_reported() -> None:
    grown = {"following error": 1.1, "motor torque": 21.0, "load error": 242.0}
    checked = Check((), grown, grown, ("warmth",))
    assert checked.sentence == (
        "Something has changed since the twin was made that no change of a cause explains. "
        "The twin leaves 21 times as much of the motor torque as when it was made. "
        "The twin leaves 242 times as much of the load error as when it was made. "
        "This recording would not show a change in: warmth."
    )


def test_a_check_needs_a_fitted_twin() -> None:
    with pytest.raises(InputError, match=r"provenance\.fit"):
        check(recorded(), AXIS, TRUTH)
