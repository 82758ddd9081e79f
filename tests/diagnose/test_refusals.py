"""Tests that a cause that a rule refuses is reported with the reason, and may be an alias of another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.effects import (
    CATALOGUE,
    ChannelSkew,
    CountLoss,
    Effect,
    InertialWindup,
    LocalDefect,
    MotorOrders,
    VelocityWindup,
)
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record


def test_linear_drag_is_reported_as_a_delay_with_alias(
    diagnosed: Callable[..., Diagnosis],
) -> None:
    straight = {"coulomb": 0.0, "viscous": 0.02, "shear": 1e9}
    result = diagnosed({"velocity_windup": straight})
    (found,) = result.findings
    assert found.cause == ChannelSkew.name
    assert VelocityWindup.name in found.aliases


@pytest.mark.parametrize(
    ("drag", "inertia_s2", "names"),
    [
        ({"coulomb": 0.07, "viscous": 0.0145, "shear": 780.0}, 5e-6, {VelocityWindup.name}),  # too small
        (
            {"coulomb": 0.07, "viscous": 0.02, "shear": 1500.0},
            6e-5,
            {VelocityWindup.name, InertialWindup.name},
        ),
    ],
)
def test_inertial_wind_up_does_not_turn_drag_into_a_delay(
    diagnosed: Callable[..., Diagnosis], drag: dict[str, float], inertia_s2: float, names: set[str]
) -> None:
    """A delay, too, has an acceleration term, and its linear speed term may cancel that of the drag."""
    result = diagnosed({"velocity_windup": drag, "inertial_windup": {"s2": inertia_s2}})
    assert {each.cause for each in result.findings} == names


def test_refused_causes_are_reported_if_nothing_else_explains_them(
    diagnosed: Callable[..., Diagnosis],
) -> None:
    """A load that leads while accelerating is neither inertial wind-up nor a delay."""
    result = diagnosed({"inertial_windup": {"s2": -1.2e-4}})
    assert [each.cause for each in result.findings] == ["unexplained"]
    reasons = {each.split(": ")[0]: each for each in result.as_dict()["considered"]}
    assert ChannelSkew.name not in reasons
    assert "inertia_over_stiffness_s2" in reasons[InertialWindup.name]


@pytest.mark.parametrize(
    ("unknown", "refused"),
    [
        ({"kind": "packet", "size": 6.0, "width": 12.0}, LocalDefect),  # several adjacent waves
        ({"kind": "heated", "size": 6.0, "tau": 40.0}, CountLoss),  # rises within seconds, not in a step
    ],
)
def test_parts_of_an_unknown_cause_are_not_named(
    diagnosed: Callable[..., Diagnosis], unknown: dict[str, Any], refused: type[Effect]
) -> None:
    result = diagnosed({"unknown": unknown})
    assert [each.cause for each in result.findings] == ["unexplained"]
    assert f"{refused.name}: not the same everywhere" in result.considered


def test_the_search_continues_after_a_refusal(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four impossible causes explain more of the error than the possible one."""
    for kind in CATALOGUE.values():
        if kind is not MotorOrders:
            monkeypatch.setattr(kind, "implausible", lambda *_: "cannot be")
    larger = {
        "load_order": {"orders": [(1, 9.0, 20.0)]},
        "flexspline_order": {"orders": [(2, 6.0, 50.0)]},
        "count_loss": {"size": 8.0, "at": 0.5},
        "backlash": {"gap": 12.0},
    }
    hidden = larger | {"motor_order": {"orders": [(7, 1.2, 20.0)]}}
    result = diagnose(Record(columns(hidden)), model)
    reported = {each.cause for each in result.findings} | {each.split(":")[0] for each in result.considered}
    assert MotorOrders.name in reported
