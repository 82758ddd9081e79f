"""Runs one axis in the control cycle: power on at standstill, motion, stop, power off."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from hdbridge.control.cycle import Command, Cycle
from hdbridge.drive.drive import Drive
from hdbridge.drive.feedback import ENABLE_TIMEOUT_S, STOP_TIMEOUT_S, Feedback
from hdbridge.drive.link import Link
from hdbridge.drive.standstill import Standstill
from hdbridge.drive.states import OFF, State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import HdbridgeError, TransitionError


class AxisRunner:
    """Axis whose power is on only inside `powered`, in the control cycle with full supervision.

    ``interrupted`` is called in each cycle from the power-on to the end of the motion, and stops the axis by
    returning True (KeyboardInterrupt). ``link`` replaces the drive's own link for the cycle.
    """

    def __init__(self, drive: Drive, interrupted: Callable[[], bool], link: Link | None = None) -> None:
        self.axis = drive.axis
        self.image = drive.image
        self.supervision = Supervision()
        self.cycle = Cycle(
            drive.link if link is None else link,
            drive.link.clock,
            drive.image,
            self.supervision,
            drive.axis.drive.cycle_s,
            monitor=drive.monitor,
        )
        self._drive = drive
        self._interrupted = interrupted

    @contextmanager
    def powered(self) -> Iterator[Feedback]:
        """Enables the drive at standstill and disables it at the end; yields the first feedback under power.

        On any failure, Ctrl-C included, the axis is stopped and the power switched off before the error
        propagates. Raises SafetyStop if the supervision stops the axis, and TransitionError if the drive
        does not reach 'operation enabled'.
        """
        self._drive.enable()
        self.cycle.restart()
        try:
            yield self._until_enabled()
            if self._running:
                self.image.power.go(State.SWITCH_ON_DISABLED)
                self._until_off()
        except BaseException:
            with suppress(HdbridgeError):
                self.brake()
            if self.supervision.stop is None or self.cycle.axes[0].confirmed:
                with suppress(HdbridgeError):
                    self._drive.disable()
            else:
                self._drive.power_off()
            raise
        self._drive.disable()

    def tick(self, command: Command = None) -> Feedback:
        """Runs one cycle, as `Cycle.tick`; raises KeyboardInterrupt if interrupted."""
        feedback = self.cycle.tick(command)
        if self._interrupted():
            raise KeyboardInterrupt
        return feedback

    def brake(self) -> None:
        """Quick-stops the axis unless it is already being stopped."""
        if self._running:
            self.stop()

    def stop(self) -> list[Feedback]:
        """Quick-stops the axis and runs cycles until the motor is at rest; returns their feedback."""
        axis, seen = self.cycle.axes[0], list[Feedback]()
        axis.quick_stop()
        while axis.stopping:
            seen.append(self.cycle.tick())
        return seen

    @property
    def _running(self) -> bool:
        """True if the drive is enabled or being enabled, and the supervision has not stopped it."""
        power = self.image.power
        return self.supervision.stop is None and State.OPERATION_ENABLED in (power.aim, power.state)

    def _until_enabled(self) -> Feedback:
        for _ in range(math.ceil(ENABLE_TIMEOUT_S / self.cycle.period_s)):
            feedback = self.tick()
            if self.image.power.state is State.OPERATION_ENABLED:
                return feedback
        raise TransitionError(
            f"the drive did not reach 'operation enabled' within {ENABLE_TIMEOUT_S:g} s, it is in "
            f"'{self.image.power.state.value}'; look at its enable input, its supply and its fault history"
        )

    def _until_off(self) -> None:
        """Runs cycles until the motor stands still without power, or until the time-out."""
        standstill = Standstill(self.axis)
        for _ in range(math.ceil(STOP_TIMEOUT_S / self.cycle.period_s)):
            feedback = self.cycle.tick()
            if standstill.take(feedback.motor_counts, feedback.time_s) and self.image.power.state in OFF:
                break
