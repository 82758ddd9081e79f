"""The hysteresis law is chosen by prediction of held-out data."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.legs import fit

from hdbridge.axis.effects import Hysteresis, HysteresisMemory
from hdbridge.axis.model import TransmissionModel

SLIP = ((0.3, 2.0), (0.3, 6.0), (0.2, 12.0), (0.2, 20.0))
"""Share of the loop and travel to its limit, motor degrees, of springs with sliders in parallel."""


def slipping(bench: Any) -> Any:
    """An axis whose load is held back by springs that slide."""

    class Slipping(bench.axis):  # type: ignore[misc, name-defined]
        def error(self, motor_deg: Any, state: float = 1.0) -> Any:
            loop = np.zeros(len(motor_deg))
            for share, travel in SLIP:
                spring = state
                for index, step in enumerate(np.diff(motor_deg, prepend=motor_deg[0])):
                    spring = min(max(spring + step / travel, -1.0), 1.0)
                    loop[index] += share * spring
            ripple = replace(self, offset=0.0)
            return bench.axis.error(ripple, motor_deg, state) - self.offset * loop

    return Slipping(offset=25.0)


def beyond(bench: Any) -> Any:
    """The plan, and small steps back from a branch that then continues, which only memory forgets."""
    legs = [("move", bench.ramp(0.0, -60.0, 400.0))]
    for depth in (1.0, 2.0, 4.0, 2.0, 1.0):
        for begin, to in ((-60.0, -53.0), (-53.0, -53.0 - depth), (-53.0 - depth, 0.0), (0.0, -60.0)):
            legs.append(("reversal", bench.ramp(begin, to, 10.3)))
    return [*bench.plan(turns=3.0), *legs]


def test_friction_that_yields_before_it_slips_is_fitted_with_memory(bench: Any) -> None:
    record = slipping(bench).record(beyond(bench))
    found = fit(record, 20.0, replace(bench.options, highest_order=6))
    (loop,) = [each for each in found.model.effects if isinstance(each, HysteresisMemory)]
    assert loop.offset_arcsec == pytest.approx(-25.0, abs=2.0)
    assert not any(isinstance(each, Hysteresis) for each in found.model.effects)
    assert "offset_arcsec" in found.model.uncertainty["hysteresis_memory"]


def test_a_wrong_law_of_the_active_model_is_replaced(standard: Any, bench: Any) -> None:
    (plain,) = [each for each in standard.model.effects if isinstance(each, Hysteresis)]
    active = TransmissionModel(20.0, (HysteresisMemory(**plain.parameters()),))
    options = replace(bench.options, highest_order=6, active=active)
    found = fit(bench.axis().record(beyond(bench)), 20.0, options)
    assert [each.name for each in found.model.effects] == ["synchronous", "hysteresis"]
