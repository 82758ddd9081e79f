"""Regression of the mechanics, on axes whose servos the simulated drive does not have."""

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
from hdbridge.sim.truth import Truth
from hdbridge.twin.check import check
from hdbridge.twin.fit import free_parameters, solve, start_of
from hdbridge.twin.mechanics import measured_mechanics
from hdbridge.twin.misfit import Data, Replays, Values, prepare
from hdbridge.twin.parameters import TORQUE
from hdbridge.twin.twin import with_knowledge

PLAN = Plan.model_validate(yaml.safe_load(FITTED))


def recorded(foreign: Foreign) -> Data:
    """Records the axis, and prepares the recording for a fit that starts at usual values."""
    axis = axis_of(foreign)
    return prepare(bench(foreign, PLAN), axis, start(axis, foreign))


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_mechanics_are_measured_whatever_the_servo(structure: str) -> None:
    foreign = draw(3, structure)
    found, true = measured_mechanics(recorded(foreign)), foreign.mechanics
    assert found["load inertia"].value == pytest.approx(true.load_inertia_kg_m2, rel=0.3)
    assert found["gear stiffness"].value == pytest.approx(true.stiffness_nm_per_rad, rel=0.3)
    assert found["Coulomb friction"].value == pytest.approx(true.coulomb_nm, rel=0.2)


def test_a_record_without_torque_shows_no_mechanics() -> None:
    data = recorded(draw(3, "piv"))
    silent = tuple(
        replace(each, counts={**each.counts, TORQUE: np.zeros_like(each.out)}) for each in data.pieces
    )
    assert measured_mechanics(replace(data, pieces=silent)) == {}


def changed(foreign: Foreign, **factors: float) -> Foreign:
    """Returns the axis with some mechanical parameters multiplied by factors, and with other noise."""
    values = {name: factor * getattr(foreign.mechanics, name) for name, factor in factors.items()}
    return replace(foreign, mechanics=replace(foreign.mechanics, **values), seed=foreign.seed + 1)


@pytest.fixture(scope="module")
def unfitted() -> tuple[Foreign, Truth]:
    """An axis, and a twin of it with the usual servo, which does not follow its motion."""
    foreign = draw(3, "piv")
    data = recorded(foreign)
    begun = start_of(data.base, data, measured_mechanics(data))
    with Replays(data, 1) as replays:
        fitted = solve(replays, begun, free_parameters(begun), 0)
    return foreign, with_knowledge(fitted, data, Values.REPLAY)


CHANGES = {
    "friction": {"coulomb_nm": 2.0},
    "load inertia": {"load_inertia_kg_m2": 1.5},
    "gear stiffness": {"stiffness_nm_per_rad": 0.7},
}


@pytest.mark.parametrize("cause", [*CHANGES, None])
def test_a_change_of_the_mechanics_is_not_attributed_to_a_wrong_servo(
    unfitted: tuple[Foreign, Truth], cause: str | None
) -> None:
    foreign, twin = unfitted
    later = changed(foreign, **CHANGES.get(cause, {}))
    found = check(bench(later, PLAN), axis_of(foreign), twin, workers=1)
    named = [each.cause for each in found.changes if each.cause in CHANGES]
    assert named == ([cause] if cause else [])
