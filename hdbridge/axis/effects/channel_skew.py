"""Time skew between the samples of the two encoders."""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Angleless, Effect, Linear
from hdbridge.axis.effects.described import Cause, Compensable, Experiment, Observations
from hdbridge.axis.effects.kinematics import acceleration_of, speed_of
from hdbridge.axis.effects.load_order import Ratio
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.units import ARCSEC_PER_DEG


class ChannelSkew(Angleless, Linear):
    """delay omega_L + second alpha_L / 2: the load encoder is sampled later than the motor encoder.

    For a pure delay, second = delay^2. It is a separate parameter, because the speed is a difference between
    samples and thus delayed by half a sample, and because a delay is rarely a whole number of samples.
    Without the parameter, the residual would be attributed to inertial wind-up.
    """

    name = "channel_skew"
    channels = frozenset({Channel.SPEED, Channel.ACCELERATION})
    about = Cause(
        title="delay between the two encoder samples",
        subject="delays",
        equation="delay omega_L + second alpha_L / 2; omega_L, alpha_L = commanded motor speed and "
        "acceleration / N, limited",
        signature="an error proportional to the speed, none at rest",
        consequence="the axis is right; the measurement is wrong in motion",
        remedy="latch both encoders by one signal, or correct the time stamps in the recording",
        experiment="sweeps at several speeds both ways: skew is linear in speed, drag falls off",
        aliases=("velocity_windup", "inertial_windup", "rate_dependence"),
        source="Taylor series of the load angle about the sampling instant",
        size="0.5 ms is 103 arcsec at 1 rad/s of the load",
        apart={
            "velocity_windup": Experiment(
                2, "sweep three motor turns both ways at three speeds: skew is a straight line, drag bends"
            ),
            "inertial_windup": Experiment(
                2, "sweep at constant speed both ways: a skew remains, inertia has no effect"
            ),
        },
    )
    compensable = Compensable(False, "it is an error of the measurement")
    ordinary_arcsec = 1.0
    """Error due to ordinary skew, because no two encoders are sampled at exactly the same instant."""
    incidental = frozenset({"second_order_ms2"})
    """The second-order coefficient is no evidence, because it includes the load's inertial wind-up."""
    linear = ("delay_ms", "second_order_ms2")
    typical = {"delay_ms": 0.5, "second_order_ms2": 0.25}

    ratio: Ratio
    delay_ms: float = Field(
        ge=-1000, le=1000, description="delay of the load encoder's samples relative to the motor encoder's"
    )
    second_order_ms2: float = Field(
        0.0,
        ge=-1e6,
        le=1e6,
        description="coefficient of half the acceleration; delay squared for a pure delay",
    )
    limit_deg_s: float = Field(
        1e5, gt=0, le=1e6, description="motor speed above which the effect is constant"
    )
    limit_deg_s2: float = Field(
        1e6, gt=0, le=1e8, description="motor acceleration above which the effect is constant"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        yield cls(ratio=observations.ratio, delay_ms=1.0, second_order_ms2=1.0)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the errors due to a delay of 1 ms and a second-order term of 1 ms^2, shape (n, 2)."""
        speed = np.clip(speed_of(motion, self.name), -self.limit_deg_s, self.limit_deg_s)
        acceleration = np.clip(acceleration_of(motion, self.name), -self.limit_deg_s2, self.limit_deg_s2)
        gain = ARCSEC_PER_DEG / self.ratio
        return np.column_stack([1e-3 * gain * speed, 0.5e-6 * gain * acceleration])

    def at(self, motor_deg: float, moment: Moment) -> float:
        speed = min(max(moment.motor_speed_deg_s, -self.limit_deg_s), self.limit_deg_s)
        acceleration = min(max(moment.motor_acceleration_deg_s2, -self.limit_deg_s2), self.limit_deg_s2)
        skew_deg = 1e-3 * self.delay_ms * speed + 0.5e-6 * self.second_order_ms2 * acceleration
        return ARCSEC_PER_DEG / self.ratio * skew_deg

    def bound_arcsec(self) -> float:
        speed = 1e-3 * abs(self.delay_ms) * self.limit_deg_s
        acceleration = 0.5e-6 * abs(self.second_order_ms2) * self.limit_deg_s2
        return ARCSEC_PER_DEG / self.ratio * (speed + acceleration)
