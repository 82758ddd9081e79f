"""The mechanics with a spring of several stages, a dead zone behind it, and torques on the load.

Gravity, drag, and shaking act on the load as a torque that is even within a substep; so does what the spring
does otherwise than its linear first stage: the linear step then stays exact, and at rest the load stands
exactly where the torques balance.
"""

from __future__ import annotations

import math

from hdbridge.sim.plant import RAD_PER_DEG, Plant
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.gear import TrueStiffening
from hdbridge.units import ARCSEC_PER_DEG

GRAVITY_M_S2 = 9.80665


class Spring:
    """Torque by wind-up: nothing within the dead zone, then three stages."""

    __slots__ = ("_first_deg", "_first_nm", "_gap_deg", "_k1", "_k2", "_k3", "_second_deg", "_second_nm")

    def __init__(self, stiffness: float, later: TrueStiffening | None, gap_deg: float) -> None:
        self._gap_deg = gap_deg
        self._k1 = self._k2 = self._k3 = stiffness
        self._first_nm = self._second_nm = self._first_deg = self._second_deg = math.inf
        if later is not None:
            self._k2 = later.second_stiffness_nm_per_rad * RAD_PER_DEG
            self._k3 = later.third_stiffness_nm_per_rad * RAD_PER_DEG
            self._first_nm = later.first_torque_nm
            self._second_nm = later.second_torque_nm
            self._first_deg = self._first_nm / self._k1
            self._second_deg = self._first_deg + (self._second_nm - self._first_nm) / self._k2

    def torque_nm(self, wind_up_deg: float) -> float:
        """Torque on the load for a wind-up (output before load) in degrees."""
        size = abs(wind_up_deg) - self._gap_deg
        if size <= 0.0:
            return 0.0
        if size <= self._first_deg:
            torque = self._k1 * size
        elif size <= self._second_deg:
            torque = self._first_nm + self._k2 * (size - self._first_deg)
        else:
            torque = self._second_nm + self._k3 * (size - self._second_deg)
        return torque if wind_up_deg > 0.0 else -torque

    def touches(self, wind_up_deg: float) -> bool:
        """Whether the sides of the dead zone touch."""
        return abs(wind_up_deg) > self._gap_deg or not self._gap_deg


class LoadedPlant(Plant):
    """A `Plant` with all that the truth file can put on its spring and load."""

    __slots__ = (
        "_arm_nm", "_breakaway", "_breakaway_speed", "_down_deg", "_gap_deg", "_held_deg", "_held_nm",
        "_play_deg", "_played_deg", "_shaking", "_sliders", "_spring", "_step", "_thinning", "_viscous",
        "_whole_inertia",
    )  # fmt: skip

    def __init__(self, truth: Truth) -> None:
        super().__init__(truth)
        gear, load = truth.gear, truth.load_
        self._gap_deg = 0.5 * gear.backlash_arcsec / ARCSEC_PER_DEG
        self._spring = Spring(self._stiffness, gear.stiffening, self._gap_deg)
        self._whole_inertia = load.whole_inertia_kg_m2 * RAD_PER_DEG
        self._viscous = load.viscous_nm_s_per_rad * RAD_PER_DEG
        self._thinning = (load.thinning.speed_rad_s, load.thinning.exponent) if load.thinning else None
        self._breakaway = self._breakaway_speed = 0.0
        if load.stribeck is not None:
            rise_nm = load.stribeck.breakaway_nm - load.coulomb_nm
            self._breakaway = rise_nm / load.whole_inertia_kg_m2 / RAD_PER_DEG * self._dt
            self._breakaway_speed = math.degrees(load.stribeck.speed_rad_s)
        self._arm_nm, self._down_deg = 0.0, 0.0
        if load.gravity is not None:
            mass = load.gravity
            self._arm_nm = mass.mass_kg * GRAVITY_M_S2 * mass.arm_m * math.cos(math.radians(mass.tilt_deg))
            self._down_deg = mass.down_deg
        self._shaking = tuple(
            (math.tau * each.frequency_hz * self._dt, math.radians(each.phase_deg), each.torque_nm)
            for each in load.vibration
        )
        self._sliders = tuple((each.limit_nm / each.travel_deg, each.limit_nm) for each in load.presliding)
        self._held_nm = [0.0] * len(self._sliders)
        self._held_deg = self.now.load_deg
        self._step = 0
        coupling = load.encoder.coupling
        self._play_deg = 0.5 * coupling.play_arcsec / ARCSEC_PER_DEG if coupling else 0.0
        self._played_deg = self.now.load_deg
        self._settle()

    @staticmethod
    def needed(truth: Truth) -> bool:
        """Whether a truth file asks for anything that `Plant` does not have."""
        gear, load = truth.gear, truth.load_
        coupling = load.encoder.coupling
        return bool(
            gear.stiffening is not None
            or gear.backlash_arcsec
            or load.gravity is not None
            or load.stribeck is not None
            or load.thinning is not None
            or load.presliding
            or load.vibration
            or (coupling is not None and coupling.play_arcsec)
        )

    @property
    def outer_torque_nm(self) -> float:
        """See `Plant`."""
        return -self._arm_nm * math.sin((self.now.load_deg - self._down_deg) * RAD_PER_DEG)

    def advance(self, torque_nm: float, brake_nm: float) -> None:
        """See `Plant`."""
        now, dt = self.now, self._dt
        output, load = self.output_deg, now.load_deg
        load_speed = self.load_deg_s
        lag = output - load

        # What the spring does beyond its linear first stage, halfway through the substep.
        closing = self.motor_deg_s / self._ratio - load_speed
        halfway = lag + 0.5 * dt * closing
        beyond = self._spring.torque_nm(halfway) - self._stiffness * halfway
        if not self._spring.touches(halfway):
            beyond -= self._damping * closing
        spring = self._stiffness * (lag - 0.5 * dt * load_speed) - self._damping * load_speed
        moved = self._turn_motor(torque_nm, brake_nm, spring + beyond)

        if moved or not self._gear.by_motor_only:
            self.output_deg = new_output = self._gear.output_deg(now)
            rate = (new_output - output) / dt
        else:
            new_output, rate = output, 0.0
        outer = beyond + self._outer_nm(load + 0.5 * dt * load_speed, load_speed)
        shift = outer / self._stiffness
        a, b, c, d = self._flexspline
        slip = load_speed - rate
        lag += shift
        new_load = new_output + shift + b * slip - a * lag
        new_load_speed = rate + d * slip - c * lag
        loss = self._load_friction
        if self._breakaway:
            loss += self._breakaway * math.exp(-((load_speed / self._breakaway_speed) ** 2))
        if loss:
            new_load, new_load_speed = self._rub(load, new_load, new_load_speed, loss)
        now.torque_nm = self._spring.torque_nm(new_output - new_load)
        now.load_deg = new_load
        self.load_deg_s = new_load_speed
        if self._sliders:
            self._held_nm, self._held_deg = self._held_at(new_load), new_load
        if self._play_deg:
            load, new_load = self._played_deg, self._play(new_load)
        self._turn_encoder(load, new_load)

    def _outer_nm(self, load_deg: float, load_speed: float) -> float:
        """Gravity, viscous drag and shaking, on the load."""
        outer = 0.0
        if self._arm_nm:
            outer -= self._arm_nm * math.sin((load_deg - self._down_deg) * RAD_PER_DEG)
        if self._viscous:
            viscous = self._viscous
            if self._thinning is not None:
                from_rad_s, exponent = self._thinning
                viscous /= (1.0 + abs(load_speed) * RAD_PER_DEG / from_rad_s) ** exponent
            # No more than stops the load within the substep.
            inertia = self._whole_inertia
            outer += inertia * math.expm1(-viscous / inertia * self._dt) / self._dt * load_speed
        if self._sliders:
            outer -= sum(self._held_at(load_deg))
        if self._shaking:
            self._step += 1
            for turn, phase, torque in self._shaking:
                outer += torque * math.sin(turn * self._step + phase)
        return outer

    def _held_at(self, load_deg: float) -> list[float]:
        """The friction of each slider once the load has moved straight to this angle."""
        travel = load_deg - self._held_deg
        return [
            min(limit, max(-limit, held + stiffness * travel))
            for (stiffness, limit), held in zip(self._sliders, self._held_nm, strict=True)
        ]

    def _play(self, load_deg: float) -> float:
        """The coupling's near side, which the load takes along once the play is used up."""
        played = min(load_deg + self._play_deg, max(load_deg - self._play_deg, self._played_deg))
        self._played_deg = played
        return played

    def _settle(self) -> None:
        """Let the load hang on its spring before the start: the wind-up that balances gravity."""
        output, low, high = self.output_deg, self.output_deg - 10.0, self.output_deg + 10.0
        if not self._arm_nm:
            return
        for _ in range(80):
            middle = 0.5 * (low + high)
            self.now.load_deg = middle
            if self._spring.torque_nm(output - middle) + self.outer_torque_nm > 0.0:
                low = middle
            else:
                high = middle
        self.now.torque_nm = -self.outer_torque_nm
        self.encoder_deg = self._played_deg = self.now.load_deg
