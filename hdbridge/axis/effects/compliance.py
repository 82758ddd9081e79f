"""Wind-up of the gear due to load torque: a spring that stiffens at two torques."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from hdbridge.axis.effects.base import Angleless, Effect, Linear
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Shape
from hdbridge.axis.effects.load_order import LoadOrders
from hdbridge.axis.effects.motion import SLOT, Channel, FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.orders import orders_from
from hdbridge.axis.effects.torque import TorqueChannel, TorqueLimit, top

SOFTER = 1.05
"""Maximum ratio of a zone's compliance to that of the zone below it, to allow for noise."""

_Softness = Annotated[float, Field(ge=0, le=1000)]


class Compliance(Angleless, Linear):
    """sense * wind-up, with compliance c1 up to torque T1, c2 up to T2, and c3 beyond.

    The parameters are compliances, because the error is linear in them: c1 = 206265 / K1 arcsec/Nm with the
    stiffness K1 in Nm/rad.
    """

    name = "compliance"
    channels = frozenset({Channel.LOAD_TORQUE})
    about = Cause(
        title="wind-up by the load torque",
        subject="effects of torque",
        equation="sense sgn(T) (c1 min(|T|, T1) + c2 (|T| between T1 and T2) + c3 (|T| beyond T2)), c = "
        "206265 arcsec / K",
        signature="the error follows the torque; a mass off centre looks like a load order 1",
        consequence="the load sags under its weight and yields to process forces",
        remedy="measure the torque and compensate it; balance the load; a larger or stiffer gear",
        experiment="move or remove the mass: the wind-up changes, a load order remains",
        aliases=("load_order", "inertial_windup", "velocity_windup"),
        source="catalogue stiffness K1, K2, K3 of strain wave gears with torques T1, T2",
        size="about 16 arcsec/Nm in a size 20; 10-100 arcsec",
    )
    compensable = Compensable(
        True,
        "the load really has this error, if the torque is known on line (a torque sensor, or gravity from a "
        "model)",
    )
    shape = (
        Shape("torque1_nm", 0.1, 1e5, logarithmic=True),
        Shape("torque2_nm", 0.2, 1e5, logarithmic=True),
    )
    linear = ("c1_arcsec_per_nm", "c2_arcsec_per_nm", "c3_arcsec_per_nm")
    typical = {
        "c1_arcsec_per_nm": 15.9,
        "c2_arcsec_per_nm": 11.5,
        "c3_arcsec_per_nm": 9.0,
        "torque1_nm": 7.0,
        "torque2_nm": 25.0,
    }
    """Gear of size 20, ratio 50: K1, K2 and K3 are 1.3, 1.8 and 2.3e4 Nm/rad, T1 and T2 are 7 and 25 Nm."""

    c1_arcsec_per_nm: _Softness = Field(description="compliance up to T1: 206265 / K1, K1 in Nm/rad")
    c2_arcsec_per_nm: _Softness = Field(description="compliance from T1 to T2")
    c3_arcsec_per_nm: _Softness = Field(description="compliance beyond T2")
    torque1_nm: float = Field(gt=0, le=1e5, description="T1")
    torque2_nm: float = Field(gt=0, le=1e5, description="T2, above T1")
    sense: Literal[1, -1] = Field(
        1, description="1: a positive torque pushes the load forward; -1: the gear delivers it"
    )
    torque: TorqueChannel = "load_torque_nm"
    limit_nm: TorqueLimit = 1000.0

    @model_validator(mode="after")
    def _stiffens(self) -> Self:
        if not self.torque1_nm < self.torque2_nm:
            raise ValueError("T1 (torque1_nm) must be below T2 (torque2_nm)")
        return self

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields a linear spring, and springs that stiffen once or twice within the record's torque range."""
        largest = top(observations.motion, Channel.LOAD_TORQUE)
        if largest:
            beyond = (1e4, 2e4)
            once = ((share * largest, beyond[1]) for share in (0.2, 0.45, 0.7))
            for low, high in (beyond, *once, (0.4 * largest, 0.8 * largest)):
                yield cls(
                    c1_arcsec_per_nm=1.0, c2_arcsec_per_nm=1.0, c3_arcsec_per_nm=1.0,
                    torque1_nm=low, torque2_nm=high,
                )  # fmt: skip

    def implausible(self, observations: Observations) -> str:
        """Requires a spring that stiffens with torque; ignores zones that the record does not reach."""
        zones = [each for each in self.coefficients().tolist() if each != 0.0]
        stiffens = all(later <= SOFTER * earlier for earlier, later in pairwise(zones))
        return "" if stiffens else "a gear's spring does not soften with torque"

    @classmethod
    def unmeasured(cls, ratio: float) -> Effect:
        """Returns load order 1, because the torque of an off-centre mass has one period per load turn."""
        return LoadOrders(ratio=ratio, orders=orders_from([1]))

    def needs(self) -> frozenset[Channel]:
        return frozenset({Channel(self.torque)})

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the signed part of the torque that lies in each of the three zones, Nm, shape (n, 3)."""
        given = motion.channel(Channel(self.torque), self.name)
        torque = np.minimum(np.abs(given), self.limit_nm)
        low, high = self.torque1_nm, self.torque2_nm
        zones = np.column_stack(
            [
                np.minimum(torque, low),
                np.clip(torque - low, 0.0, high - low),
                np.maximum(torque - high, 0.0),
            ]
        )
        signed: FloatArray = self.sense * np.sign(given)[:, np.newaxis] * zones
        return signed

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with new compliances.

        If the compliances have a negative sum, the sense is reversed instead, because the sign of a torque is
        a convention.
        """
        values = np.asarray(coefficients, dtype=np.float64)
        turned = values.sum() < 0.0
        effect = super().fitted(-values if turned else values, shape)
        return effect.model_copy(update={"sense": -self.sense}) if turned else effect

    def at(self, motor_deg: float, moment: Moment) -> float:
        given = moment.measured[SLOT[Channel(self.torque)]]
        error = self._wind_up(min(abs(given), self.limit_nm))
        return self.sense * error if given >= 0.0 else -self.sense * error

    def _wind_up(self, torque: float) -> float:
        """Returns the wind-up at a non-negative torque, arcsec."""
        error = self.c1_arcsec_per_nm * min(torque, self.torque1_nm)
        if torque > self.torque1_nm:
            error += self.c2_arcsec_per_nm * min(torque - self.torque1_nm, self.torque2_nm - self.torque1_nm)
        if torque > self.torque2_nm:
            error += self.c3_arcsec_per_nm * (torque - self.torque2_nm)
        return error

    def bound_arcsec(self) -> float:
        low, high, most = self.torque1_nm, self.torque2_nm, self.limit_nm
        return (
            abs(self.c1_arcsec_per_nm) * min(most, low)
            + abs(self.c2_arcsec_per_nm) * min(max(most - low, 0.0), high - low)
            + abs(self.c3_arcsec_per_nm) * max(most - high, 0.0)
        )
