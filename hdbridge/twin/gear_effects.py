"""Effects of teeth and ratio, as the plant's gear has them; see `hdbridge.twin.translation`."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable
from typing import Any, Final

from hdbridge.effects import (
    DirectionPhase,
    FlexsplineOrders,
    LocalDefect,
    MotorOrder,
    MotorOrders,
    RatioError,
    Synchronous,
    TorqueModulation,
)
from hdbridge.effects.direction_phase import STEEPEST
from hdbridge.twin.draft import ARCSEC_PER_RAD, Draft, Said, none

HIGHEST_ORDER: Final = 512
FLANK_TRAVEL_DEG: Final = 0.5
"""Motor travel from flank to flank: a fraction of a motor degree, the size of the play between teeth."""
MOST_YIELD: Final = 0.9
"""Share of the spring's own softness that teeth may have; at one the plant is not stable."""


def ratio_error(effect: RatioError, draft: Draft) -> Said:
    """The ratio that the gear really has."""
    draft.gear["ratio"] = effect.true_ratio(draft.ratio)
    return Said("gear.ratio")


def motor_orders(effect: Synchronous | MotorOrders, draft: Draft) -> Said:
    """Tooth error by motor angle; an order that stands in two effects is their sum."""
    return _orders(effect.orders, draft, "motor_orders")


def flexspline_orders(effect: FlexsplineOrders, draft: Draft) -> Said:
    """Tooth error by the angle between wave generator and flexspline."""
    return _orders(effect.orders, draft, "flexspline_orders")


def gear_load_orders(orders: Iterable[MotorOrder], draft: Draft) -> Said:
    """Tooth error by load angle."""
    return _orders(orders, draft, "load_orders")


def direction_phase(effect: DirectionPhase, draft: Draft) -> Said:
    """Two flanks; the model's orders are the mean of both, the plant's those of either."""
    held = []
    orders: list[dict[str, Any]] = []
    for each in draft.gear.get("motor_orders", ()):
        shift = math.radians(each["order"] * effect.shift_deg)
        share = math.cos(shift)
        if abs(math.tan(shift)) > STEEPEST or share <= 0.0:
            held.append(str(each["order"]))
            share = 1.0 / math.hypot(1.0, STEEPEST)
        orders.append({**each, "amplitude_arcsec": each["amplitude_arcsec"] / share})
    draft.gear["motor_orders"] = orders
    draft.gear["flank"] = {"shift_deg": effect.shift_deg, "travel_deg": FLANK_TRAVEL_DEG}
    notes = [f"crosses within {FLANK_TRAVEL_DEG:g} motor deg, where the model jumps"]
    if held:
        notes.append(f"order {', '.join(held)}: shifted by too much to be told by its mean")
    return Said("gear.flank", tuple(notes))


def torque_modulation(effect: TorqueModulation, draft: Draft) -> Said:
    """Growth with the size of the torque that the teeth carry."""
    if effect.signed:
        return none("the plant's teeth grow with the size of the torque, not with its sign")
    per_nm = 0.01 * effect.growth_percent_per_nm
    notes = []
    if effect.torque == "motor_torque_nm":
        per_nm /= draft.ratio
        notes.append("by the motor's torque times the ratio, its own friction included")
    orders = draft.gear.get("motor_orders", ())
    carried = {each.order for each in effect.orders}
    if any(each["order"] not in carried for each in orders):
        notes.append("all motor orders grow, also those that the effect does not carry")
    yields = sum(each["amplitude_arcsec"] for each in orders) / ARCSEC_PER_RAD * draft.stiffness_nm_per_rad
    if yields * abs(per_nm) > MOST_YIELD:
        held = math.copysign(MOST_YIELD / yields, per_nm)
        notes.append(
            f"held at {100 * held:.3g} %/Nm: with {100 * per_nm:.3g} teeth would yield more than the spring"
        )
        per_nm = held
    draft.gear["torque_growth_per_nm"] = per_nm
    return Said("gear.torque_growth_per_nm", tuple(notes))


def local_defect(effect: LocalDefect, draft: Draft) -> Said:
    """A damaged tooth: the same raised cosine."""
    width = min(180.0, 2.0 * effect.half_width_deg)
    bump = {"at_deg": effect.centre_deg, "width_deg": width, "height_arcsec": effect.height_arcsec}
    draft.gear["damage"] = [*draft.gear.get("damage", ()), bump]
    wide = 2.0 * effect.half_width_deg > width
    return Said("gear.damage", ("no wider than half a turn",) if wide else ())


def _orders(orders: Iterable[MotorOrder], draft: Draft, key: str) -> Said:
    sums: dict[int, complex] = {
        each["order"]: cmath.rect(each["amplitude_arcsec"], math.radians(each["phase_deg"]))
        for each in draft.gear.get(key, ())
    }
    beyond = []
    for each in orders:
        if each.order > HIGHEST_ORDER:
            beyond.append(str(each.order))
            continue
        phasor = cmath.rect(each.amplitude_arcsec, math.radians(each.phase_deg))
        sums[each.order] = sums.get(each.order, 0j) + phasor
    draft.gear[key] = [
        {
            "order": order,
            "amplitude_arcsec": abs(sums[order]),
            "phase_deg": math.degrees(cmath.phase(sums[order])),
        }
        for order in sorted(sums)
    ]
    notes = (f"without order {', '.join(beyond)}: the plant's go up to {HIGHEST_ORDER}",) if beyond else ()
    return Said(f"gear.{key}", notes)
