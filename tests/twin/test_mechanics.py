"""Regression of load inertia and friction, on axes whose servos the simulated drive does not have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from foreign.draw import Truth as Foreign
from foreign.draw import draw
from foreign.servos import STRUCTURES
from twin.test_structures import FITTED
from twin_foreign_axes import axis_of, bench, start

from hdbridge.motion.procedures.plan import Plan
from hdbridge.twin.mechanics import measured_mechanics
from hdbridge.twin.misfit import Data, prepare
from hdbridge.twin.parameters import TORQUE

PLAN = Plan.model_validate(yaml.safe_load(FITTED))


def recorded(foreign: Foreign) -> Data:
    """Records the axis, and prepares the recording for a fit that starts at usual values."""
    axis = axis_of(foreign)
    return prepare(bench(foreign, PLAN), axis, start(axis, foreign))


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_mechanics_are_measured_whatever_the_servo(structure: str) -> None:
    foreign = draw(3, structure)
    found, true = measured_mechanics(recorded(foreign)), foreign.mechanics
    assert found["load inertia"] == pytest.approx(true.load_inertia_kg_m2, rel=0.3)
    assert found["Coulomb friction"] == pytest.approx(true.coulomb_nm, rel=0.2)


def test_a_record_without_torque_shows_no_mechanics() -> None:
    data = recorded(draw(3, "piv"))
    silent = tuple(
        replace(each, counts={**each.counts, TORQUE: np.zeros_like(each.out)}) for each in data.pieces
    )
    assert measured_mechanics(replace(data, pieces=silent)) == {}
