"""Measured channels, cycle by cycle: values for the effects, and lost channels."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hdbridge.axis.channels import BY_KEY
from hdbridge.axis.effects.motion import AT_REST, SLOT, Channel

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.drive.feedback import Feedback


class ChannelState:
    """Channels of one axis; the last reading of each is held."""

    __slots__ = ("_channels", "_motor_torque", "_present", "_slots", "_values", "known", "torque_nm")

    def __init__(self, axis: AxisConfig) -> None:
        self.torque_nm = axis.motor_encoder.direction * axis.drive.rated_torque_nm / 1000.0
        """Motor torque for one unit (per mille) of 6077h, positive forward; Nm."""
        self._channels = tuple(BY_KEY[key] for key in axis.channels)
        self._slots = tuple(SLOT[each] for each in self._channels)
        self._motor_torque = SLOT[Channel.MOTOR_TORQUE]
        self.reset()

    def reset(self) -> None:
        """Forgets all readings."""
        self.known: frozenset[Channel] = frozenset()
        """Channels with their own sensors that have a current reading."""
        self._present: tuple[bool, ...] = (False,) * len(self._channels)
        self._values = list(AT_REST)

    def take(self, feedback: Feedback) -> bool:
        """Stores one cycle's readings; returns True if the known channels changed."""
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
        """Returns the measured channels of this cycle for a `Moment`."""
        torque_nm = feedback.torque_permille * self.torque_nm
        if torque_nm == torque_nm:  # noqa: PLR0124 - not NaN, in a third of the time of isnan()
            self._values[self._motor_torque] = torque_nm
        return tuple(self._values)
