"""The candidates: for each cause of the catalogue the effects, over a grid of shapes, that a record is
screened for.

Four causes have too many shapes for a grid and are sought by `matched_filters.py`: lost counts, vibration,
interpolation errors, local defects. The elastic law is chosen together with all of them (`search.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from hdbridge.effects import (
    AmplitudeDrift,
    Backlash,
    Channel,
    ChannelSkew,
    Compliance,
    Creep,
    DirectionPhase,
    Effect,
    FlexsplineOrders,
    InertialWindup,
    LoadOrders,
    MotorOrders,
    RateDependence,
    RatioError,
    Relaxation,
    Synchronous,
    TorqueGrowth,
    TorqueModulation,
    VelocityWindup,
    Wear,
    ZeroDrift,
    loop_of,
    orders_of,
    unmet,
)
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import OrderSeries, orders_from
from hdbridge.estimation.observed import Observed
from hdbridge.estimation.screening import Candidate

HIGHEST_MOTOR_ORDER = 24
LOAD_ORDERS = (1, 2, 3, 4)
FLEXSPLINE_ORDERS = tuple(range(1, 9))
_CROSSINGS_DEG = (0.05, 0.15, 0.4, 1.0, 2.5, 6.0)
_CREEP_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


def candidates(data: Observed, base: Sequence[Effect]) -> list[Candidate]:
    """All whose channels are there; orders that the model has already are not among them."""
    available = data.points.motion.available()
    found = [Candidate(each.name, each) for each in _effects(data, base)]
    return [each for each in found if not unmet([each.effect], available)]


def _effects(data: Observed, base: Sequence[Effect]) -> Iterator[Effect]:
    motion, ratio = data.points.motion, data.ratio
    yield from _orders(base, ratio)
    loop = loop_of(base)
    has_loop = any(isinstance(each, Hysteresis | HysteresisMemory) for each in base)
    has_orders = any(isinstance(each, Synchronous) and each.orders for each in base)
    yield from (Backlash(gap_arcsec=1.0, crossing_deg=each) for each in _CROSSINGS_DEG)
    yield from (Wear(growth_arcsec_per_kiloturn=1.0, width_deg=each) for each in (0.5, 4.0, 20.0))
    yield RatioError(ramp_arcsec_per_turn=1.0)
    yield InertialWindup(ratio=ratio, inertia_over_stiffness_s2=1e-5)
    yield ChannelSkew(ratio=ratio, delay_ms=1.0, second_order_ms2=1.0)
    speed = motion.motor_speed_deg_s
    top = float(np.quantile(np.abs(speed), 0.99)) if speed is not None else 360.0
    for share in (0.15, 1.0, 6.0):
        yield VelocityWindup(
            coulomb_arcsec=1.0, viscous_arcsec_s_per_deg=0.01, shear_deg_s=max(share * top, 10.0)
        )
    if has_loop:
        for share in (0.02, 0.2):
            yield RateDependence(
                loop=loop, growth_percent=1.0, reference_deg_s=min(max(share * top, 1.0), 1000.0)
            )
    if has_orders:
        yield DirectionPhase(orders=orders_of(base), shift_deg=0.0)
    yield from _with_torque(base, _torques(data), has_orders)
    yield from _warm(data, base, has_orders and has_loop)
    for tau in _CREEP_S:
        for build_up in (0.03, 0.3, 1.0):
            yield Creep(parts=(Relaxation(amplitude_arcsec=1.0, tau_s=tau),), build_up=build_up)


def _orders(base: Sequence[Effect], ratio: float) -> Iterator[Effect]:
    """One order each; what is found is put together afterwards."""
    present = {
        (each.turns_per_motor_turn(), order.order)
        for each in base
        if isinstance(each, OrderSeries)
        for order in each.orders
    }
    series: Iterable[OrderSeries] = (
        *(MotorOrders(orders=orders_from([k])) for k in range(1, HIGHEST_MOTOR_ORDER + 1)),
        *(LoadOrders(ratio=ratio, orders=orders_from([k])) for k in LOAD_ORDERS),
        *(FlexsplineOrders(ratio=ratio, orders=orders_from([k])) for k in FLEXSPLINE_ORDERS),
    )
    for each in series:
        if (each.turns_per_motor_turn(), each.orders[0].order) not in present:
            yield each


def _torques(data: Observed) -> dict[Channel, float]:
    motion = data.points.motion
    return {
        channel: float(np.quantile(np.abs(values), 0.98))
        for channel in (Channel.LOAD_TORQUE, Channel.MOTOR_TORQUE)
        if (values := motion.measured.get(channel)) is not None and float(np.ptp(values)) > 0.0
    }


def _with_torque(
    base: Sequence[Effect], motion_torques: dict[Channel, float], has_orders: bool
) -> Iterator[Effect]:
    # The motor's torque is that of friction and acceleration too: it stands in only where nothing better
    # is there.
    channels = [Channel.LOAD_TORQUE] if Channel.LOAD_TORQUE in motion_torques else list(motion_torques)
    for channel in channels:
        top = motion_torques[channel]
        # Beyond its range an effect is held: the record's torques have to lie within.
        within = {"limit_nm": max(TorqueGrowth.model_fields["limit_nm"].default, 2.0 * top)}
        if channel is Channel.LOAD_TORQUE:
            # A spring is straight as far as the record goes, or stiffens once, or twice.
            beyond = (1e4, 2e4)
            once = ((share * top, beyond[1]) for share in (0.2, 0.45, 0.7))
            for low, high in (beyond, *once, (0.4 * top, 0.8 * top)):
                yield Compliance(
                    c1_arcsec_per_nm=1.0, c2_arcsec_per_nm=1.0, c3_arcsec_per_nm=1.0,
                    torque1_nm=low, torque2_nm=high, torque=channel.value,
                )  # fmt: skip
            if has_orders:
                for signed in (False, True):
                    yield TorqueModulation(
                        orders=orders_of(base), growth_percent_per_nm=1.0, signed=signed,
                        torque=channel.value, **within,
                    )  # fmt: skip


def _warm(data: Observed, base: Sequence[Effect], modulated: bool) -> Iterator[Effect]:
    temperature = data.points.motion.measured.get(Channel.TEMPERATURE)
    driven = "temperature" if temperature is not None and float(np.ptp(temperature)) > 0.3 else "time"
    time_s = data.points.motion.time_s
    assert time_s is not None
    span = float(np.ptp(time_s))
    # A sensor on the gear itself is hardly ahead of it. Without one, what settles within a minute is creep.
    quick = (2.0, 15.0) if driven == "temperature" else ()
    for tau in (*quick, 60.0, 240.0, 600.0, 1500.0, 4000.0):
        if tau > 6.0 * span and driven == "time":
            continue
        yield ZeroDrift(drift_arcsec_per_k=1.0, tau_s=tau, driven_by=driven)
        if modulated:
            yield AmplitudeDrift(
                orders=orders_of(base), loop=loop_of(base), ripple_percent_per_k=1.0,
                friction_percent_per_k=1.0, tau_s=tau, driven_by=driven,
            )  # fmt: skip
