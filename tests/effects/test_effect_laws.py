"""Laws that every effect of the catalogue obeys."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from support.effect_examples import EXAMPLES, motions, starts

from hdbridge.axis.effects import (
    CATALOGUE,
    MEASURED,
    Channel,
    Moment,
    Motion,
    Start,
    missing_channels,
    moments,
    readings,
)
from hdbridge.axis.effects.described import Level, Memoryless
from hdbridge.errors import InputError

NAMES = sorted(CATALOGUE)
BASE = [CATALOGUE["synchronous"].candidate(50.0), CATALOGUE["hysteresis"].candidate(50.0)]
# Large ones (an acceleration over a tiny time step) are compared relative to their size.
CLOSE = {"rtol": 1e-9, "atol": 1e-7}


def law(test):
    """Applies a law to every effect of the catalogue."""
    return pytest.mark.parametrize("name", NAMES)(settings(max_examples=12, deadline=None)(test))


def test_every_effect_is_tested():
    assert set(EXAMPLES) == set(CATALOGUE)


@law
@given(
    data=st.data(),
    motion=motions,
    start=starts,
    factor=st.floats(0.25, 4),
    away=st.floats(-40, 40),
    probes=st.lists(st.floats(-3000, 3000), max_size=4),
)
def test_an_effect_on_any_path_obeys_the_laws(name, data, motion, start, factor, away, probes):
    """One draw serves all laws, because drawing an effect and a path takes far longer than testing a law."""
    effect = data.draw(EXAMPLES[name])
    parameters_go_out_and_come_back(effect)
    prediction_is_columns_times_coefficients(effect, motion, start)
    fitted_takes_back_its_own_coefficients(effect, motion, start)
    error_scales_with_its_coefficients(effect, motion, start, factor)
    error_stays_within_its_bound(effect, motion, start)
    batch_equals_on_line_and_peeking_changes_nothing(effect, motion, start, probes)
    error_falls_no_steeper_than_its_slope_bound(effect, motion, start, away)
    a_missing_channel_is_named_before_and_when_it_is_needed(effect, motion)
    nothing_moved_and_nothing_recorded_is_no_trouble(effect)


def parameters_go_out_and_come_back(effect):
    assert type(effect).model_validate(effect.parameters()) == effect
    assert effect.violations() == []


def prediction_is_columns_times_coefficients(effect, motion, start):
    columns = effect.columns(motion, start)
    assert columns.shape == (len(motion), len(effect.coefficients()))
    np.testing.assert_allclose(columns @ effect.coefficients(), effect.predict(motion, start), **CLOSE)


def fitted_takes_back_its_own_coefficients(effect, motion, start):
    again = effect.fitted(effect.coefficients())
    np.testing.assert_allclose(again.predict(motion, start), effect.predict(motion, start), **CLOSE)


def error_scales_with_its_coefficients(effect, motion, start, factor):
    scaled = effect.fitted(factor * effect.coefficients())
    if effect.name == "direction_phase":  # linear at the current shift only
        columns = effect.columns(motion, start)
        np.testing.assert_allclose(
            columns @ scaled.coefficients(), factor * effect.predict(motion, start), **CLOSE
        )
        return
    np.testing.assert_allclose(scaled.predict(motion, start), factor * effect.predict(motion, start), **CLOSE)


def error_stays_within_its_bound(effect, motion, start):
    assert np.all(np.abs(effect.predict(motion, start)) <= effect.bound_arcsec() * (1 + 1e-9) + 1e-7)


def batch_equals_on_line_and_peeking_changes_nothing(effect, motion, start, probes):
    tracker, twin = effect.tracker(start), effect.tracker(start)
    tracked = []
    for angle, now in zip(motion.motor_deg, moments(motion), strict=True):
        for probe in probes:
            elsewhere = tracker.peek(probe, now)
        asked = tracker.peek(float(angle), now)
        assert not isinstance(tracker, Level) or not probes or elsewhere == asked
        tracked.append(tracker.advance(float(angle), now))
        assert tracked[-1] == asked == twin.advance(float(angle), now)
    np.testing.assert_allclose(effect.predict(motion, start), np.array(tracked), **CLOSE)


def error_falls_no_steeper_than_its_slope_bound(effect, motion, start, away):
    """The law holds from one state, as in the inverse, between any two angles that the inverse may try."""
    bound = effect.slope_bound_arcsec_per_deg()
    tracker = effect.tracker(start)
    for angle, now in zip(motion.motor_deg, moments(motion), strict=True):
        tracker.advance(float(angle), now)
    tried = float(motion.motor_deg[-1]) + away + np.array([0.0, 1e-3, 0.1, 1.0, 5.0])
    errors = [tracker.peek(float(each), now) for each in tried]
    if math.isfinite(bound):
        assert np.all(np.diff(errors) >= -bound * np.diff(tried) * (1 + 1e-6) - 1e-7)


def a_missing_channel_is_named_before_and_when_it_is_needed(effect, motion):
    bare = Motion(motion.motor_deg)
    lacking = missing_channels([effect], bare.available())
    assert missing_channels([effect], motion.available()) == {}
    if not lacking:
        effect.predict(bare)
        return
    assert lacking == {effect.name: effect.needs() - {Channel.DIRECTION}}
    with pytest.raises(InputError, match=f"'{effect.name}' needs the channel") as caught:
        effect.predict(bare)
    assert any(each.value in str(caught.value) for each in effect.needs())


def nothing_moved_and_nothing_recorded_is_no_trouble(effect):
    for count in (0, 1):
        zeros = np.zeros(count)
        motion = Motion(zeros, zeros, dict.fromkeys(MEASURED, zeros), load_deg=zeros)
        assert effect.predict(motion).shape == (count,)


@pytest.mark.parametrize("name", NAMES)
def test_memory_of_a_tracker_does_not_grow(name):
    """Memory use grows neither with time nor with ever smaller nested loops, each of them significant."""
    tracker = CATALOGUE[name].candidate(50.0, BASE).tracker()
    if isinstance(tracker, Memoryless):
        return
    sizes = []
    for i in range(2000):
        angle = (-1) ** i * (2000 - i) * 0.0049
        warm = readings({Channel.TEMPERATURE: 20 + 0.01 * i})
        tracker.advance(angle, Moment(0.1 * i, warm, motor_speed_deg_s=angle))
        sizes.append(len(pickle.dumps(tracker)))
    assert sizes[-1] <= max(sizes[:600])


@law
@given(
    data=st.data(),
    excursions=st.lists(st.floats(-60, 60), max_size=4),
    steps=st.lists(st.floats(-20, 20), max_size=12),
    sign=st.sampled_from([-1.0, 1.0]),
    gentle=st.booleans(),
)
def test_beyond_its_memory_a_tracker_is_independent_of_its_start(name, data, excursions, steps, sign, gentle):
    """Two trackers with different pasts agree after travelling `memory_deg` in one direction."""
    effect = data.draw(EXAMPLES[name])
    trackers = [
        (effect.gentle_tracker(start, 30.0) if gentle else None) or effect.tracker(start) for start in Start
    ]
    now = Moment(0.0, direction=1)
    for number, tracker in enumerate(trackers):
        tracker.advance(0.0, now)
        if number and name != "wear":  # wear counts the distance
            for angle in excursions:
                tracker.advance(number * angle, now)
            tracker.advance(0.0, now)
    angle = 0.0
    run = trackers[0].memory_deg * (1.0 + 1e-9)
    for number, step in enumerate([sign * run, *steps]):
        angle += step
        now = Moment(0.01 * number, motor_speed_deg_s=100.0 * step, direction=1)
        first, *others = (tracker.advance(angle, now) for tracker in trackers)
        assert others == pytest.approx([first] * len(others), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_a_candidate_is_within_physical_bounds_and_fits_the_gear(name):
    effect = CATALOGUE[name].candidate(80.0, BASE)
    assert effect.violations() == []
    assert getattr(effect, "ratio", 80.0) == 80.0
    assert effect.bound_arcsec() > 0
    for shape in effect.shape:
        assert shape.lower < shape.upper
        value = getattr(effect, shape.name, None)
        assert value is None or shape.lower <= value <= shape.upper


@pytest.mark.parametrize("name", NAMES)
def test_out_of_bound_parameters_are_reported_as_violations(name):
    effect = CATALOGUE[name].candidate(50.0, BASE)
    astray = effect.fitted(1e9 * np.ones(len(effect.coefficients())))
    assert astray.violations()
    assert not any("Input should" in each for each in astray.violations())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [-1e3, 1e3, 1e6])
def test_tidying_keeps_violations(name, factor):
    candidate = CATALOGUE[name].candidate(50.0)
    effect = candidate.fitted(factor * candidate.coefficients())
    assert bool(effect.tidied(50.0).violations()) >= bool(effect.violations())


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_is_described_completely(name):
    kind = CATALOGUE[name]
    about = kind.about
    for text in (
        about.title,
        about.equation,
        about.signature,
        about.consequence,
        about.remedy,
        about.experiment,
    ):
        assert text
    assert about.source
    assert about.size
    assert kind.compensable.why
    assert set(about.aliases) <= set(CATALOGUE) - {name}
    for field, owner in fields(kind):
        assert owner.model_fields[field].description, f"{name}: {field} has no description"


def fields(model: type[BaseModel]):
    """Field names of a model and of the models within it."""
    for name, field in model.model_fields.items():
        yield name, model
        for inner in getattr(field.annotation, "__args__", (field.annotation,)):
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                yield from fields(inner)
