"""What the evidence speaks for and a rule refuses is told, and may still be an alias of what is named."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from hdbridge.diagnose import Diagnosis
from hdbridge.effects import ChannelSkew, CountLoss, Effect, InertialWindup, LocalDefect, VelocityWindup


def test_a_drag_that_does_not_bend_is_told_as_a_delay_and_stays_its_alias(
    diagnosed: Callable[..., Diagnosis],
) -> None:
    straight = {"coulomb": 0.0, "viscous": 0.02, "shear": 1e9}
    result = diagnosed({"velocity_windup": straight})
    (found,) = result.findings
    assert found.cause == ChannelSkew.name
    assert VelocityWindup.name in found.aliases


def test_what_was_refused_is_told_where_nothing_else_explains_it(diagnosed: Callable[..., Diagnosis]) -> None:
    """A load that runs ahead as it speeds up is no inertia on a spring, and no delay either."""
    result = diagnosed({"inertial_windup": {"s2": -1.2e-4}})
    assert [each.cause for each in result.findings] == ["unexplained"]
    told = {each.split(": ")[0]: each for each in result.as_dict()["considered"]}
    assert "too much of it follows the acceleration" in told[ChannelSkew.name]
    assert "inertia_over_stiffness_s2" in told[InertialWindup.name]


@pytest.mark.parametrize(
    ("unknown", "refused"),
    [
        ({"kind": "packet", "size": 6.0, "width": 12.0}, LocalDefect),  # waves next to one another
        ({"kind": "heated", "size": 6.0, "tau": 40.0}, CountLoss),  # rises within seconds, not at once
    ],
)
def test_no_piece_of_something_unknown_is_named(
    diagnosed: Callable[..., Diagnosis], unknown: dict[str, Any], refused: type[Effect]
) -> None:
    result = diagnosed({"unknown": unknown})
    assert [each.cause for each in result.findings] == ["unexplained"]
    assert f"{refused.name}: not the same everywhere" in result.considered
