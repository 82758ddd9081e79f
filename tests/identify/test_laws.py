"""Tests that the hysteresis law is chosen by its prediction of held-out data."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.legs import fit

from hdbridge.axis.effects import Hysteresis, HysteresisMemory
from hdbridge.axis.model import TransmissionModel

SLIP = ((0.3, 2.0), (0.3, 6.0), (0.2, 12.0), (0.2, 20.0))
"""Fraction of the loop, and travel to the limit, motor degrees, of each Maxwell slip element."""


def slip(motor_deg: Any, state: float) -> Any:
    """Returns the Maxwell slip loop with the elements `SLIP`, as a fraction of the offset."""
    steps = np.diff(motor_deg, prepend=motor_deg[0])
    loop = np.zeros(len(motor_deg))
    for share, travel in SLIP:
        spring = state
        for index, step in enumerate(steps):
            spring = min(max(spring + step / travel, -1.0), 1.0)
            loop[index] += share * spring
    return loop


def bouc_wen(motor_deg: Any, state: float) -> Any:
    """Returns a Bouc-Wen loop (yield travel 5 deg, exponent 1.1, beta 0.75), which saturates slowly."""
    loop, z = np.zeros(len(motor_deg)), state
    for index, step in enumerate(np.diff(motor_deg, prepend=motor_deg[0])):
        pieces = max(1, int(abs(step) / 0.25))
        for _ in range(pieces):
            z += step / pieces / 5.0 * (1.0 - abs(z) ** 1.1 * (0.25 + np.copysign(0.75, z * step)))
        loop[index] = z
    return loop


def lagging(bench: Any, law: Any) -> Any:
    """Returns an axis whose load lags by 25 arcsec times the loop of a given law."""

    class Lagging(bench.axis):  # type: ignore[misc, name-defined]
        def error(self, motor_deg: Any, state: float = 1.0) -> Any:
            ripple = replace(self, offset=0.0)
            return bench.axis.error(ripple, motor_deg, state) - self.offset * law(motor_deg, state)

    return Lagging(offset=25.0)


def beyond(bench: Any) -> Any:
    """Returns the plan, extended by small reversals within a branch, after which only a law with return-point
    memory continues on the branch.
    """
    legs = [("move", bench.ramp(0.0, -60.0, 400.0))]
    for depth in (1.0, 2.0, 4.0, 2.0, 1.0):
        for begin, to in ((-60.0, -53.0), (-53.0, -53.0 - depth), (-53.0 - depth, 0.0), (0.0, -60.0)):
            legs.append(("reversal", bench.ramp(begin, to, 10.3)))
    return [*bench.plan(turns=3.0), *legs]


def test_friction_that_yields_before_it_slips_is_fitted_with_memory(bench: Any) -> None:
    record = lagging(bench, slip).record(beyond(bench))
    found = fit(record, 20.0, replace(bench.options, highest_order=6))
    (loop,) = [each for each in found.model.effects if isinstance(each, HysteresisMemory)]
    assert loop.offset_arcsec == pytest.approx(-25.0, abs=2.0)
    assert not any(isinstance(each, Hysteresis) for each in found.model.effects)
    assert "offset_arcsec" in found.model.uncertainty["hysteresis_memory"]


def test_a_loop_of_another_shape_does_not_bend_the_offset(bench: Any) -> None:
    """A misfit of the loop's shape is not a drift: samples far from turning points determine the offset."""
    found = fit(lagging(bench, bouc_wen).record(bench.plan()), 20.0, replace(bench.options, highest_order=6))
    (loop,) = found.model.effects[1:]
    assert loop.offset_arcsec == pytest.approx(-25.0, abs=0.5)


def test_a_wrong_law_of_the_active_model_is_replaced(standard: Any, bench: Any) -> None:
    (plain,) = [each for each in standard.model.effects if isinstance(each, Hysteresis)]
    active = TransmissionModel(20.0, (HysteresisMemory(**plain.parameters()),))
    options = replace(bench.options, highest_order=6, active=active)
    found = fit(bench.axis().record(beyond(bench)), 20.0, options)
    assert [each.name for each in found.model.effects] == ["synchronous", "hysteresis"]
