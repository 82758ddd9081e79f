"""Effect of velocity and torque offsets (60B1h, 60B2h) in addition to the filtered correction.

    PYTHONPATH=tests python tools/bench/offsets.py [AXIS...] [--feedforward 1] [--slew 100000] [--speeds 8]
        [--past 16]

AXIS is `article` or a foreign servo structure with a seed, for example `pi_notch:101`. The servo receives
set-points directly, without a bus. The velocity offset is a fraction of the derivative of the motor's
correction, added to the velocity demand after command filter, interpolation and dead time: all of it, or the
fraction that the servo's own velocity feed-forward (``--feedforward``) omits. The torque offset is the torque
that moves the motor by the correction, added after notch and torque filter. The response is measured with the
offsets.

Prints for each set of offsets, at `SHARES` of the speed limit, the percentage removed of the orders slower
than a third of the SYNC rate, and the maximum size and slew rate of the correction, arcsec and arcsec/s.
*static* is the correction without a filter. *exact* has each order set directly at each speed, without filter
and limits: the maximum that these inputs can remove.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from foreign.draw import draw
from support.raised import ARTICLE

from hdbridge.analysis import response as response_module
from hdbridge.analysis.response import (
    Harmonics,
    Limits,
    Trial,
    harmonics_of,
    motor_orders,
    order_hz,
    response_of,
)
from hdbridge.axis.effects import MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.motion.procedures.even_speed import SHARES as TESTED
from hdbridge.motion.procedures.even_speed import TRANSIENT_S, TURNS, WINDOW_S
from hdbridge.sim.machine import Machine
from hdbridge.sim.servo import Servo
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

SHARES = (0.1, 0.32, 0.58, 0.84, 1.0)
MAXIMUM_ARCSEC = 600.0
ENGAGED_S = 0.7
"""Time at rest during which the correction is ramped in, s."""
UPDATES = 4

Correction = Callable[[float], float]
"""Function that returns the correction in arcsec at a load target in degrees; called once per cycle."""


class OffsetServo(Servo):
    """Simulated servo with a velocity offset, motor deg/s, and a torque offset, Nm."""

    velocity_offset = torque_offset = 0.0

    def answer_nm(self, demand_deg: float, demand_deg_s: float, motor_deg: float) -> float:
        self._last_reference -= self.velocity_offset * self._dt / self._velocity_feedforward
        return super().answer_nm(demand_deg, demand_deg_s, motor_deg) + self.torque_offset


class Article:
    """Article's axis with raised limits."""

    ratio, cycle_s, speed_deg_s, acceleration_deg_s2 = 50.0, 0.004, 130.0, 300.0
    feedforward = 1.0

    def __init__(self) -> None:
        self.truth = Truth.load(ARTICLE / "truth.yaml")
        self.model = TransmissionModel.load(ARTICLE / "model.yaml")
        self.motor_counts = self.truth.motor.encoder.counts_per_turn
        self.load_counts = self.truth.load_.encoder.counts_per_turn
        self.inertia_kg_m2 = self.truth.motor.inertia_kg_m2

    def machine(self) -> Machine:
        machine = Machine(self.truth, 1)
        machine._axis.loops.servo = OffsetServo(self.truth)
        return machine

    def offset(self, machine: Machine, velocity_deg_s: float, torque_nm: float) -> None:
        servo = machine._axis.loops.servo
        servo.velocity_offset, servo.torque_offset = velocity_deg_s, torque_nm


class Foreign:
    """Foreign axis, with the exact correction of its motor orders."""

    def __init__(self, structure: str, seed: int, feedforward: float | None) -> None:
        truth = draw(seed, structure)
        if feedforward is not None:
            law = replace(truth.servo.law, velocity_feedforward=feedforward)
            truth = replace(truth, servo=replace(truth.servo, law=law))
        self.truth = truth
        self.ratio, self.cycle_s = truth.mechanics.ratio, truth.cycle_ms / 1000.0
        self.speed_deg_s, self.acceleration_deg_s2 = truth.velocity_deg_s, truth.acceleration_deg_s2
        self.motor_counts = truth.encoders.motor_counts_per_turn
        self.load_counts = truth.encoders.load_counts_per_turn
        self.inertia_kg_m2 = truth.mechanics.motor_inertia_kg_m2
        orders = tuple(MotorOrder(**each._asdict()) for each in truth.mechanics.motor_orders)
        self.model = TransmissionModel(self.ratio, (Synchronous(orders=orders),))
        # A servo with a reference model lacks this parameter: it has full velocity feed-forward.
        self.feedforward = getattr(truth.servo.law, "velocity_feedforward", 1.0)

    def machine(self):
        return self.truth.machine()

    def offset(self, machine, velocity_deg_s: float, torque_nm: float) -> None:
        state = machine.loops.state[0]
        state["velocity_offset"], state["torque_offset"] = math.radians(velocity_deg_s), torque_nm


Axis = Article | Foreign


class Offsets(NamedTuple):
    """Fractions of the correction's derivatives that are sent as offsets."""

    velocity: float = 0.0
    torque: float = 0.0


class Run(NamedTuple):
    """Result of a run at constant speed."""

    harmonics: Harmonics
    size_arcsec: float
    slew_arcsec_s: float


def run(axis: Axis, speed_deg_s: float, correction: Correction | None, offsets: Offsets) -> Run:
    """Runs an axis from rest to a speed; evaluates the constant speed after the transient."""
    cycle_s, ratio, speed = axis.cycle_s, axis.ratio, abs(speed_deg_s)
    ramp_s = speed / axis.acceleration_deg_s2
    first = round((ENGAGED_S + ramp_s + TRANSIENT_S) / cycle_s)
    count = first + round(max(WINDOW_S, TURNS * DEG_PER_TURN / ratio / speed) / cycle_s)
    time_s = np.arange(count) * cycle_s - ENGAGED_S
    path = 0.5 * axis.acceleration_deg_s2 * np.clip(time_s, 0.0, ramp_s) ** 2
    path = math.copysign(1.0, speed_deg_s) * (path + speed * np.clip(time_s - ramp_s, 0.0, None))
    machine, rows, before, last, step = axis.machine(), [], 0, 0.0, 0.0
    for target in path.tolist():
        now = correction(target) if correction else 0.0
        change, last, step = now - last - step, now, now - last
        velocity = -offsets.velocity * ratio * step / ARCSEC_PER_DEG / cycle_s
        acceleration = -ratio * change / ARCSEC_PER_DEG / cycle_s**2
        axis.offset(machine, velocity, offsets.torque * axis.inertia_kg_m2 * math.radians(acceleration))
        setpoint = round(ratio * (target - now / ARCSEC_PER_DEG) * axis.motor_counts / DEG_PER_TURN)
        machine.follow(before, setpoint, round(cycle_s / machine.dt_s))
        before = setpoint
        rows.append((target, machine.load_counts * DEG_PER_TURN / axis.load_counts, now))
    target, load, corrections = np.array(rows[first:]).T
    numbers = [each.order for each in motor_orders(axis.model)]
    found = harmonics_of(speed_deg_s, target, ARCSEC_PER_DEG * (load - target), numbers, ratio)
    slew = float(np.max(abs(np.diff(corrections)))) / cycle_s
    return Run(found, float(np.ptp(corrections)) / 2.0, slew)


def runs(
    axis: Axis, speeds: Sequence[float], model: TransmissionModel | None, offsets: Offsets, slew: float
) -> list[Run]:
    """Runs an axis at each speed in both directions."""
    found = []
    for speed in (sign * each for each in speeds for sign in (1.0, -1.0)):
        correction = None
        if model is not None:
            compensation = Compensation(model, CompensationLimits(MAXIMUM_ARCSEC, slew), axis.cycle_s)
            compensation.reset(0.0)
            compensation.engage()
            correction = _corrected(compensation)
        found.append(run(axis, speed, correction, offsets))
    return found


def _corrected(compensation: Compensation) -> Correction:
    def correction(load_deg: float) -> float:
        compensation.command(load_deg)
        return compensation.correction_arcsec

    return correction


def measured(axis: Axis, shares: Sequence[float], offsets: Offsets, slew: float) -> TransmissionModel | None:
    """Returns the model with the best response, measured like in the motion test; None without one."""
    speeds = [share * axis.speed_deg_s for share in shares]
    orders, ratio, cycle_s = motor_orders(axis.model), axis.ratio, axis.cycle_s
    tops = ((float(order_hz(each.order, axis.speed_deg_s, ratio)), each.amplitude_arcsec) for each in orders)
    limits = Limits(tuple(tops), MAXIMUM_ARCSEC, slew, axis.acceleration_deg_s2)

    def spin(model: TransmissionModel | None) -> tuple[Harmonics, ...]:
        return tuple(each.harmonics for each in runs(axis, speeds, model, offsets, slew))

    none, trials = spin(None), [Trial(spin(axis.model))]
    best, highest_hz, kept = math.inf, math.inf, None
    for explore in (True, False, False):
        response = response_of(
            none, trials, orders, ratio, cycle_s, limits, highest_hz=highest_hz, explore=explore
        )
        if response is None:
            break
        model = replace(axis.model, response=response)
        after = spin(model)
        left = [a.ripple_arcsec / b.ripple_arcsec for a, b in zip(after, none, strict=True)]
        if not explore and max(left) > 1.05:
            highest_hz = 0.7 * response.known_to_hz
        elif not explore and sum(left) < best:
            best, kept = sum(left), model
        trials.append(Trial(after, response.filter))
    return kept


def exact(axis: Axis, speeds: Sequence[float], offsets: Offsets) -> list[Run]:
    """Returns the best runs with orders optimised for each speed and direction by a few linear updates."""
    orders = motor_orders(axis.model)
    numbers = np.array([each.order for each in orders])
    te = np.array([each.amplitude_arcsec * np.exp(1j * math.radians(each.phase_deg)) for each in orders])
    found = []
    for speed in (sign * each for each in speeds for sign in (1.0, -1.0)):
        slow = _slow(axis, speed)
        error = run(axis, speed, None, offsets).harmonics.amplitudes
        sizes, tried, gains = np.where(slow, te, 0.0), [], 1.0
        for update in range(UPDATES + 1):
            tried.append(run(axis, speed, _series(axis, numbers, sizes), offsets))
            left = tried[-1].harmonics.amplitudes
            if update == 0:
                gains = np.where(slow, (error - left) / np.where(slow, te, 1.0), 1.0)
                sizes = np.where(slow, error / gains, 0.0)
            else:
                sizes = np.where(slow, sizes + 0.8 * left / gains, 0.0)
        found.append(min(tried, key=lambda each: _rms(axis, each)))
    return found


def _series(axis: Axis, numbers: np.ndarray, sizes: np.ndarray) -> Correction:
    cycles = 0

    def correction(load_deg: float) -> float:
        nonlocal cycles
        cycles += 1
        turned = np.exp(1j * numbers * math.radians(axis.ratio * load_deg))
        return min(cycles * axis.cycle_s / 0.5, 1.0) * float(np.sum(sizes * turned).real)

    return correction


def _slow(axis: Axis, speed_deg_s: float) -> np.ndarray:
    numbers = [each.order for each in motor_orders(axis.model)]
    return order_hz(numbers, speed_deg_s, axis.ratio) < 1.0 / (3.0 * axis.cycle_s)


def _rms(axis: Axis, one: Run) -> float:
    """Returns the rms of the slow orders, arcsec."""
    slow = _slow(axis, one.harmonics.speed_deg_s)
    return math.sqrt(0.5 * float(np.sum(abs(one.harmonics.amplitudes[slow]) ** 2)))


def report(name: str, shares: Sequence[float], slew: float, feedforward: float | None) -> None:
    """Prints the table of one axis."""
    kind, _, seed = name.partition(":")
    axis = Article() if name == "article" else Foreign(kind, int(seed), feedforward)
    speeds = [share * axis.speed_deg_s for share in SHARES]
    none = _both(axis, runs(axis, speeds, None, Offsets(), slew))
    print(f"{name}, none: {' '.join(f'{each:.2f}' for each in none)} arcsec rms")
    missing = round(1.0 - axis.feedforward, 3)
    for offsets in dict.fromkeys((Offsets(), Offsets(missing), Offsets(1.0), Offsets(missing, 1.0))):
        model = measured(axis, shares, offsets, slew)
        rows = {
            "static": runs(axis, speeds, axis.model, offsets, slew),
            "filtered": runs(axis, speeds, model, offsets, slew) if model else None,
            "exact": exact(axis, speeds, offsets),
        }
        for row, found in rows.items():
            if found is None:
                continue
            removed = 100.0 * (1.0 - _both(axis, found) / none)
            size, fastest = (max(each[at] for each in found) for at in (1, 2))
            print(
                f"  velocity {offsets.velocity:4g}, torque {offsets.torque:g}, {row:8}: "
                f"{' '.join(f'{each:6.1f}' for each in removed)}; {size:.0f}, {fastest:.0f}",
                flush=True,
            )


def _both(axis: Axis, found: Sequence[Run]) -> np.ndarray:
    values = np.array([_rms(axis, each) for each in found])
    return np.hypot(values[::2], values[1::2]) / math.sqrt(2.0)


def spread(count: int) -> tuple[float, ...]:
    """Returns the speeds of the motion test as fractions of the limit, or these and their midpoints."""
    between = [0.5 * sum(pair) for pair in pairwise(TESTED)]
    return TESTED if count == len(TESTED) else tuple(sorted((*TESTED, *between), reverse=True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("axes", nargs="*", default=["article", "pi_notch:100", "pi_notch:101", "observed:0"])
    parser.add_argument(
        "--speeds", type=int, default=8, choices=(8, 15), help="of the measurement of the response"
    )
    parser.add_argument("--slew", type=float, default=100_000.0, help="limit on the correction, arcsec/s")
    parser.add_argument("--feedforward", type=float, help="velocity feed-forward of a foreign servo")
    parser.add_argument("--past", type=int, default=16, help="length of the filter into the past, cycles")
    given = parser.parse_args()
    response_module.LAG_CYCLES = given.past
    for each in given.axes:
        report(each, spread(given.speeds), given.slew, given.feedforward)
