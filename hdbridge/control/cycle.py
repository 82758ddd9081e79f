"""Control cycle of a single axis for a bench: `BusCycle` with one axis, whose stops are raised as errors.

One `Cycle.tick` runs one period. A quick stop is completed before its `SafetyStop` is raised.
"""

from __future__ import annotations

from hdbridge.clock import Clock
from hdbridge.control.axiscycle import AxisCycle, Command, Target
from hdbridge.control.buscycle import LATE, WINDOW, BusCycle
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import InputError

__all__ = ["LATE", "WINDOW", "Command", "Cycle", "Feedback", "Target"]


class Cycle(BusCycle):
    """Runs the process image over a link, one `tick` per period.

    ``image`` provides the controlword (``image.power.go``) and the scaling; ``supervision`` holds the latch
    and the list of faults; ``monitor`` may be shared with the boot-up.
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        image: ProcessImage,
        supervision: Supervision,
        period_s: float,
        *,
        monitor: NetworkMonitor | None = None,
        stop_timeout_s: float = 1.0,
    ) -> None:
        super().__init__(link, clock, period_s)
        self._axis = AxisCycle(
            image, supervision, monitor=monitor, stop_timeout_s=stop_timeout_s, refused=(InputError,)
        )
        self.join(self._axis)
        self.stop_feedbacks: list[Feedback] = []
        """Feedback of the cycles that `tick` ran to complete the last quick stop."""

    def tick(self, command: Command = None) -> Feedback:
        """Runs one period and returns its feedback.

        ``command`` is the target in motor counts, None to repeat the last target, or a function of this
        cycle's feedback that returns either. It is used while the drive is enabled; before that, the target
        is the actual position, so that enabling causes no motion.

        Raises `SafetyStop` if the fault table requires it, and again at each call until
        ``supervision.reset()``. By then, the drive has reported the quick stop and the motor is at rest,
        the quick stop has timed out, or no RPDO is sent any more (`Reaction.LATCH`). Errors of ``command``
        other than `InputError` propagate; the caller must then stop the axis.
        """
        axis = self._axis
        supervision = axis.supervision
        if supervision.stop is not None:
            raise supervision.error()
        if axis.silent:
            axis.begin()
        axis.command = command
        self.exchange()
        if supervision.stop is None:
            return axis.feedback
        self.stop_feedbacks = [axis.feedback]
        while axis.stopping:
            self.exchange()
            self.stop_feedbacks.append(axis.feedback)
        stop = axis.stopped
        assert stop is not None
        raise stop
