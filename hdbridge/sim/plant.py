"""Mechanics: motor and load, the gear's spring between them, friction, and the coupling to the load encoder.

The stiff linear parts (load on the gear's spring, encoder on its coupling) are stepped exactly for a base
that moves linearly within a step. The step of the motor is implicit in its friction: Coulomb friction is a
set-valued force, so a motor whose torque does not exceed it stands perfectly still, without creep or chatter.

The gear's reaction on the motor follows from the energy in its spring. With q the motor angle, p the load
angle, e the tooth error and h the hysteresis,

    V = K w^2 / 2,  w = q/N + e(q) + h - p:     torque on the load  -dV/dp = K w = T
                                                torque on the motor -dV/dq = -T (1/N + de/dq)

(Lagrange's equations; Goldstein, Classical Mechanics, chapter 1). The tooth error therefore changes the
momentary ratio for the reaction in the same way as for the angles, by up to some per cent. The hysteresis is
not a function of the motor angle. If K h is the friction torque by which the teeth drag the output along, it
acts on motor and load with the nominal ratio. If sticking contacts displace the output instead, they do no
work, and dh/dq contributes to the reaction too: ``gear.hysteresis_reaction`` is the fraction that does so. If
the error grows with the torque, e (1 + g |T|), the spring has the stiffness K / (1 - K g e) in the direction
of the torque, and dV/dq = T (1/N + (1 + g |T| / 2) de/dq). An error over the load angle would change the
torque on the load by less than a thousandth; this is neglected.

`Plant` has a linear spring and a load without external torques; `hdbridge.sim.loaded_plant` has all other
properties.
"""

import math

from hdbridge.sim.gear import Gear
from hdbridge.sim.oscillator import Transition, exact_step, transition
from hdbridge.sim.state import Conditions, state
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG

RAD_PER_DEG = math.pi / 180.0


@state
class Plant:
    """State of the mechanics. Angles in degrees, rates in degrees per second, torques in newton metres."""

    now: Conditions
    """Angles of motor and load, and the other conditions of the gear."""
    loss_j: float
    """Friction work at the motor shaft since this attribute was last reset."""
    outer_nm: float
    """External torque on the load, in addition to its weight; only `LoadedPlant` applies it."""

    def __init__(self, truth: Truth) -> None:
        dt = truth.substep_s
        gear, motor, load = truth.gear, truth.motor, truth.load_
        self._dt = dt
        self._ratio = gear.ratio
        self._stiffness = gear.stiffness_nm_per_rad * RAD_PER_DEG
        self._damping = gear.damping_nm_s_per_rad * RAD_PER_DEG
        # Mean spring torque over a step, divided by the sum of the motor speeds at the two ends of the step.
        self._arm = (self._stiffness * dt / 4.0 + self._damping / 2.0) / gear.ratio
        self._inertia = motor.inertia_kg_m2 * RAD_PER_DEG / dt
        self._drag = self._cold_drag = motor.viscous_nm_s_per_rad * RAD_PER_DEG
        self._coulomb = self._cold_coulomb = motor.coulomb_nm
        self._sticking, self._stribeck = 0.0, 1.0
        if motor.stribeck is not None:
            self._sticking = motor.stribeck.rise * motor.coulomb_nm
            self._stribeck = math.degrees(motor.stribeck.speed_rad_s)
        self._cold_sticking = self._sticking

        inertia = load.whole_inertia_kg_m2
        frequency = math.sqrt(gear.stiffness_nm_per_rad / inertia)
        damping_ratio = gear.damping_nm_s_per_rad / (2.0 * inertia * frequency)
        self._flexspline = Transition(exact_step(frequency, damping_ratio, dt))
        self._load_drag = math.exp(-load.viscous_nm_s_per_rad / inertia * dt)
        self._load_friction = load.coulomb_nm / inertia / RAD_PER_DEG * dt

        coupling = load.encoder.coupling
        self._coupled: bool = coupling is not None
        self._coupling: Transition = transition(coupling, dt)

        start_c = truth.temperature.start_c
        self.now = Conditions(truth.temperature.ambient_c if start_c is None else start_c)
        self._gear = Gear(truth)
        self.output_deg = self._gear.turned_deg(self.now)
        self.now.load_deg = self.encoder_deg = self.output_deg
        self.motor_deg_s = self.load_deg_s = self._encoder_rate = 0.0
        self.loss_j = self.outer_nm = 0.0

    def step(self, torque_nm: float, brake_nm: float) -> None:
        """Runs one substep with a motor torque; the brake adds to the Coulomb friction."""
        now, dt = self.now, self._dt
        output, load = self.output_deg, now.load_deg
        load_speed = self.load_deg_s
        lag = output - load
        spring = self._stiffness * (lag - 0.5 * dt * load_speed) - self._damping * load_speed
        moved = self._turn_motor(torque_nm, brake_nm, spring)

        # Load, relative to the gear's output.
        if moved or not self._gear.by_motor_only:
            self.output_deg = new_output = self._gear.turned_deg(now)
            rate = (new_output - output) / dt
        else:
            new_output, rate = output, 0.0
        spline = self._flexspline
        slip = load_speed - rate
        new_load = new_output + spline.distance_by_rate * slip - spline.distance_by_distance * lag
        new_load_speed = (rate + spline.rate_by_rate * slip - spline.rate_by_distance * lag) * self._load_drag
        if self._load_friction:
            new_load, new_load_speed = self._apply_friction(
                load, new_load, new_load_speed, self._load_friction
            )
        now.torque_nm = self._stiffness * (new_output - new_load)
        now.load_deg = new_load
        self.load_deg_s = new_load_speed
        self._turn_encoder(load, new_load)

    @property
    def outer_torque_nm(self) -> float:
        """Torque of gravity on the load, as measured at its flange; positive forward."""
        return self.weight_nm(self.now.load_deg)

    def weight_nm(self, load_deg: float) -> float:
        """Returns the torque of gravity on the load at an angle; positive forward."""
        return 0.0

    def scale_friction(self, factor: float) -> None:
        """Sets the motor's friction to ``factor`` times that of the truth file."""
        self._coulomb = self._cold_coulomb * factor
        self._sticking = self._cold_sticking * factor
        self._drag = self._cold_drag * factor

    def _turn_motor(self, torque_nm: float, brake_nm: float, spring: float) -> bool:
        """Runs the motor's part of a substep; returns True if the motor moved.

        ``spring`` is the spring torque without the contribution of the motor's own motion in this substep,
        which is arm * lever * (old speed + new speed).
        """
        now, dt, speed = self.now, self._dt, self.motor_deg_s
        held = self._coulomb + brake_nm
        if self._sticking:
            speeds = speed / self._stribeck
            held += self._sticking * math.exp(-speeds * speeds)
        # Nominal ratio divided by momentary ratio.
        lever = 1.0 + self._ratio * now.slope_arcsec * RAD_PER_DEG / ARCSEC_PER_DEG
        arm = self._arm * lever * lever / self._ratio
        push = (self._inertia - arm) * speed + torque_nm - spring * lever / self._ratio
        if push > held:
            new_speed = (push - held) / (self._inertia + arm + self._drag)
        elif push < -held:
            new_speed = (push + held) / (self._inertia + arm + self._drag)
        else:
            new_speed = 0.0
        moved = new_speed != 0.0 or speed != 0.0
        if moved:
            now.motor_deg += 0.5 * dt * (speed + new_speed)
            turned = abs(new_speed)
            self.loss_j += (held + self._drag * turned) * turned * RAD_PER_DEG * dt
        self.motor_deg_s = new_speed
        return moved

    def _turn_encoder(self, load: float, new_load: float) -> None:
        """Runs the load encoder's part of a substep, relative to the load."""
        if not self._coupled:
            self.encoder_deg = new_load
            return
        step = self._coupling
        rate = (new_load - load) / self._dt
        ahead = self.encoder_deg - load
        slip = self._encoder_rate - rate
        self.encoder_deg = new_load + step.distance_by_distance * ahead + step.distance_by_rate * slip
        self._encoder_rate = rate + step.rate_by_distance * ahead + step.rate_by_rate * slip

    def _apply_friction(self, before: float, load: float, speed: float, loss: float) -> tuple[float, float]:
        """Applies Coulomb friction at the load: slows the load, or holds it if the friction suffices."""
        if abs(speed) <= loss:
            return before, 0.0
        loss = math.copysign(loss, speed)
        return load - 0.5 * loss * self._dt, speed - loss
