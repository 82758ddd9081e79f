"""Mechanics with a multi-stage spring, a dead zone behind it, and torques on the load.

Gravity, drag and vibration act on the load as a torque that is constant within a substep; the deviation of
the spring from its linear first stage is treated in the same way. The linear step therefore stays exact, and
the load comes to rest exactly where the torques balance.
"""

import math

from hdbridge.sim.plant import RAD_PER_DEG, Plant
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.gear import TrueStiffening
from hdbridge.units import ARCSEC_PER_DEG

GRAVITY_M_S2 = 9.80665


@state
class Spring:
    """Spring torque as a function of wind-up: zero within the dead zone, then three linear stages."""

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

    def pull_nm(self, wind_up_deg: float) -> float:
        """Returns the torque on the load for a wind-up (output minus load) in degrees."""
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
        """Returns True if the sides of the dead zone touch."""
        return abs(wind_up_deg) > self._gap_deg or self._gap_deg == 0.0


@state
class LoadedPlant(Plant):
    """`Plant` with every load and spring property of the truth file."""

    def __init__(self, truth: Truth) -> None:
        Plant.__init__(self, truth)
        gear, load = truth.gear, truth.load_
        self._gap_deg = 0.5 * gear.backlash_arcsec / ARCSEC_PER_DEG
        self._spring = Spring(self._stiffness, gear.stiffening, self._gap_deg)
        self._whole_inertia = load.whole_inertia_kg_m2 * RAD_PER_DEG
        self._viscous = load.viscous_nm_s_per_rad * RAD_PER_DEG
        self._thinning_from = load.thinning.speed_rad_s if load.thinning else 0.0
        self._thinning_exponent = load.thinning.exponent if load.thinning else 0.0
        self._breakaway = self._breakaway_speed = 0.0
        self._breakaway_exponent = 2.0
        if load.stribeck is not None:
            rise_nm = load.stribeck.breakaway_nm - load.coulomb_nm
            self._breakaway = rise_nm / load.whole_inertia_kg_m2 / RAD_PER_DEG * self._dt
            self._breakaway_speed = math.degrees(load.stribeck.speed_rad_s)
        self._arm_nm, self._down_deg = 0.0, 0.0
        if load.gravity is not None:
            mass = load.gravity
            self._arm_nm = mass.mass_kg * GRAVITY_M_S2 * mass.arm_m * math.cos(math.radians(mass.tilt_deg))
            self._down_deg = mass.down_deg
        self._shaken = bool(load.vibration)
        self._shaking_turn: tuple[float, ...] = tuple(
            math.tau * each.frequency_hz * self._dt for each in load.vibration
        )
        self._shaking_phase: tuple[float, ...] = tuple(
            math.radians(each.phase_deg) for each in load.vibration
        )
        self._shaking_nm: tuple[float, ...] = tuple(each.torque_nm for each in load.vibration)
        self._slides = bool(load.presliding)
        self._slider_stiffness: tuple[float, ...] = tuple(
            each.limit_nm / each.travel_deg for each in load.presliding
        )
        self._slider_limit: tuple[float, ...] = tuple(each.limit_nm for each in load.presliding)
        self._held_nm: list[float] = [0.0] * len(self._slider_limit)
        self._held_deg = self.now.load_deg
        self._step = 0
        coupling = load.encoder.coupling
        self._play_deg = 0.5 * coupling.play_arcsec / ARCSEC_PER_DEG if coupling else 0.0
        self._played_deg = self.now.load_deg
        self._settle()

    @staticmethod
    def needed(truth: Truth) -> bool:
        """Returns True if a truth file contains a property that `Plant` does not simulate."""
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

    def weight_nm(self, load_deg: float) -> float:
        return -self._arm_nm * math.sin((load_deg - self._down_deg) * RAD_PER_DEG)

    def step(self, torque_nm: float, brake_nm: float) -> None:
        now, dt = self.now, self._dt
        output, load = self.output_deg, now.load_deg
        load_speed = self.load_deg_s
        lag = output - load

        # Deviation of the spring torque from its linear first stage, halfway through the substep.
        closing = self.motor_deg_s / self._ratio - load_speed
        halfway = lag + 0.5 * dt * closing
        beyond = self._spring.pull_nm(halfway) - self._stiffness * halfway
        if not self._spring.touches(halfway):
            beyond -= self._damping * closing
        spring = self._stiffness * (lag - 0.5 * dt * load_speed) - self._damping * load_speed
        moved = self._turn_motor(torque_nm, brake_nm, spring + beyond)

        if moved or not self._gear.by_motor_only:
            self.output_deg = new_output = self._gear.turned_deg(now)
            rate = (new_output - output) / dt
        else:
            new_output, rate = output, 0.0
        outer = beyond + self._outer_nm(load + 0.5 * dt * load_speed, load_speed)
        shift = outer / self._stiffness
        spline = self._flexspline
        slip = load_speed - rate
        lag += shift
        new_load = new_output + shift + spline.distance_by_rate * slip - spline.distance_by_distance * lag
        new_load_speed = rate + spline.rate_by_rate * slip - spline.rate_by_distance * lag
        loss = self._load_friction
        if self._breakaway:
            speeds = abs(load_speed / self._breakaway_speed)
            loss += self._breakaway * math.exp(-(speeds**self._breakaway_exponent))
        if loss:
            new_load, new_load_speed = self._apply_friction(load, new_load, new_load_speed, loss)
        now.torque_nm = self._spring.pull_nm(new_output - new_load)
        now.load_deg = new_load
        self.load_deg_s = new_load_speed
        if self._slides:
            for slider in range(len(self._slider_limit)):
                self._held_nm[slider] = self._held_at(slider, new_load)
            self._held_deg = new_load
        if self._play_deg:
            load, new_load = self._played_deg, self._play(new_load)
        self._turn_encoder(load, new_load)

    def _outer_nm(self, load_deg: float, load_speed: float) -> float:
        """Returns the torque on the load without the spring: external, gravity, drag, sliders, vibration."""
        outer = self.outer_nm
        if self._arm_nm:
            outer += self.weight_nm(load_deg)
        if self._viscous:
            viscous = self._viscous
            if self._thinning_exponent:
                turning = abs(load_speed) * RAD_PER_DEG
                viscous /= (1.0 + turning / self._thinning_from) ** self._thinning_exponent
            # At most the torque that stops the load within the substep.
            inertia = self._whole_inertia
            outer += inertia * math.expm1(-viscous / inertia * self._dt) / self._dt * load_speed
        if self._slides:
            held = 0.0
            for slider in range(len(self._slider_limit)):
                held += self._held_at(slider, load_deg)
            outer -= held
        if self._shaken:
            self._step += 1
            for number in range(len(self._shaking_nm)):
                angle = self._shaking_turn[number] * self._step + self._shaking_phase[number]
                outer += self._shaking_nm[number] * math.sin(angle)
        return outer

    def _held_at(self, slider: int, load_deg: float) -> float:
        """Returns the friction of a slider after monotonic motion of the load to this angle."""
        limit = self._slider_limit[slider]
        held = self._held_nm[slider] + self._slider_stiffness[slider] * (load_deg - self._held_deg)
        return min(limit, max(-limit, held))

    def _play(self, load_deg: float) -> float:
        """Returns the angle of the coupling's near side, which the load drags along across the play."""
        played = min(load_deg + self._play_deg, max(load_deg - self._play_deg, self._played_deg))
        self._played_deg = played
        return played

    def _settle(self) -> None:
        """Finds the initial wind-up that balances gravity."""
        output, low, high = self.output_deg, self.output_deg - 10.0, self.output_deg + 10.0
        if not self._arm_nm:
            return
        for _ in range(80):
            middle = 0.5 * (low + high)
            self.now.load_deg = middle
            if self._spring.pull_nm(output - middle) + self.outer_torque_nm > 0.0:
                low = middle
            else:
                high = middle
        self.now.torque_nm = -self.outer_torque_nm
        self.encoder_deg = self._played_deg = self.now.load_deg
