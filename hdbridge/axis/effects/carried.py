"""Model parts of which a modulating effect contains copies: orders, their growth with torque, the loop.

`torque_modulation`, for example, states that the synchronous part grows with torque. The effect contains a
copy of the modulated part, so that it can be predicted, tracked and read without the rest of the model. The
copy is taken from the model when the effect is created, and `combine.refreshed` keeps it up to date.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import Field

from hdbridge.axis.effects.base import Effect, Linear
from hdbridge.axis.effects.described import Part
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.hysteresis_memory import HysteresisMemory
from hdbridge.axis.effects.orders import MotorOrder, orders_from
from hdbridge.axis.effects.synchronous import TYPICAL_ORDERS, Synchronous
from hdbridge.axis.effects.torque import TorqueGrowth
from hdbridge.strictness import Strict


class Loop(Strict):
    """Copy of the elastic loop that an effect modulates: the parameters of its law."""

    offset_arcsec: float = Field(
        ge=-3600, le=3600, description="half the height, at the load; negative if the load lags"
    )
    width_deg: float = Field(gt=0, le=3600, description="motor angle of a full crossing")
    exponent: float = Field(gt=1, le=6, description="shape n of the branch")
    memory: bool = Field(False, description="with return-point memory (hysteresis_memory)")

    def law(self) -> Hysteresis | HysteresisMemory:
        kind = HysteresisMemory if self.memory else Hysteresis
        # Not validated: during a fit the parameters may be out of range, like those of the original.
        return kind.model_construct(
            offset_arcsec=self.offset_arcsec, width_deg=self.width_deg, exponent=self.exponent
        )


TYPICAL_LOOP = Loop(offset_arcsec=40.0, width_deg=20.0, exponent=1.6)
"""Loop of a published gear with ratio 50 (Table 2 of the article that hdbridge implements)."""


BASIC: Final = frozenset({Synchronous.name, Hysteresis.name})
"""Names of the two basic parts of a model."""
USUAL_LOOP: Final[Effect] = Hysteresis(offset_arcsec=40.0, width_deg=20.0, exponent=1.8)
"""Initial value of the loop in a fit."""


def ripple(numbers: Iterable[int]) -> Effect:
    """Returns a ripple with these motor orders at zero amplitude, as the initial value of a fit."""
    return Synchronous(orders=orders_from(numbers, 0.0))


def is_ripple(effect: Effect) -> bool:
    """Returns True if an effect is the model's ripple rather than additional orders."""
    return isinstance(effect, Synchronous)


def loop_of(base: Iterable[Effect]) -> Loop:
    """Returns the loop of a model's elastic law, of either kind; a typical loop if the model has none."""
    for each in base:
        if isinstance(each, Hysteresis | HysteresisMemory):
            return Loop.model_construct(**each.parameters(), memory=isinstance(each, HysteresisMemory))
    return TYPICAL_LOOP


def orders_of(base: Iterable[Effect]) -> tuple[MotorOrder, ...]:
    """Returns the orders of a model's synchronous part; typical orders if the model has none."""
    for each in base:
        if isinstance(each, Synchronous) and each.orders:
            return each.orders
    return TYPICAL_ORDERS


def has_loop(base: Iterable[Effect]) -> bool:
    """Returns True if a model has a loop that can be scaled."""
    return any(each.part is Part.LOOP for each in base)


def has_orders(base: Iterable[Effect]) -> bool:
    """Returns True if a model has a ripple that can be scaled."""
    return any(isinstance(each, Synchronous) and each.orders for each in base)


def growth_of(base: Iterable[Effect]) -> TorqueGrowth | None:
    """Returns the growth of a model's orders with torque, or None; a fit may have moved it out of range."""
    for each in base:
        if isinstance(each, TorqueGrowth):
            values = {name: getattr(each, name) for name in TorqueGrowth.model_fields}
            return TorqueGrowth.model_construct(**values)
    return None


class Modulating(Linear):
    """Base class of effects that scale parts of a model and contain copies of them."""

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        parts: Mapping[Part, Callable[[Sequence[Effect]], Any]] = {
            Part.ORDERS: orders_of,
            Part.LOOP: loop_of,
            Part.GROWTH: growth_of,
        }
        return {field: parts[part](base) for part, field in cls.carries.items()}
