"""Starting values of a fit, read off a recording without any replay."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import read_off
from hdbridge.twin.misfit import prepare
from hdbridge.twin.parameters import with_values

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)
TRUTH = with_values(Truth.load(DEMO), {"viscous friction": 5e-4})


def test_where_the_weight_is_told_one_way_is_enough_for_friction() -> None:
    """Friction has one sense there; a weight of which nobody knows would be as good a reason for it."""

    def one_way(bench: Exercise) -> None:
        bench.hold(0.6)
        bench.move(900.0, 1200.0, 6000.0)

    found = read_off(prepare(Recording(record_of(TRUTH, one_way), axis="demo", ratio=50.0), AXIS, TRUTH))
    assert found.coulomb_nm == pytest.approx(TRUTH.motor.coulomb_nm, rel=0.1)
    assert found.viscous_nm_s_per_rad == pytest.approx(TRUTH.motor.viscous_nm_s_per_rad, rel=0.2)
