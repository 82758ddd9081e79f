"""Wind-up of the gear by the load's own inertia during acceleration."""

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Angleless, Linear
from hdbridge.axis.effects.described import Cause, Compensable, Observations
from hdbridge.axis.effects.kinematics import acceleration_of
from hdbridge.axis.effects.load_order import Ratio
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.units import ARCSEC_PER_DEG


class InertialWindup(Angleless, Linear):
    """-(J / K) alpha_L: the load lags during acceleration."""

    name = "inertial_windup"
    channels = frozenset({Channel.ACCELERATION})
    about = Cause(
        title="wind-up by inertia",
        subject="wind-up",
        equation="-(J / K) alpha_L, alpha_L = commanded motor acceleration / N, limited to the limit / N",
        signature="the error follows the acceleration; nothing at rest or at constant speed",
        consequence="the load lags in each acceleration and leads in each deceleration",
        remedy="compensate it, or accept it if only positions at rest matter; less inertia, a stiffer gear",
        experiment="the same move at another acceleration: wind-up scales; a resonance rings at its own "
        "frequency",
        aliases=("channel_skew", "compliance"),
        source="spring and inertia far below the resonance: J / K = 1 / (2 pi f)^2",
        size="7 arcsec at 200 deg/s^2 with a resonance at 50 Hz",
    )
    compensable = Compensable(
        True, "the load really has this error and the acceleration is commanded; it is zero at rest"
    )
    ordinary_arcsec = 1.5
    """Peak wind-up of an ordinary axis in its fastest moves."""
    linear = ("inertia_over_stiffness_s2",)
    typical = {"inertia_over_stiffness_s2": 1e-5}
    """Value for a resonance at 50 Hz."""

    ratio: Ratio
    inertia_over_stiffness_s2: float = Field(
        ge=0, le=0.1, description="J / K at the load, 1 / (2 pi f)^2 of its resonance"
    )
    limit_deg_s2: float = Field(
        1e6, gt=0, le=1e8, description="motor acceleration above which the effect is constant"
    )

    def unidentifiable(self, observations: Observations) -> str:
        """Requires a load that does not oscillate visibly: wind-up is the slow part of the oscillation."""
        return "it belongs to the load's ordinary oscillation" if observations.load_swings else ""

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error for J / K = 1 s^2, shape (n, 1)."""
        limit = self.limit_deg_s2
        acceleration = np.clip(acceleration_of(motion, self.name), -limit, limit)
        return (-ARCSEC_PER_DEG / self.ratio * acceleration)[:, np.newaxis]

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the next term in the expansion of the resonance, which this law neglects, shape (n, 1).

        The term is J / K times the second time derivative of the wind-up.
        """
        beyond = np.zeros(len(motion))
        step_s = 0.0 if motion.time_s is None else float(np.median(np.diff(motion.time_s)))
        if step_s > 0.0:
            bend = np.diff(self.predict(motion, start), 2) / step_s**2
            beyond[1:-1] = self.inertia_over_stiffness_s2 * bend
        return beyond[:, np.newaxis]

    def at(self, motor_deg: float, moment: Moment) -> float:
        acceleration = min(max(moment.motor_acceleration_deg_s2, -self.limit_deg_s2), self.limit_deg_s2)
        return -ARCSEC_PER_DEG / self.ratio * self.inertia_over_stiffness_s2 * acceleration

    def bound_arcsec(self) -> float:
        return ARCSEC_PER_DEG / self.ratio * abs(self.inertia_over_stiffness_s2) * self.limit_deg_s2
