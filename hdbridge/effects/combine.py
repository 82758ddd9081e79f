"""How effects go together in one model: extend, keep carried parts in step, what may be compensated."""

from __future__ import annotations

import math
from collections.abc import Iterable

from hdbridge.effects.amplitude_drift import AmplitudeDrift
from hdbridge.effects.base import Effect, Part
from hdbridge.effects.carried import Loop, growth_of, loop_of
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.hysteresis_parameters import HysteresisParameters
from hdbridge.effects.motor_order import MotorOrders
from hdbridge.effects.orders import MotorOrder
from hdbridge.effects.synchronous import Synchronous
from hdbridge.effects.torque import TorqueGrowth

_LAWS = (Hysteresis, HysteresisMemory)


def extended(effects: Iterable[Effect], new: Effect) -> tuple[Effect, ...]:
    """The effects of a model with a new one.

    It takes the place of one of the same name, or of the one that it replaces (`hysteresis_memory` replaces
    `hysteresis`, and the other way round); changed hysteresis parameters go into the model's own loop;
    everything else is added. What other effects carry of the changed one follows (`refreshed`).
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
    """The same effects; those that carry orders or a loop carry what the model now has.

    The orders are those of the synchronous part and of orders that were added to it: what changes a tooth
    error changes all of it. Where the model has no synchronous part, the orders stay as they are.
    """
    given = tuple(effects)
    loop = loop_of(given) if any(isinstance(each, _LAWS) for each in given) else None
    series = [each for each in given if isinstance(each, Synchronous | MotorOrders)]
    orders: tuple[MotorOrder, ...] | None = None
    if any(isinstance(each, Synchronous) for each in series):
        # Of an order that stands twice, the synchronous part's: a fit tells no shares of it.
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
    """What can stand in the place of an effect, with its parameters; see `Effect.replaces`.

    A fit may have led them out of their ranges: as with `fitted`, `violations` says so.
    """
    return tuple(
        kind.model_construct(**effect.parameters())
        for kind in kinds
        if kind.replaces == effect.name or effect.replaces == kind.name
    )


def compensable(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """The effects that a compensation should make up for: real motions of the load that can be foreseen."""
    return tuple(each for each in effects if each.is_compensable())


def fall_bound(effects: Iterable[Effect]) -> float:
    """A bound on how steeply the *sum* can fall, arcsec per motor degree.

    The sum of the effects' own bounds, but for one case: what takes a share from the model's loop falls as
    steeply as the loop rises, and as long as no more than the whole loop is taken, the sum still rises. (That
    of a loop in which the load lags may fall without bound in either direction.)
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
    """Why these effects cannot be of one model with this gear ratio, in words; empty when they can."""
    given = tuple(effects)
    names = {each.name for each in given}
    return (
        *(
            f"'{each.name}' stands in place of '{each.replaces}': keep one of the two"
            for each in given
            if each.replaces in names
        ),
        *(
            f"'{each.name}' was made for a gear of ratio {theirs:g}, the model's is {ratio:g}"
            for each in given
            if not math.isclose(theirs := getattr(each, "ratio", ratio), ratio, rel_tol=1e-9)
        ),
    )
