"""Conversion of the gear's elastic loop between the plant's hysteresis laws.

A calibration's model has one law, whose shape may differ from the gear's. Its offset is then biased, because
the data include partial loops as well as whole ones.
"""

from __future__ import annotations

from typing import Any, Final

from pydantic import TypeAdapter
from scipy.optimize import brentq

from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.hysteresis import Hysteresis, MaxwellSlip
from hdbridge.twin.parameters import BY_NAME, Parameter, value_in

LOOP: Final = ("loop offset", "loop width", "loop yield", "loop exponent")
"""Parameters of the laws; no law has all of them."""
LAWS: Final[tuple[dict[str, Any], ...]] = (
    {"law": "rolling_friction", "offset_arcsec": 1.0, "width_deg": 1.0, "exponent": 1.6},
    {"law": "bouc_wen", "offset_arcsec": 1.0, "yield_deg": 1.0},
    {"law": "dahl", "offset_arcsec": 1.0, "yield_deg": 1.0},
)
"""Unit loops by the laws with few parameters; the exponent of the first is that of a published gear."""
LONG = 20.0
"""Travel after which each loop has reached its limit; widths."""
_TRUE: Final[TypeAdapter[Hysteresis]] = TypeAdapter(Hysteresis)


def loop_parameters(truth: Truth) -> tuple[Parameter, ...]:
    """Returns the parameters that the law of this truth has."""
    return tuple(BY_NAME[name] for name in LOOP if value_in(truth, BY_NAME[name]) is not None)


def by_each_law(truth: Truth) -> list[Truth]:
    """Returns the truth, and the truth with each other law; an empty list if the gear has no loop."""
    own = truth.gear.hysteresis
    if own is None:
        return []
    if own.law == "rolling_friction":
        # A fit may reduce the loop below its initial state, which has no effect after some travel.
        truth = _with_loop(truth, own.model_copy(update={"start_arcsec": 0.0}))
    return [truth, *(_with_loop(truth, _like(own, each)) for each in LAWS if each["law"] != own.law)]


def by_law_of(truth: Truth, other: Truth) -> Truth:
    """Returns the truth with its loop converted to the law of another truth."""
    own, law = truth.gear.hysteresis, other.gear.hysteresis
    if own is None or law is None or own.law == law.law:
        return truth
    return _with_loop(truth, _like(own, next(each for each in LAWS if each["law"] == law.law)))


def _like(own: Hysteresis, unit: dict[str, Any]) -> Hysteresis:
    """Returns a loop of another law with the same height and the same travel to half crossing."""
    travel_deg = _half_crossed_deg(own) / _half_crossed_deg(_TRUE.validate_python(unit))
    size = "width_deg" if "width_deg" in unit else "yield_deg"
    return _TRUE.validate_python(unit | {"offset_arcsec": _offset_arcsec(own), size: travel_deg})


def _half_crossed_deg(loop: Hysteresis) -> float:
    """Returns the motor travel after a reversal at which the error crosses zero; degrees."""
    far_deg = LONG * _width_deg(loop)

    def left(travel_deg: float) -> float:
        law = law_of(loop, 0.0)
        assert law is not None
        law.advance(far_deg)
        return law.advance(far_deg - travel_deg)

    return float(brentq(left, 0.0, far_deg))


def _offset_arcsec(loop: Hysteresis) -> float:
    if isinstance(loop, MaxwellSlip):
        return sum(each.limit_arcsec for each in loop.elements)
    return loop.offset_arcsec


def _width_deg(loop: Hysteresis) -> float:
    if isinstance(loop, MaxwellSlip):
        return 2.0 * max(each.yield_deg for each in loop.elements)
    return loop.width_deg if loop.law == "rolling_friction" else loop.yield_deg


def _with_loop(truth: Truth, loop: Hysteresis) -> Truth:
    return truth.model_copy(update={"gear": truth.gear.model_copy(update={"hysteresis": loop})})
