"""Effects combined in a model, and their compensation."""

import math

import numpy as np
import pytest

from hdbridge.axis.effects import (
    CATALOGUE,
    AmplitudeDrift,
    Backlash,
    Channel,
    CountLoss,
    DirectionPhase,
    Hysteresis,
    HysteresisMemory,
    HysteresisParameters,
    LoadOrders,
    Loop,
    Motion,
    MotorOrder,
    MotorOrders,
    RateDependence,
    TorqueModulation,
    compensable,
    conflicts,
    extended,
    fall_bound,
    refreshed,
)
from hdbridge.axis.model import TransmissionModel

RATIO = 50.0
BASE = (CATALOGUE["synchronous"].candidate(RATIO), CATALOGUE["hysteresis"].candidate(RATIO))


def names(effects):
    return [each.name for each in effects]


def test_the_law_with_memory_replaces_the_plain_one_and_back():
    memory = HysteresisMemory.candidate(RATIO, BASE)
    effects = extended(BASE, memory)
    assert names(effects) == ["synchronous", "hysteresis_memory"]
    assert names(extended(effects, BASE[1])) == ["synchronous", "hysteresis"]


def test_a_ripple_that_is_loaded_and_warm_has_changed_by_both():
    growth = TorqueModulation.candidate(RATIO, BASE).fitted(np.array([4.0]))
    drift = AmplitudeDrift.candidate(RATIO, BASE).fitted(np.array([-2.0, 0.0]))
    synchronous, _, growth, drift = refreshed([*BASE, growth, drift])
    time_s = np.linspace(0.0, 100.0, 500)
    torque, temperature = np.linspace(-9.0, 9.0, 500), np.full(500, 26.0)
    motion = Motion(
        7.0 * time_s, time_s=time_s, measured={Channel.LOAD_TORQUE: torque, Channel.TEMPERATURE: temperature}
    )
    total = sum(each.predict(motion) for each in (synchronous, growth, drift))
    expected = synchronous.predict(motion) * (1.0 + 0.04 * np.abs(torque)) * (1.0 - 0.02 * 6.0)
    np.testing.assert_allclose(total, expected, atol=1e-9)
    assert refreshed([*BASE, drift])[2].under_load is None


@pytest.mark.parametrize("law", [Hysteresis, HysteresisMemory])
def test_changed_parameters_go_into_the_models_own_loop(law):
    loop = law(offset_arcsec=40, width_deg=20, exponent=1.6)
    change = HysteresisParameters.candidate(RATIO, [loop])
    effects = extended([BASE[0], loop], change)
    assert names(effects) == ["synchronous", law.name]
    assert effects[1].offset_arcsec == pytest.approx(48)
    path = Motion(np.array([0.0, 30.0, 25.0, 27.0, 20.0, 40.0]))
    np.testing.assert_allclose(effects[1].predict(path), loop.predict(path) + change.predict(path), atol=1e-9)


def test_new_causes_are_added_and_known_ones_updated():
    once = extended(BASE, Backlash(gap_arcsec=10.0, crossing_deg=0.2))
    assert names(once) == ["synchronous", "hysteresis", "backlash"]
    twice = extended(once, Backlash(gap_arcsec=5.0, crossing_deg=0.1))
    assert names(twice) == names(once)
    assert twice[2].gap_arcsec == 5.0


def test_copied_parameters_follow_their_source():
    effects = extended(BASE, RateDependence.candidate(RATIO, BASE))
    effects = extended(effects, HysteresisParameters.candidate(RATIO, BASE))
    assert effects[2].loop == Loop(offset_arcsec=48, width_deg=20, exponent=1.6)
    phase = DirectionPhase(orders=(MotorOrder(order=2, amplitude_arcsec=1, phase_deg=0),), shift_deg=1)
    assert refreshed([*BASE, phase])[2].orders == BASE[0].orders
    assert refreshed([BASE[1], phase])[1].orders == phase.orders


def test_an_order_that_was_added_changes_with_the_others():
    new = MotorOrder(order=9, amplitude_arcsec=2.0, phase_deg=30.0)
    (*_, phase) = refreshed([*BASE, MotorOrders(orders=(new,)), DirectionPhase.candidate(RATIO, BASE)])
    assert phase.orders == (*BASE[0].orders, new)


def test_errors_of_the_measurement_are_left_out_of_the_compensation():
    every = [each.candidate(RATIO, BASE) for each in CATALOGUE.values()]
    left = set(names(every)) - set(names(compensable(every)))
    assert left == {"channel_skew", "subdivisional_error", "load_order", "count_loss", "vibration"}
    assert CountLoss.compensable.why


def test_a_shrinking_additional_loop_stays_monotonic():
    drift = AmplitudeDrift.candidate(RATIO, BASE)
    assert drift.slope_bound_arcsec_per_deg() == math.inf
    assert math.isfinite(fall_bound([*BASE, drift]))
    assert fall_bound([drift]) == math.inf
    greedy = drift.model_copy(update={"friction_percent_per_k": -2.0})
    assert fall_bound([*BASE, greedy]) == math.inf
    assert fall_bound(BASE) == sum(each.slope_bound_arcsec_per_deg() for each in BASE)


def test_incompatible_effects_are_reported():
    order = LoadOrders.candidate(80.0)
    assert conflicts([*BASE, order], 80.0) == ()
    (conflict,) = conflicts([*BASE, order], RATIO)
    assert "load_order" in conflict
    assert "80" in conflict
    (conflict,) = conflicts([*BASE, HysteresisMemory.candidate(RATIO, BASE)], RATIO)
    assert conflict.startswith("'hysteresis_memory' replaces 'hysteresis'")


def test_the_hysteresis_scheme_uses_the_substituted_law():
    model = TransmissionModel(ratio=RATIO, effects=extended(BASE, HysteresisMemory.candidate(RATIO, BASE)))
    assert names(model.only(["hysteresis"]).effects) == ["hysteresis_memory"]
    assert names(model.only(["synchronous"]).effects) == ["synchronous"]
