"""Temperature of motor and gear, and its effect on the motor's friction."""

import math

from hdbridge.sim.gear_pieces import WarmthFactor
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth


@state
class Heat:
    """Thermal mass warmed by losses and cooled by its surroundings, advanced once per control cycle."""

    body_c: float
    """Temperature of motor and gear."""
    friction_factor: float
    """Motor friction at the current temperature, relative to the friction in the truth file."""
    since_s: float
    """Time since the axis was switched on."""

    def __init__(self, truth: Truth) -> None:
        heat = truth.temperature
        self._dt_s = truth.substep_s
        self._copper_loss_w = heat.copper_loss_w / truth.motor.rated_torque_nm**2
        self._growth = WarmthFactor(heat.friction_growth_per_k, heat.unchanged_c)
        self._friction_grows = bool(heat.friction_growth_per_k)
        self._ambient_c = heat.ambient_c
        self._ambient_k_per_hour = heat.ambient_k_per_hour
        self._ambient_swing_k = heat.ambient_swing_k
        self._ambient_period_s = heat.ambient_period_s
        self._ambient_varies = bool(heat.ambient_k_per_hour or heat.ambient_swing_k)
        self._resistance_k_per_w = heat.resistance_k_per_w
        self._time_constant_s = heat.time_constant_s
        self._step_s = self._warming_fraction = self.since_s = 0.0
        self.body_c = heat.ambient_c if heat.start_c is None else heat.start_c
        self.friction_factor = self._growth.at(self.body_c) if self._friction_grows else 1.0

    def warm(self, torque_squares: float, friction_j: float, elapsed_s: float) -> None:
        """Advances by several substeps, given the sum of the squared torques (Nm^2) and the friction work."""
        self.since_s += elapsed_s
        copper_j = torque_squares * self._copper_loss_w * self._dt_s
        goal_c = self._ambient_c + self._resistance_k_per_w * ((copper_j + friction_j) / elapsed_s)
        if self._ambient_varies:
            goal_c += self._ambient_k_per_hour * self.since_s / 3600.0
            goal_c += self._ambient_swing_k * math.sin(math.tau * self.since_s / self._ambient_period_s)
        if elapsed_s != self._step_s:
            self._step_s = elapsed_s
            self._warming_fraction = -math.expm1(-elapsed_s / self._time_constant_s)
        self.body_c += (goal_c - self.body_c) * self._warming_fraction
        if self._friction_grows:
            self.friction_factor = self._growth.at(self.body_c)
