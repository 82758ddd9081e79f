"""A harmonic-drive axis: motor, gear with transmission error, spring, load and friction.

Parameters have the names and units of docs/ci.md. With q the motor angle and p the load angle:

    output  u(q) = q / N + tooth(q) + h(q)          h: hysteresis, a function of the motor's travel
    spring  T    = K (u - p) + D (u' - p')
    motor   Jm q" = torque - du/dq T - viscous q' - Coulomb(q') sgn q'
    load    Jl p" = T - viscous p' + gravity(p)

The gear passes on power without loss (du/dq on both sides), so only friction and damping dissipate. A substep
is a drift of half a step, a kick and another drift: second order, and conservative without losses. Coulomb
friction is an impulse that at most stops the motor, so a motor below its friction stands still exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numba import njit

DT_S = 5e-5
"""Length of a substep."""
ARCSEC = math.radians(1.0 / 3600.0)


class Order(NamedTuple):
    """One term of the tooth error: amplitude * cos(order * motor angle + phase)."""

    order: int
    amplitude_arcsec: float
    phase_deg: float


@dataclass(frozen=True)
class BoucWen:
    """dz/dx = (1 - |z|^exponent (beta sgn(z dx) + 1 - beta)) / yield over motor travel x; h = offset z."""

    offset_arcsec: float
    yield_deg: float
    exponent: float
    beta: float


@dataclass(frozen=True)
class MaxwellSlip:
    """Springs with sliders in parallel: pairs of limit in arcsec and motor travel to the limit in degrees."""

    elements: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Mechanics:
    """Parameters of motor, gear and load."""

    motor_inertia_kg_m2: float
    coulomb_nm: float
    viscous_nm_s_per_rad: float
    stribeck_rise: float
    stribeck_speed_rad_s: float
    ratio: float
    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float
    load_inertia_kg_m2: float
    load_viscous_nm_s_per_rad: float
    motor_orders: tuple[Order, ...]
    hysteresis: BoucWen | MaxwellSlip
    brake_nm: float = 1.0
    gravity_nm: float = 0.0
    """Torque of a mass on the load if its arm is horizontal. The arm hangs down at load angle zero."""

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia of motor and load, seen by the motor."""
        return self.motor_inertia_kg_m2 + self.load_inertia_kg_m2 / self.ratio**2

    @property
    def held_hz(self) -> float:
        """Natural frequency of the load on the spring while the motor is held."""
        return math.sqrt(self.stiffness_nm_per_rad / self.load_inertia_kg_m2) / math.tau

    @property
    def free_hz(self) -> float:
        """Natural frequency of the motor oscillating against the load, both free to move."""
        return self.held_hz * math.sqrt(self.inertia_kg_m2 / self.motor_inertia_kg_m2)


_NUMBERS = [each.name for each in fields(Mechanics) if each.type == "float"]
PLANT = np.dtype([(name, "f8") for name in (*_NUMBERS, "bouc_wen_exponent", "bouc_wen_beta")])
STATE = np.dtype(
    [
        (name, "f8")
        for name in ("motor", "motor_speed", "load", "load_speed", "middle", "spring_rate", "spring_nm")
    ]
)


class Plant(NamedTuple):
    """Parameters and state of the mechanics, in the form that `substep` requires."""

    parameters: np.ndarray
    """Record `PLANT`; SI."""
    orders: np.ndarray
    """(order, a, b) rows: a cos(order q) + b sin(order q), radians."""
    elements: np.ndarray
    """(limit, yield, state) rows, radians, state -1 to 1; one row if the law is Bouc-Wen."""
    state: np.ndarray
    """Record `STATE`; SI. ``middle`` is the motor angle at which the hysteresis was last computed,
    ``spring_rate`` the rate at which the spring stretched in the last substep."""


def plant_of(mechanics: Mechanics) -> Plant:
    """The axis at rest at zero, hysteresis unloaded."""
    parameters, state = np.zeros(1, PLANT), np.zeros(1, STATE)
    for name in _NUMBERS:
        parameters[0][name] = getattr(mechanics, name)
    law = mechanics.hysteresis
    if isinstance(law, BoucWen):
        parameters[0]["bouc_wen_exponent"], parameters[0]["bouc_wen_beta"] = law.exponent, law.beta
        pairs: tuple[tuple[float, float], ...] = ((law.offset_arcsec, law.yield_deg),)
    else:
        pairs = law.elements
    elements = np.array([(limit * ARCSEC, math.radians(travel), 0.0) for limit, travel in pairs]).reshape(
        -1, 3
    )
    orders = np.zeros((len(mechanics.motor_orders), 3))
    for row, each in zip(orders, mechanics.motor_orders, strict=True):
        phase = math.radians(each.phase_deg)
        row[:] = each.order, math.cos(phase), -math.sin(phase)
        row[1:] *= each.amplitude_arcsec * ARCSEC
    state[0]["load"] = tooth_error(orders, 0.0)[0]
    return Plant(parameters, orders, elements, state)


@njit(cache=True)
def tooth_error(orders, motor):
    """Tooth error at a motor angle, and its derivative; radians."""
    value, slope = 0.0, 0.0
    for i in range(orders.shape[0]):
        order = orders[i, 0]
        c, s = math.cos(order * motor), math.sin(order * motor)
        value += orders[i, 1] * c + orders[i, 2] * s
        slope += order * (orders[i, 2] * c - orders[i, 1] * s)
    return value, slope


@njit(cache=True)
def hysteresis(elements, exponent, beta, travel):
    """Advances by motor travel. Returns the error and its derivative by the motor angle, radians."""
    value, slope = 0.0, 0.0
    for i in range(elements.shape[0]):
        limit, stretch, before = elements[i, 0], elements[i, 1], elements[i, 2]
        if exponent > 0.0:
            sign = 1.0 if travel > 0.0 else (-1.0 if travel < 0.0 else 0.0)
            rate = _bouc_wen(before, sign, exponent, beta) / stretch
            middle = before + 0.5 * travel * rate
            rate = _bouc_wen(middle, sign, exponent, beta) / stretch
            after = min(1.0, max(-1.0, before + travel * rate))
            rate = _bouc_wen(after, sign, exponent, beta) / stretch
        else:
            after = before + travel / stretch
            rate = 1.0 / stretch
            if abs(after) >= 1.0:
                after = 1.0 if after > 0.0 else -1.0
                rate = 0.0
        elements[i, 2] = after
        value += limit * after
        slope += limit * rate
    return value, slope


@njit(cache=True)
def _bouc_wen(z, sign, exponent, beta):
    """Slope of z over the scaled travel in the direction ``sign``."""
    along = beta if z * sign > 0.0 else (-beta if z * sign < 0.0 else 0.0)
    return 1.0 - abs(z) ** exponent * (along + 1.0 - beta)


@njit(cache=True)
def substep(parameters, orders, elements, state, torque_nm, brake_nm):
    """Advances the axis by `DT_S` under a motor torque."""
    p, s = parameters[0], state[0]
    half = 0.5 * DT_S
    motor = s.motor + half * s.motor_speed
    load = s.load + half * s.load_speed
    tooth, slope = tooth_error(orders, motor)
    loop, loop_slope = hysteresis(elements, p.bouc_wen_exponent, p.bouc_wen_beta, motor - s.middle)
    slope += loop_slope + 1.0 / p.ratio
    output = motor / p.ratio + tooth + loop
    rate = (
        slope * s.motor_speed - s.load_speed
    )  # of the spring; at the middle of the kick 1.5 - 0.5 of the last
    spring = p.stiffness_nm_per_rad * (output - load)
    spring += p.damping_nm_s_per_rad * (1.5 * rate - 0.5 * s.spring_rate)

    gain = DT_S / p.motor_inertia_kg_m2
    speed = (s.motor_speed + gain * (torque_nm - slope * spring)) / (1.0 + gain * p.viscous_nm_s_per_rad)
    near = speed / p.stribeck_speed_rad_s
    friction = gain * (brake_nm + p.coulomb_nm * (1.0 + p.stribeck_rise * math.exp(-near * near)))
    speed = speed - friction if speed > friction else (speed + friction if speed < -friction else 0.0)

    gain = DT_S / p.load_inertia_kg_m2
    push = spring - p.gravity_nm * math.sin(load)
    load_speed = (s.load_speed + gain * push) / (1.0 + gain * p.load_viscous_nm_s_per_rad)

    s.middle, s.spring_rate, s.spring_nm = motor, rate, spring
    s.motor, s.motor_speed = motor + half * speed, speed
    s.load, s.load_speed = load + half * load_speed, load_speed


def static_error_arcsec(mechanics: Mechanics, motor_deg: np.ndarray) -> np.ndarray:
    """Load error at rest at each stop of a motor path that starts at zero, without gravity.

    The motor turns straight from stop to stop of ``motor_deg``. Independent of the compiled law.
    """
    angle = np.radians(motor_deg)
    error = sum(
        each.amplitude_arcsec * np.cos(each.order * angle + math.radians(each.phase_deg))
        for each in mechanics.motor_orders
    )
    law = mechanics.hysteresis
    travels = np.diff(motor_deg, prepend=0.0)
    if isinstance(law, MaxwellSlip):
        for limit, stretch in law.elements:
            z, states = 0.0, []
            for travel in travels:
                z = min(1.0, max(-1.0, z + travel / stretch))
                states.append(z)
            error = error + limit * np.array(states)
        return error
    z, states = 0.0, []
    for travel in travels:
        count = max(1, math.ceil(abs(travel) / (0.002 * law.yield_deg)))
        dx, sign = travel / count / law.yield_deg, np.sign(travel)
        for _ in range(count if abs(travel) < 40.0 * law.yield_deg else 0):
            rates = []
            for factor in (0.0, 0.5, 0.5, 1.0):  # Runge-Kutta
                at = z + factor * dx * (rates[-1] if rates else 0.0)
                rates.append(1.0 - abs(at) ** law.exponent * (law.beta * np.sign(at * sign) + 1.0 - law.beta))
            z += dx * (rates[0] + 2.0 * rates[1] + 2.0 * rates[2] + rates[3]) / 6.0
        z = float(sign) if abs(travel) >= 40.0 * law.yield_deg else z
        states.append(z)
    return error + law.offset_arcsec * np.array(states)


def energy_j(plant: Plant) -> float:
    """Kinetic, elastic and potential energy of the axis."""
    p, s = plant.parameters[0], plant.state[0]
    law = p["bouc_wen_exponent"], p["bouc_wen_beta"]
    loop, _ = hysteresis(plant.elements.copy(), *law, s["motor"] - s["middle"])
    wind = s["motor"] / p["ratio"] + tooth_error(plant.orders, s["motor"])[0] + loop - s["load"]
    kinetic = (
        p["motor_inertia_kg_m2"] * s["motor_speed"] ** 2 + p["load_inertia_kg_m2"] * s["load_speed"] ** 2
    )
    elastic = p["stiffness_nm_per_rad"] * wind**2
    return float(0.5 * (kinetic + elastic) + p["gravity_nm"] * (1.0 - math.cos(s["load"])))
