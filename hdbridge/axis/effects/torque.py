"""Growth with torque: the torque channel, its limit, and the resulting growth of the ripple."""

from collections.abc import Iterable
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.motion import SLOT, Channel, FloatArray, Moment, Motion
from hdbridge.strictness import Strict

TorqueChannel = Annotated[
    Literal["load_torque_nm", "motor_torque_nm"],
    Field(description="channel with the torque"),
]
_SLOT = {each.value: slot for each, slot in SLOT.items()}

TorqueLimit = Annotated[
    float,
    Field(
        gt=0,
        le=1e5,
        description="torque above which the effect is constant, so that no sensor fault moves the axis far",
    ),
]


TOP: Final = 0.98
"""Quantile of a channel's magnitude that serves as its maximum, because single readings may be wrong."""


def top(motion: Motion, channel: Channel) -> float:
    """Returns the largest magnitude of a measured channel; 0 if the channel is missing or constant."""
    values = motion.measured.get(channel)
    if values is None or not float(np.ptp(values)) > 0.0:
        return 0.0
    return float(np.quantile(np.abs(values), TOP))


def beyond_limit(effects: Iterable[object], motion: Motion) -> tuple[str, ...]:
    """Describes the effects that are clamped because a record's torque exceeds their range."""
    lines = []
    for each in effects:
        name, limit_nm = getattr(each, "torque", None), getattr(each, "limit_nm", None)
        torque = None if name is None else motion.measured.get(Channel(name))
        if torque is None or limit_nm is None or not len(torque):
            continue
        largest = float(np.max(np.abs(torque)))
        if largest > limit_nm:
            share = 100.0 * float(np.mean(np.abs(torque) > limit_nm))
            lines.append(
                f"{name} reaches {largest:.4g} Nm, beyond the limit_nm of {limit_nm:g} of the model's "
                f"{getattr(each, 'name', 'effect')}, which is clamped there ({share:.2g} % of the samples): "
                "raise limit_nm if the torque is right"
            )
    return tuple(lines)


class TorqueGrowth(Strict):
    """Growth of amplitudes with torque; `torque_modulation` has the same fields."""

    growth_percent_per_nm: float = Field(
        ge=-1000, le=1000, description="growth of the amplitudes per Nm of the torque channel"
    )
    signed: bool = Field(False, description="grows with the torque rather than with its magnitude")
    torque: TorqueChannel = "load_torque_nm"
    limit_nm: TorqueLimit = 100.0

    def load_nm(self, motion: Motion, effect: str) -> FloatArray:
        """Returns the torque with which the amplitudes grow, Nm, shape (n,).

        If the channel is missing, raises `InputError` that names ``effect``.
        """
        torque = np.clip(motion.channel(Channel(self.torque), effect), -self.limit_nm, self.limit_nm)
        return np.asarray(torque if self.signed else np.abs(torque))

    def load_at_nm(self, moment: Moment) -> float:
        """Returns the torque with which the amplitudes grow at one moment, Nm."""
        torque = moment.measured[_SLOT[self.torque]]
        torque = min(max(torque, -self.limit_nm), self.limit_nm)
        return torque if self.signed else abs(torque)

    def factor(self, motion: Motion, effect: str) -> FloatArray:
        """Returns the factor by which the amplitudes grow at each sample, shape (n,)."""
        return np.asarray(1.0 + 0.01 * self.growth_percent_per_nm * self.load_nm(motion, effect))

    def factor_at(self, moment: Moment) -> float:
        """Returns the factor by which the amplitudes grow at one moment."""
        return 1.0 + 0.01 * self.growth_percent_per_nm * self.load_at_nm(moment)

    def most(self) -> float:
        """Returns the largest relative growth of the amplitudes, which is reached at the torque limit."""
        return 0.01 * abs(self.growth_percent_per_nm) * self.limit_nm
