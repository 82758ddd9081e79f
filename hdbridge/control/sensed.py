"""What is known of the measured channels, cycle by cycle: what the effects are told, and what is lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hdbridge.axis.channels import BY_KEY
from hdbridge.effects.base import AT_REST, SLOT, Channel

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.drive.feedback import Feedback


class Sensed:
    """The channels of one axis; the last reading of each is held."""

    __slots__ = ("_channels", "_motor_torque", "_present", "_slots", "_values", "known", "torque_nm")

    def __init__(self, axis: AxisConfig) -> None:
        self.torque_nm = axis.motor_encoder.direction * axis.drive.rated_torque_nm / 1000.0
        """Motor torque for each per mille of 6077h, positive forward."""
        self._channels = tuple(BY_KEY[key] for key in axis.channels)
        self._slots = tuple(SLOT[each] for each in self._channels)
        self._motor_torque = SLOT[Channel.MOTOR_TORQUE]
        self.reset()

    def reset(self) -> None:
        """Nothing is known yet."""
        self.known: frozenset[Channel] = frozenset()
        """The channels that can be lost and are there."""
        self._present: tuple[bool, ...] = (False,) * len(self._channels)
        self._values = list(AT_REST)

    def take(self, feedback: Feedback) -> bool:
        """One cycle's readings; whether other channels are known than before."""
        for slot, reading in zip(self._slots, feedback.readings, strict=True):
            if reading is not None:
                self._values[slot] = reading
        present = tuple([reading is not None for reading in feedback.readings])
        if present == self._present:
            return False
        self._present = present
        pairs = zip(self._channels, present, strict=True)
        self.known = frozenset(channel for channel, there in pairs if there)
        return True

    def measured(self, feedback: Feedback) -> tuple[float, ...]:
        """What a `Moment` says of the measured channels in this cycle."""
        torque_nm = feedback.torque_permille * self.torque_nm
        if torque_nm == torque_nm:  # noqa: PLR0124 - not NaN, in a third of the time of isnan()
            self._values[self._motor_torque] = torque_nm
        return tuple(self._values)
