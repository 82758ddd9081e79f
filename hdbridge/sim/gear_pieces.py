"""Causes of transmission error in the gear other than orders and hysteresis; see `hdbridge.sim.gear`.

Each piece is evaluated once per substep, in order of time, so a piece with a state advances by one substep
per evaluation. Ageing is linear from switch-on: stiffening grease and settling preload change the hysteresis
loop, and wear of the teeth changes the tooth error.
"""

import math
import random
from typing import ClassVar, Final

from hdbridge.sim.orders import Orders
from hdbridge.sim.state import Conditions, state
from hdbridge.sim.truth.gear import (
    TrueAgeing,
    TrueCreep,
    TrueDamage,
    TrueFlank,
    TrueJump,
    TrueRate,
    TrueRoller,
    TrueSeat,
    TrueWear,
)
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

SLIDING_DEG_S: Final = 0.5
"""Motor speed at which the teeth's drag reaches half of its full value."""


@state
class Flank:
    """Loaded flank of the teeth, from -1 to 1, which changes with the motor's travel."""

    def __init__(self, truth: TrueFlank) -> None:
        self._shift_deg = truth.shift_deg
        self._travel_deg = truth.travel_deg
        self._last_deg = 0.0
        self._share = 0.0

    def shift_deg(self, motor_deg: float) -> float:
        """Returns the shift of the tooth error at the new motor angle, in motor degrees."""
        share = self._share + 2.0 * (motor_deg - self._last_deg) / self._travel_deg
        self._last_deg = motor_deg
        self._share = min(1.0, max(-1.0, share))
        return self._shift_deg * self._share


@state
class SpeedFactor:
    """Factor for rolling friction that grows with the logarithm of the motor speed, with a lag."""

    def __init__(self, truth: TrueRate, dt_s: float) -> None:
        self._gain = truth.growth_per_decade
        self._from_deg_s = truth.from_deg_s
        self._dt = dt_s
        self._nearer = -math.expm1(-dt_s / truth.time_constant_s)
        self._last_deg = 0.0
        self._now = 0.0

    def factor(self, now: Conditions) -> float:
        speed_deg_s = abs(now.motor_deg - self._last_deg) / self._dt
        self._last_deg = now.motor_deg
        goal = self._gain * math.log10(1.0 + speed_deg_s / self._from_deg_s)
        self._now += (goal - self._now) * self._nearer
        return 1.0 + self._now


@state
class WarmthFactor:
    """Factor that grows linearly with the temperature; at least 0.05."""

    def __init__(self, per_k: float, reference_c: float) -> None:
        self._per_k = per_k
        self._reference_c = reference_c

    def factor(self, now: Conditions) -> float:
        return self.at(now.temperature_c)

    def at(self, temperature_c: float) -> float:
        return max(0.05, 1.0 + self._per_k * (temperature_c - self._reference_c))


@state
class Age:
    """Completed fraction of the ageing, which rises from 0 at switch-on to 1 and stays there."""

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._step = dt_s / truth.duration_s
        self._share = 0.0

    def grown(self) -> float:
        """Advances by one substep and returns the completed fraction."""
        self._share = min(1.0, self._share + self._step)
        return self._share


@state
class AgeFactor:
    """Factor that multiplies the elastic hysteresis and grows with age."""

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._growth = truth.hysteresis_growth

    def factor(self, now: Conditions) -> float:
        return 1.0 + self._growth * self._age.grown()


@state
class WornTeeth:
    """Additional tooth error, a function of the motor angle, that grows with age."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._orders = Orders(truth.motor_orders)

    def arcsec(self, now: Conditions) -> float:
        share = self._age.grown()
        error, slope = self._orders.at(math.radians(now.motor_deg))
        now.slope_arcsec += share * slope
        return share * error


@state
class Wear:
    """Lost motion between the teeth: the output lags in either direction, and the lag grows with wear."""

    by_motor_only: ClassVar[bool] = True

    def __init__(self, truth: TrueWear, ratio: float) -> None:
        self._per_1000 = truth.arcsec_per_1000_turns
        self._exponent = truth.exponent
        self._ratio = ratio
        self._last_deg = 0.0
        self._turns = 0.0
        self._follower_deg = 0.0

    def arcsec(self, now: Conditions) -> float:
        motor_deg = now.motor_deg
        self._turns += abs(motor_deg - self._last_deg) / DEG_PER_TURN
        self._last_deg = motor_deg
        lost_arcsec = self._per_1000 * (self._turns / 1000.0) ** self._exponent
        lost_deg = lost_arcsec / ARCSEC_PER_DEG * self._ratio
        self._follower_deg = min(motor_deg + lost_deg, max(motor_deg - lost_deg, self._follower_deg))
        return (self._follower_deg - motor_deg) / self._ratio * ARCSEC_PER_DEG


@state
class Creep:
    """Kelvin-Voigt elements in series, each yielding to the teeth's drag and to the load.

    The drag acts against the motion while the motor turns, and ceases at standstill, so the output continues
    to creep after a stop. A torque at the load acts on the elements for as long as it lasts.
    """

    by_motor_only: ClassVar[bool] = False

    def __init__(self, elements: tuple[TrueCreep, ...], dt_s: float) -> None:
        self._dt = dt_s
        self._amplitudes: tuple[float, ...] = tuple(each.amplitude_arcsec for each in elements)
        self._per_nm: tuple[float, ...] = tuple(each.arcsec_per_nm for each in elements)
        self._nearer: tuple[float, ...] = tuple(
            -math.expm1(-dt_s / each.time_constant_s) for each in elements
        )
        self._states: list[float] = [0.0] * len(elements)
        self._last_deg = 0.0

    def arcsec(self, now: Conditions) -> float:
        speed_deg_s = (now.motor_deg - self._last_deg) / self._dt
        self._last_deg = now.motor_deg
        sliding = speed_deg_s / (abs(speed_deg_s) + SLIDING_DEG_S)
        total = 0.0
        for element in range(len(self._states)):
            yielded = self._states[element]
            goal = -self._amplitudes[element] * sliding - self._per_nm[element] * now.torque_nm
            yielded += (goal - yielded) * self._nearer[element]
            self._states[element] = yielded
            total += yielded
        return total


@state
class Jumps:
    """Tooth jumps, each spread over its duration."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, jumps: tuple[TrueJump, ...], teeth: float, dt_s: float) -> None:
        self._dt = dt_s
        self._time_s: tuple[float, ...] = tuple(each.time_s for each in jumps)
        self._duration_s: tuple[float, ...] = tuple(each.duration_s for each in jumps)
        self._teeth: tuple[float, ...] = tuple(float(each.teeth) for each in jumps)
        self._tooth_arcsec = DEG_PER_TURN / teeth * ARCSEC_PER_DEG
        self._step: int = -1

    def arcsec(self, now: Conditions) -> float:
        self._step += 1
        time_s = self._step * self._dt
        done = 0.0
        for jump in range(len(self._teeth)):
            if self._teeth[jump]:
                part = min(1.0, max(0.0, (time_s - self._time_s[jump]) / self._duration_s[jump]))
                done += self._teeth[jump] * 0.5 * (1.0 - math.cos(math.pi * part))
        return done * self._tooth_arcsec


@state
class Damage:
    """Damaged teeth: smooth bumps of the error at certain load angles."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, teeth: tuple[TrueDamage, ...]) -> None:
        self._at_deg: tuple[float, ...] = tuple(each.at_deg for each in teeth)
        self._reach_deg: tuple[float, ...] = tuple(each.width_deg / 2.0 for each in teeth)
        self._height: tuple[float, ...] = tuple(each.height_arcsec for each in teeth)

    def arcsec(self, now: Conditions) -> float:
        error = 0.0
        for bump in range(len(self._height)):
            if self._height[bump]:
                off_deg = math.remainder(now.load_deg - self._at_deg[bump], DEG_PER_TURN)
                off = off_deg / self._reach_deg[bump]
                if -1.0 < off < 1.0:
                    error += self._height[bump] * 0.5 * (1.0 + math.cos(math.pi * off))
        return error


@state
class Roller:
    """Roller on the motor's hub: an error over its own angle, largest at the load angle of the contact."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, truth: TrueRoller) -> None:
        self._amplitude = truth.amplitude_arcsec
        self._order = truth.order
        self._phase_rad = math.radians(truth.phase_deg)
        self._pressed_at_deg = truth.pressed_at_deg
        self._sharpness = truth.sharpness

    def arcsec(self, now: Conditions) -> float:
        pressed = 0.5 * (1.0 + math.cos(math.radians(now.load_deg - self._pressed_at_deg)))
        turned = math.radians(now.motor_deg * self._order) + self._phase_rad
        amplitude = float(self._amplitude * pressed**self._sharpness)
        now.slope_arcsec -= amplitude * self._order * math.sin(turned)
        return amplitude * math.cos(turned)


class Seat:
    """Bearing ring that is dragged along by the motion and slips back at random angles."""

    by_motor_only: ClassVar[bool] = True

    def __init__(self, truth: TrueSeat) -> None:
        self._random = random.Random(f"seat {truth.seed}")
        self._slip = truth.slip_arcsec
        self._per_deg = truth.slip_arcsec / truth.travel_deg
        self._carried = 0.0
        self._last_deg = 0.0
        self._slips_at = self._drawn()

    def arcsec(self, now: Conditions) -> float:
        self._carried += self._per_deg * (now.motor_deg - self._last_deg)
        self._last_deg = now.motor_deg
        if abs(self._carried) > self._slips_at:
            self._carried *= self._random.uniform(-0.2, 0.2)
            self._slips_at = self._drawn()
        return self._carried

    def _drawn(self) -> float:
        return self._slip * self._random.uniform(0.4, 1.0)
