"""Causes of transmission error in the gear other than orders and hysteresis; see `hdbridge.sim.gear`.

Each piece is asked once per substep, in order of time, so those with a state advance by one substep.
"""

from __future__ import annotations

import math
import random
from typing import ClassVar

from hdbridge.sim.conditions import Conditions
from hdbridge.sim.truth.gear import (
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


class Flank:
    """Which flank of the teeth carries: -1 to 1, by the travel of the motor."""

    __slots__ = ("_last_deg", "_share", "_shift_deg", "_travel_deg")

    def __init__(self, truth: TrueFlank) -> None:
        self._shift_deg = truth.shift_deg
        self._travel_deg = truth.travel_deg
        self._last_deg = 0.0
        self._share = 0.0

    def shift_deg(self, motor_deg: float) -> float:
        """Shift of the tooth error, in motor degrees, once the motor has come to this angle."""
        share = self._share + 2.0 * (motor_deg - self._last_deg) / self._travel_deg
        self._last_deg = motor_deg
        self._share = min(1.0, max(-1.0, share))
        return self._shift_deg * self._share


class SpeedFactor:
    """Growth of the rolling friction with the logarithm of speed, behind which it lags."""

    __slots__ = ("_dt", "_from_deg_s", "_gain", "_last_deg", "_nearer", "_now")

    def __init__(self, truth: TrueRate, dt_s: float) -> None:
        self._gain = truth.growth_per_decade
        self._from_deg_s = truth.from_deg_s
        self._dt = dt_s
        self._nearer = -math.expm1(-dt_s / truth.time_constant_s)
        self._last_deg = 0.0
        self._now = 0.0

    def __call__(self, now: Conditions) -> float:
        """The factor after one more substep."""
        speed_deg_s = abs(now.motor_deg - self._last_deg) / self._dt
        self._last_deg = now.motor_deg
        goal = self._gain * math.log10(1.0 + speed_deg_s / self._from_deg_s)
        self._now += (goal - self._now) * self._nearer
        return 1.0 + self._now


class TorqueFactor:
    """Growth of the tooth error with the torque that the teeth carry."""

    __slots__ = ("_per_nm",)

    def __init__(self, per_nm: float) -> None:
        self._per_nm = per_nm

    def __call__(self, now: Conditions) -> float:
        """The factor under these conditions."""
        return 1.0 + self._per_nm * abs(now.torque_nm)


class WarmthFactor:
    """Growth with the temperature; never below a twentieth."""

    __slots__ = ("_per_k", "_reference_c")

    def __init__(self, per_k: float, reference_c: float) -> None:
        self._per_k = per_k
        self._reference_c = reference_c

    def __call__(self, now: Conditions) -> float:
        """The factor under these conditions."""
        return self.at(now.temperature_c)

    def at(self, temperature_c: float) -> float:
        """The factor at a temperature."""
        return max(0.05, 1.0 + self._per_k * (temperature_c - self._reference_c))


class Wear:
    """Lost motion between the teeth: the output lags in either direction, by what its travel has worn."""

    BY_MOTOR_ONLY: ClassVar[bool] = True
    __slots__ = ("_exponent", "_follower_deg", "_last_deg", "_per_1000", "_ratio", "_turns")

    def __init__(self, truth: TrueWear, ratio: float) -> None:
        self._per_1000 = truth.arcsec_per_1000_turns
        self._exponent = truth.exponent
        self._ratio = ratio
        self._last_deg = 0.0
        self._turns = 0.0
        self._follower_deg = 0.0

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        motor_deg = now.motor_deg
        self._turns += abs(motor_deg - self._last_deg) / DEG_PER_TURN
        self._last_deg = motor_deg
        lost_arcsec = self._per_1000 * (self._turns / 1000.0) ** self._exponent
        lost_deg = lost_arcsec / ARCSEC_PER_DEG * self._ratio
        self._follower_deg = min(motor_deg + lost_deg, max(motor_deg - lost_deg, self._follower_deg))
        return (self._follower_deg - motor_deg) / self._ratio * ARCSEC_PER_DEG


class Creep:
    """Kelvin-Voigt elements in series: each yields, in its time, to the teeth's drag and to the load.

    The drag acts while the motor turns, against the motion, and ceases when it stands: after a stop the
    output creeps on. A torque at the load is yielded to for as long as it is there.
    """

    BY_MOTOR_ONLY: ClassVar[bool] = False
    SLIDING_DEG_S: ClassVar[float] = 0.5
    __slots__ = ("_dt", "_elements", "_last_deg", "_states")

    def __init__(self, elements: tuple[TrueCreep, ...], dt_s: float) -> None:
        self._dt = dt_s
        self._elements = tuple(
            (each.amplitude_arcsec, each.arcsec_per_nm, -math.expm1(-dt_s / each.time_constant_s))
            for each in elements
        )
        self._states = [0.0] * len(elements)
        self._last_deg = 0.0

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        speed_deg_s = (now.motor_deg - self._last_deg) / self._dt
        self._last_deg = now.motor_deg
        sliding = speed_deg_s / (abs(speed_deg_s) + self.SLIDING_DEG_S)
        states, torque_nm = self._states, now.torque_nm
        for position, (amplitude, per_nm, nearer) in enumerate(self._elements):
            state = states[position]
            states[position] = state + (-amplitude * sliding - per_nm * torque_nm - state) * nearer
        return sum(states)


class Jumps:
    """Teeth jumped, each within its time."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    __slots__ = ("_dt", "_jumps", "_step", "_tooth_arcsec")

    def __init__(self, jumps: tuple[TrueJump, ...], teeth: float, dt_s: float) -> None:
        self._dt = dt_s
        self._jumps = jumps
        self._tooth_arcsec = DEG_PER_TURN / teeth * ARCSEC_PER_DEG
        self._step = -1

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        self._step += 1
        time_s = self._step * self._dt
        done = 0.0
        for each in self._jumps:
            part = min(1.0, max(0.0, (time_s - each.time_s) / each.duration_s))
            done += each.teeth * 0.5 * (1.0 - math.cos(math.pi * part))
        return done * self._tooth_arcsec


class Damage:
    """Damaged teeth: smooth bumps by load angle."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    __slots__ = ("_bumps",)

    def __init__(self, teeth: tuple[TrueDamage, ...]) -> None:
        self._bumps = tuple((each.at_deg, each.width_deg / 2.0, each.height_arcsec) for each in teeth)

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        error = 0.0
        for at_deg, reach_deg, height in self._bumps:
            off = math.remainder(now.load_deg - at_deg, DEG_PER_TURN) / reach_deg
            if -1.0 < off < 1.0:
                error += height * 0.5 * (1.0 + math.cos(math.pi * off))
        return error


class Roller:
    """A roller on the motor's hub that disturbs it by its own angle, most where the load presses it on."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    __slots__ = ("_amplitude", "_order", "_phase_rad", "_pressed_at_deg", "_sharpness")

    def __init__(self, truth: TrueRoller) -> None:
        self._amplitude = truth.amplitude_arcsec
        self._order = truth.order
        self._phase_rad = math.radians(truth.phase_deg)
        self._pressed_at_deg = truth.pressed_at_deg
        self._sharpness = truth.sharpness

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        pressed = 0.5 * (1.0 + math.cos(math.radians(now.load_deg - self._pressed_at_deg)))
        turned = math.radians(now.motor_deg * self._order) + self._phase_rad
        return float(self._amplitude * pressed**self._sharpness * math.cos(turned))


class Seat:
    """A bearing ring carried along by the motion until it slips back, at random angles."""

    BY_MOTOR_ONLY: ClassVar[bool] = True
    __slots__ = ("_carried", "_last_deg", "_per_deg", "_random", "_slip", "_slips_at")

    def __init__(self, truth: TrueSeat) -> None:
        self._random = random.Random(f"seat {truth.seed}")
        self._slip = truth.slip_arcsec
        self._per_deg = truth.slip_arcsec / truth.travel_deg
        self._carried = 0.0
        self._last_deg = 0.0
        self._slips_at = self._drawn()

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        self._carried += self._per_deg * (now.motor_deg - self._last_deg)
        self._last_deg = now.motor_deg
        if abs(self._carried) > self._slips_at:
            self._carried *= self._random.uniform(-0.2, 0.2)
            self._slips_at = self._drawn()
        return self._carried

    def _drawn(self) -> float:
        return self._slip * self._random.uniform(0.4, 1.0)
