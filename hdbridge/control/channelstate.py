"""Moments of one axis, cycle by cycle: motion of the command, measured channels, and lost channels."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hdbridge.axis.channels import BY_KEY
from hdbridge.axis.effects.kinematics import Observer
from hdbridge.axis.effects.motion import AT_REST, SLOT, Channel, Moment

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.control.compensation import Compensation
    from hdbridge.control.switchover import Correction
    from hdbridge.drive.feedback import Feedback


class ChannelState:
    """Channels of one axis for its effects; the last reading of each measured channel is held."""

    def __init__(self, axis: AxisConfig) -> None:
        self.torque_nm = axis.motor_encoder.direction * axis.drive.rated_torque_nm / 1000.0
        """Motor torque for one unit (per mille) of 6077h, positive forward; Nm."""
        self._channels = tuple(BY_KEY[key] for key in axis.channels)
        self._slots = tuple(SLOT[each] for each in self._channels)
        self._motor_torque = SLOT[Channel.MOTOR_TORQUE]
        self._ratio = axis.gear.ratio
        self._present: tuple[bool, ...] | None = None
        self._values = list(AT_REST)
        self.restart()

    def restart(self) -> None:
        """Forgets the motion of the command."""
        self._observer = Observer()

    def begin(self, feedback: Feedback, motor_deg: float, compensation: Compensation | Correction) -> None:
        """Starts a compensation at rest at a motor angle, with the readings of this cycle only."""
        self.restart()
        self._present, self._values = None, list(AT_REST)
        self._take(feedback, compensation)
        measured = self._measured(feedback)
        moment = Moment(time_s=feedback.time_s, measured=measured, load_deg=motor_deg / self._ratio)
        compensation.reset(motor_deg, moment)

    def moment(self, feedback: Feedback, load_deg: float, compensation: Compensation | Correction) -> Moment:
        """Returns the moment of a control cycle with this load target; must be called once per cycle.

        Passes a change of the known channels to the compensation.
        """
        if self._channels:
            self._take(feedback, compensation)
        return self._observer.moment(
            self._ratio * load_deg, feedback.time_s, measured=self._measured(feedback), load_deg=load_deg
        )

    def _take(self, feedback: Feedback, compensation: Compensation | Correction) -> None:
        """Stores one cycle's readings."""
        for slot, reading in zip(self._slots, feedback.readings, strict=True):
            if reading is not None:
                self._values[slot] = reading
        present = tuple([reading is not None for reading in feedback.readings])
        if present != self._present:
            self._present = present
            pairs = zip(self._channels, present, strict=True)
            compensation.set_known_channels(frozenset(channel for channel, there in pairs if there))

    def _measured(self, feedback: Feedback) -> tuple[float, ...]:
        """Returns the measured channels of this cycle for a `Moment`."""
        torque_nm = feedback.torque_permille * self.torque_nm
        if torque_nm == torque_nm:  # noqa: PLR0124 - not NaN, in a third of the time of isnan()
            self._values[self._motor_torque] = torque_nm
        return tuple(self._values)
