"""95 % intervals contain 95 % of the draws of their covariance, at every phase."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hdbridge.analysis.intervals import half_widths, leaves
from hdbridge.analysis.linear import Column
from hdbridge.axis.effects import MotorOrder, Synchronous

DRAWS = 4000
COLUMNS = (Column(0, "0"), Column(0, "1"))


@pytest.mark.parametrize("phase_deg", [-179.99, -90.0, 3.0, 179.99])
def test_an_interval_contains_95_percent_of_the_draws_of_its_covariance(phase_deg: float) -> None:
    effect = Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=20.0, phase_deg=phase_deg),))
    root = np.array([[0.3, 0.0], [0.1, 0.2]])
    half = half_widths(effect, COLUMNS, root @ root.T)
    value = dict(leaves(effect.parameters()))
    moved = effect.coefficients() + np.random.default_rng(1).standard_normal((DRAWS, 2)) @ root.T
    held = dict.fromkeys(half, 0)
    for each in moved:
        for name, drawn in leaves(effect.fitted(each).parameters()):
            off = drawn - value[name]
            if name.endswith("phase_deg"):
                off = math.remainder(off, 360.0)
            held[name] += abs(off) <= half[name]
    assert held.keys() == {"orders[2].amplitude_arcsec", "orders[2].phase_deg"}
    scatter = math.sqrt(0.95 * 0.05 / DRAWS)
    for count in held.values():
        assert abs(count / DRAWS - 0.95) < 4.0 * scatter
