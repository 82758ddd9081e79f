"""Records computed from formulas, for the tests of the diagnosis; shares no code with the tested effects.

An axis of ratio 50 runs a bench plan (standstill, sweeps at two speeds, sines, nested reversals, steps,
holds, sweeps again) at a fine time step. The elastic law is one of several, with a state that continues
through the whole run. Effects are added by formula, encoders are quantised, and slow noise is added.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from support.filters import filtered

ORDERS = (
    (1, 4.9, -126.8),
    (2, 9.33, -132.1),
    (3, 2.09, -96.2),
    (4, 12.21, 105.7),
    (6, 3.18, -127.0),
    (8, 1.87, 124.3),
)
RATIO = 50.0


@dataclass
class Plan:
    """Parameters of the bench plan; ``scale`` scales the durations of standstills."""

    rate_hz: float = 25.0
    scale: float = 1.0
    load_turns: float = 1.3
    steps: int = 120
    step_deg: float = 43.56


def path(plan: Plan, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns time, motor angle and leg number, at ten times the sampling rate."""
    dt = 1.0 / (plan.rate_hz * 10)
    pieces: list[np.ndarray] = []
    legs: list[np.ndarray] = []
    here = 0.0
    number = 0

    def hold(seconds: float) -> None:
        pieces.append(np.full(max(1, round(seconds / dt)), here))

    def move(goal: float, speed: float) -> None:
        """Adds a smooth move whose speed rises and falls in a raised cosine."""
        nonlocal here
        way = abs(goal - here)
        if way < 1e-9:
            return
        ramp = min(0.15, way / speed)
        flat = way / speed - ramp
        t = np.arange(dt, flat + 2 * ramp + dt, dt)
        v = np.clip(np.minimum(t, flat + 2 * ramp - t) / ramp, 0, 1)
        v = 0.5 - 0.5 * np.cos(np.pi * v)
        s = np.cumsum(v)
        pieces.append(here + (goal - here) * s / s[-1])
        here = goal

    def sine(amplitude: float, frequency: float, periods: float) -> None:
        nonlocal here
        t = np.arange(dt, periods / frequency, dt)
        centre = here - amplitude
        pieces.append(centre + amplitude * np.cos(2 * np.pi * frequency * t))
        here = float(pieces[-1][-1])

    def leg() -> None:
        nonlocal number
        done = sum(len(each) for each in legs)
        now = sum(len(each) for each in pieces)
        legs.append(np.full(now - done, number))
        number += 1

    way = plan.load_turns * 360 * RATIO
    slow, quick = 203.0 * (1 + 0.05 * rng.random()), 617.0 * (1 + 0.05 * rng.random())
    move(120.0, 60.0)
    leg()
    hold(30 * plan.scale)
    leg()
    for _ in range(2):
        move(way, quick)
        hold(1)
        move(0.0, quick)
        hold(1)
    leg()
    move(way, slow)
    hold(1)
    move(0.0, slow)
    leg()
    for amplitude in (180.0, 45.0, 5.0):
        move(here + amplitude + 60, 40)
        sine(amplitude, 0.05, 4)
        leg()
    for depth in (1.0, 2.0, 4.0, 8.0, 12.0, 16.0, 24.0):
        move(here - 60, 40)
        move(here + 60, 20)
        top = here
        for place in (-depth, -depth / 2, -1.5 * depth, 0):
            move(top + place, 10)
    leg()
    move(0.0, quick)
    move(-60.0, 40)
    move(0.0, 40)
    for sign in (1, -1):
        for _ in range(plan.steps):
            move(here + sign * plan.step_deg, 300)
            hold(0.6)
    leg()
    for _ in range(3):
        move(here + 400, 300)
        hold(25 * plan.scale)
        move(here - 400, 300)
        hold(25 * plan.scale)
    leg()
    for speed in (slow, quick):
        move(way, speed)
        hold(1)
        move(0.0, speed)
    hold(5)
    leg()
    motor = np.concatenate(pieces)
    return np.arange(len(motor)) * dt, motor, np.concatenate(legs)


def rise(xi: np.ndarray | float, n: float) -> Any:
    xi = np.clip(xi, 0, 1)
    if abs(n - 2) < 1e-6:
        return np.where(xi > 0, xi * (1 - np.log(np.maximum(xi, 1e-300))), 0.0)
    return (xi ** (n - 1) - (n - 1) * xi) / (2 - n)


def kept(direction: np.ndarray) -> np.ndarray:
    """Replaces zeros with the direction of the last motion, or with forward before the first motion."""
    last = np.maximum.accumulate(np.where(direction != 0, np.arange(len(direction)), -1))
    return np.where(last < 0, 1.0, direction[last])


def loop(motor: np.ndarray, law: str, offset: float, width: float, n: float) -> np.ndarray:
    """Returns the elastic part of the error, from a saturated forward start."""
    if offset < 0.0:  # negative offset: the load lags
        return -loop(motor, law, -offset, width, n)
    step = np.sign(np.diff(motor, prepend=motor[0] - 1e-9))
    if law == "plain":
        out = np.empty(len(motor))
        held = kept(step)
        turns = np.flatnonzero(np.diff(held)) + 1
        edges = [0, *turns.tolist(), len(motor)]
        value = offset
        for a, b in pairwise(edges):
            sign = held[a]
            origin = motor[a - 1] if a else motor[0]
            if a == 0:
                out[a:b] = offset
                continue
            branch = value + sign * 2 * offset * rise(np.abs(motor[a:b] - origin) / width, n)
            out[a:b] = sign * np.minimum(sign * branch, offset)
            value = float(out[b - 1])
        return out
    if law == "memory":  # Masing's rules, by many stop operators whose thresholds approximate the branch
        grid = width * np.linspace(0, 1, 161)[1:] ** 2 / 1.0
        virgin = rise(grid / width, n)
        slope = np.diff(np.concatenate([[0], virgin])) / np.diff(np.concatenate([[0], grid]))
        slope = np.append(slope, 0.0)
        weight = (slope[:-1] - slope[1:]) * grid
        total = np.zeros(len(motor))
        for w, g in zip(weight, grid, strict=True):
            total += w * stop(motor, g)
        return offset * total / weight.sum()
    if law == "bouc_wen":
        z = 1.0
        out = np.empty(len(motor))
        scale = width / 4.0
        d = np.diff(motor, prepend=motor[0])
        for i in range(len(motor)):
            dx = d[i] / scale
            if dx:
                s = 1 if dx > 0 else -1
                z += dx * (1 - abs(z) ** n * (0.6 * s * (1 if z > 0 else -1) + 0.4))
                z = min(max(z, -1.0), 1.0)
            out[i] = z
        return offset * out
    if law == "dahl":
        z = 1.0
        out = np.empty(len(motor))
        scale = width / 5.0
        d = np.diff(motor, prepend=motor[0])
        for i in range(len(motor)):
            if d[i]:
                s = 1.0 if d[i] > 0 else -1.0
                z = s + (z - s) * math.exp(-abs(d[i]) / scale)
            out[i] = z
        return offset * out
    raise ValueError(law)


def stop(motor: np.ndarray, width: float) -> np.ndarray:
    """Returns the output of a stop operator that crosses from -1 to 1 over ``width``, initially 1."""
    turning = [0, *(np.flatnonzero(np.diff(np.sign(np.diff(motor))) != 0) + 1).tolist(), len(motor) - 1]
    value, out = 1.0, np.empty(len(motor))
    out[0] = 1.0
    for a, b in pairwise(turning):
        out[a + 1 : b + 1] = np.clip(value + 2 * (motor[a + 1 : b + 1] - motor[a]) / width, -1, 1)
        value = float(out[b])
    return out


def crept(going: np.ndarray, dt: float, tau: float, build: float = 0.1, **_: float) -> np.ndarray:
    """Returns creep that builds up in the direction of motion, faster than it relaxes at rest."""
    up, down = math.exp(-dt / (build * tau)), math.exp(-dt / tau)
    y, out = 0.0, np.empty(len(going))
    for i, sense in enumerate(going.tolist()):
        y = sense + (y - sense) * up if sense else y * down
        out[i] = y
    return out


@dataclass
class Truth:
    """True properties of the axis: elastic law, orders, other effects, noise."""

    law: str = "plain"
    offset: float = 40.0
    width: float = 20.0
    n: float = 1.6
    orders: tuple[tuple[int, float, float], ...] = ORDERS
    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    noise: float = 0.3
    slow_noise: float = 0.15
    torque_nm: float = 0.0
    temperature_rise_k: float = 0.0


def record(truth: Truth, plan: Plan, seed: int, command: bool = True) -> dict[str, np.ndarray]:
    """Returns the columns of a record of the axis on the plan."""
    rng = np.random.default_rng(seed)
    t, motor, _ = path(plan, rng)
    dt = t[1] - t[0]
    v = np.gradient(motor, dt)
    v[np.abs(v) < 1e-9] = 0.0
    a = np.gradient(v, dt)
    d = kept(np.sign(v))
    e = truth.effects
    end_s = t[-1]
    carried = {"loop": loop(motor, truth.law, truth.offset, truth.width, truth.n)}
    if "backlash" in e:
        carried["play"] = stop(motor, e["backlash"]["gap"] * RATIO / 3600)
    if "creep" in e:
        carried["creep"] = crept(np.sign(v), dt, **e["creep"])
    # Quantities that do not depend on the history are computed only at the samples.
    pick = slice(None, None, 10)
    at = slice(None) if "channel_skew" in e else pick
    t, motor, v, a, d = (np.ascontiguousarray(each[at]) for each in (t, motor, v, a, d))
    elastic = carried["loop"][at]
    load = motor / RATIO
    torque = truth.torque_nm * np.sin(np.deg2rad(load + 33.0)) if truth.torque_nm else np.zeros(len(t))
    shift = e.get("direction_phase", {}).get("shift", 0.0)
    growth = 1 + e.get("torque_modulation", {}).get("growth", 0.0) * np.abs(torque)
    warm = truth.temperature_rise_k * (1 - np.exp(-t / (0.35 * end_s)))
    amplitude = e.get("amplitude_drift", {})
    ripple = sum(A * np.cos(np.deg2rad(k * (motor + d * shift) + p)) for k, A, p in truth.orders)
    te = ripple * growth * (1 + amplitude.get("ripple", 0.0) * warm)
    rate = e.get("rate_dependence", {})
    factor = 1 + rate.get("growth", 0.0) * np.log10(1 + np.abs(v) / rate.get("reference", 20.0))
    te = te + elastic * factor * (1 + amplitude.get("friction", 0.0) * warm)
    for name, angle in (("motor_order", motor), ("load_order", load), ("flexspline_order", motor + load)):
        for k, A, p in e.get(name, {}).get("orders", ()):
            te = te + A * np.cos(np.deg2rad(k * angle + p))
    for k, A, p in e.get("motor_encoder_eccentricity", {}).get("orders", ()):
        te = te + A * np.cos(np.deg2rad(k * motor + p))
    if "compliance" in e:
        c = e["compliance"]
        tau = np.abs(torque)
        te = te + np.sign(torque) * (
            c["c1"] * np.minimum(tau, c["t1"]) + c["c2"] * np.maximum(tau - c["t1"], 0)
        )
    if "inertial_windup" in e:
        te = te - e["inertial_windup"]["s2"] * a / RATIO * 3600
    if "velocity_windup" in e:
        w = e["velocity_windup"]
        te = te - d * (v != 0) * w["coulomb"] - w["viscous"] * v / (1 + (np.abs(v) / w["shear"]) ** 0.8)
    if "backlash" in e:  # play operator on the load side: the load lags by half the gap
        te = te - 0.5 * e["backlash"]["gap"] * carried["play"][at]
    if "subdivisional_error" in e:
        s = e["subdivisional_error"]
        actual = load + te / 3600
        for k, A, p in s["orders"]:
            te = te + A * np.cos(np.deg2rad(k * s["lines"] * actual + p))
    if "creep" in e:
        te = te + e["creep"]["size"] * carried["creep"][at]
    if "ratio_error" in e:
        te = te + e["ratio_error"]["ramp"] * motor / 360
    if "count_loss" in e:
        te = te + e["count_loss"]["size"] * (t > e["count_loss"]["at"] * end_s)
    if "vibration" in e:
        te = te + e["vibration"]["size"] * np.cos(2 * np.pi * e["vibration"]["hz"] * t + 1.0)
    if "local_defect" in e:
        x = np.mod(load - e["local_defect"]["at"] + 180, 360) - 180
        te = te + e["local_defect"]["size"] * np.exp(-0.5 * (x / e["local_defect"]["width"]) ** 2)
    if "unknown" in e:
        te = te + unknown(e["unknown"], t, motor, load, d, v)
    measured_load = load + te / 3600
    if "channel_skew" in e:
        measured_load = np.interp(t - e["channel_skew"]["ms"] * -1e-3, t, measured_load)
        t, motor, v, torque, measured_load = (each[pick] for each in (t, motor, v, torque, measured_load))
    decay = math.exp(-(t[1] - t[0]) / 5.0)
    slow = filtered([math.sqrt(1 - decay**2)], [1, -decay], rng.normal(size=len(t)))
    noisy = measured_load + (truth.noise * rng.normal(size=len(t)) + truth.slow_noise * slow) / 3600
    follow = 2e-4 * v
    columns = {
        "time_s": t,
        "motor_position_deg": np.round(motor * 8000 / 360) * 360 / 8000,
        "load_position_deg": np.round(noisy * 8000) / 8000 + 17.3,
    }
    if command:
        columns["motor_target_deg"] = motor + follow
    if truth.torque_nm:
        columns["load_torque_nm"] = torque + 0.01 * rng.normal(size=len(t))
    if truth.temperature_rise_k:
        columns["temperature_c"] = (
            20 + truth.temperature_rise_k * (1 - np.exp(-t / (0.3 * t[-1]))) + 0.02 * rng.normal(size=len(t))
        )
    return columns


def unknown(
    kind: dict[str, Any], t: np.ndarray, motor: np.ndarray, load: np.ndarray, d: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Returns an error that is not in the catalogue."""
    size = kind["size"]
    if kind["kind"] == "one_way":  # a series of bumps in one direction only
        return size * (d > 0) * np.abs(np.sin(np.deg2rad(load * 3.3)))
    if kind["kind"] == "bursts":
        return size * (np.sin(2 * np.pi * t / 61.0) > 0.8) * np.sin(2 * np.pi * t / 1.7)
    if kind["kind"] == "packet":  # a roller that presses on near one load angle
        return size * np.exp(-(((load - 90.0) / kind["width"]) ** 2)) * np.cos(np.deg2rad(motor * 1.9))
    if kind["kind"] == "heated":  # heated in proportion to the square of the speed, with a time constant
        nearer = -math.expm1(-float(np.median(np.diff(t))) / kind["tau"])
        heat = filtered([nearer], [1.0, nearer - 1.0], v**2)
        return size * heat / np.max(heat)
    if kind["kind"] == "ring":  # a ring that the motion carries along until it slips back at random
        rng, ring, slips = np.random.default_rng(7), np.empty(len(t)), 0.7
        for i, way in enumerate(np.diff(motor, prepend=motor[0]) / kind["travel"]):
            ring[i] = (ring[i - 1] if i else 0.0) + way
            if abs(ring[i]) > slips:
                ring[i], slips = 0.2 * rng.uniform(-1.0, 1.0) * np.sign(ring[i]), rng.uniform(0.4, 1.0)
        return size * ring
    raise ValueError(kind["kind"])


def model_text(seed: int, wrong: float = 0.03, truth: Truth | None = None) -> str:
    """Returns the text of a model file whose parameters are a few per cent off."""
    rng = np.random.default_rng(seed + 77)
    truth = truth or Truth()

    def off(value: float) -> float:
        return value * (1 + wrong * float(rng.normal()))

    orders = "".join(
        f"        - {{order: {k}, amplitude_arcsec: {off(A):.5g}, "
        f"phase_deg: {p + 2 * float(rng.normal()):.5g}}}\n"
        for k, A, p in truth.orders
    )
    return (
        "schema: hdbridge.model/1\nratio: 50\neffects:\n"
        "  - effect: synchronous\n    parameters:\n      orders:\n"
        f"{orders}  - effect: hysteresis\n    parameters: {{offset_arcsec: {off(truth.offset):.5g}, "
        f"width_deg: {off(truth.width):.5g}, exponent: {min(max(1 + off(truth.n - 1), 1.1), 3):.4g}}}\n"
    )
