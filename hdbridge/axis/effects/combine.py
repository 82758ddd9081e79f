"""Combines effects in one model: extends it, updates copies of parts, selects compensable effects."""

import math
from collections.abc import Iterable

from hdbridge.axis.effects.amplitude_drift import AmplitudeDrift
from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Loop, growth_of, loop_of
from hdbridge.axis.effects.described import Part
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.hysteresis_memory import HysteresisMemory
from hdbridge.axis.effects.hysteresis_parameters import HysteresisParameters
from hdbridge.axis.effects.motor_order import MotorOrders
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.effects.torque import TorqueGrowth

_LAWS = (Hysteresis, HysteresisMemory)


def extended(effects: Iterable[Effect], new: Effect) -> tuple[Effect, ...]:
    """Returns the effects of a model after addition of a new one.

    The new effect replaces an effect of the same name, or the one that it replaces by definition
    (`hysteresis_memory` replaces `hysteresis`, and vice versa). Changed hysteresis parameters are written
    into the model's own loop. Any other effect is added. Copies of the changed part in other effects are
    updated (`refreshed`).
    """
    given = list(effects)
    if isinstance(new, HysteresisParameters):
        new = new.changed().law()
    old = {new.name, new.replaces} | {each.name for each in given if each.replaces == new.name}
    places = [i for i, each in enumerate(given) if each.name in old]
    if places:
        given[places[0]] = new
        given = [each for i, each in enumerate(given) if i not in places[1:]]
    else:
        given.append(new)
    return refreshed(given)


def refreshed(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Returns the effects with their copies of orders and loop updated to those of the model.

    The orders are those of the synchronous part and of any added motor orders, because a change of the tooth
    error affects all of them. If the model has no synchronous part, the copies remain unchanged.
    """
    given = tuple(effects)
    loop = loop_of(given) if any(isinstance(each, _LAWS) for each in given) else None
    series = [each for each in given if isinstance(each, Synchronous | MotorOrders)]
    orders: tuple[MotorOrder, ...] | None = None
    if any(isinstance(each, Synchronous) for each in series):
        # If an order occurs twice, that of the synchronous part is used, because a fit cannot separate the
        # two.
        by_number = {order.order: order for each in reversed(series) for order in each.orders}
        orders = tuple(by_number[number] for number in sorted(by_number))
    growth = growth_of(given)
    return tuple(_refreshed(each, loop, orders, growth) for each in given)


def _refreshed(
    effect: Effect, loop: Loop | None, orders: tuple[MotorOrder, ...] | None, growth: TorqueGrowth | None
) -> Effect:
    carries = effect.carries
    update: dict[str, object] = {}
    if Part.GROWTH in carries:
        update[carries[Part.GROWTH]] = growth
    if loop is not None and Part.LOOP in carries:
        update[carries[Part.LOOP]] = loop
    if orders and Part.ORDERS in carries:
        update[carries[Part.ORDERS]] = orders
    return effect.model_copy(update=update) if update else effect


def in_place(effect: Effect, kinds: Iterable[type[Effect]]) -> tuple[Effect, ...]:
    """Returns alternative laws for an effect, with its parameters (see `Effect.replaces`).

    A fit may have moved the parameters out of their ranges. `violations` reports this.
    """
    return tuple(
        kind.model_construct(**effect.parameters())
        for kind in kinds
        if kind.replaces == effect.name or effect.replaces == kind.name
    )


def compensable(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Returns the effects that a compensation should correct: real, predictable motions of the load."""
    return tuple(each for each in effects if each.is_compensable())


def fall_bound(effects: Iterable[Effect]) -> float:
    """Returns an upper bound of the negative slope of the *sum* of effects, arcsec per motor degree.

    It is the sum of the effects' own bounds, with one exception. An effect that removes a fraction of the
    model's loop falls as steeply as the loop rises. The sum of both still rises if no more than the whole
    loop is removed. (An effect on the loop of a lagging load may fall without bound.)
    """
    given = tuple(effects)
    left = {
        _key(Loop(**each.parameters(), memory=isinstance(each, HysteresisMemory))): 1.0
        for each in given
        if isinstance(each, _LAWS) and each.offset_arcsec >= 0.0
    }
    total = 0.0
    for each in given:
        if isinstance(each, AmplitudeDrift) and each.friction_percent_per_k:
            key = _key(each.loop)
            left[key] = left.get(key, 0.0) - each.loop_share()
            total += each.ripple_fall() if left[key] >= 0.0 else math.inf
        else:
            total += each.slope_bound_arcsec_per_deg()
    return total


def _key(loop: Loop) -> tuple[object, ...]:
    return tuple(loop.model_dump().values())


def conflicts(effects: Iterable[Effect], ratio: float) -> tuple[str, ...]:
    """Returns the reasons why the effects cannot form one model with this gear ratio; empty if they can."""
    given = tuple(effects)
    names = {each.name for each in given}
    return (
        *(
            f"'{each.name}' replaces '{each.replaces}': keep only one of the two"
            for each in given
            if each.replaces in names
        ),
        *(
            f"'{each.name}' was made for a gear of ratio {theirs:g}, but the model's ratio is {ratio:g}"
            for each in given
            if not math.isclose(theirs := getattr(each, "ratio", ratio), ratio, rel_tol=1e-9)
        ),
    )
