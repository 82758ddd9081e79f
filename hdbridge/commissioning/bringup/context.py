"""State shared by the checks of a bring-up: axis file, bus, drive, and results so far."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext

import can
from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig
from hdbridge.clock import Clock
from hdbridge.commissioning.bringup import TORQUE_PERCENT
from hdbridge.commissioning.bringup.slow import SlowAxis
from hdbridge.control.cycle import Feedback
from hdbridge.drive.drive import Drive
from hdbridge.drive.states import State

Connect = Callable[["AxisConfig"], AbstractContextManager[tuple["can.BusABC", Clock]]]
"""Opens an axis's bus and returns it with its clock."""
Interruptible = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Context that defers interrupts; the function that it yields reports if there was one."""


class BringUpContext(ExitStack):
    """One axis under examination; a context manager that leaves the drive off and the bus closed.

    ``load`` reads the axis file and ``connect`` opens its bus; both are checks, so they are passed as
    functions. ``torque_percent`` limits every motion, percent of the rated torque, in addition to the axis
    file's own limit. With ``force``, frames are sent even if another master is heard on the bus.
    """

    def __init__(
        self,
        load: Callable[[], AxisConfig],
        connect: Connect,
        *,
        torque_percent: float = TORQUE_PERCENT,
        force: bool = False,
        interruptible: Interruptible = lambda: nullcontext(lambda: False),
    ) -> None:
        super().__init__()
        self.load = load
        self.torque_percent = torque_percent
        self.interruptible = interruptible
        self.began_deg = 0.0
        """Motor angle before the axis was moved, degrees."""
        self.noise_arcsec = 0.0
        """Noise of the load encoder at rest, arcsec."""
        self.confirmed: set[str] = set()
        """Keys of the axis file that the drive's own objects confirm."""
        self.out: list[Feedback] = []
        """Feedback of the long forward move, and of the standstill at its end."""
        self.rest_begins = 0
        self._connect = connect
        self._force = force
        self._axis: AxisConfig | None = None
        self._od: ObjectDictionary | None = None
        self._drive: Drive | None = None

    def admit(self, axis: AxisConfig, od: ObjectDictionary) -> None:
        """Stores the axis file and the EDS after they have been read."""
        self._axis, self._od = axis, od

    def connect(self) -> None:
        """Opens the bus; sends nothing yet. Raises `BusError`."""
        bus, clock = self.enter_context(self._connect(self.axis))
        self._drive = self.enter_context(Drive(bus, self.axis, clock, self._od, force=self._force))

    @property
    def axis(self) -> AxisConfig:
        """The axis file."""
        assert self._axis is not None, "checks that need the files come after them"
        return self._axis

    @property
    def drive(self) -> Drive:
        """The drive, not necessarily booted."""
        assert self._drive is not None, "checks that need the bus come after it"
        return self._drive

    def boot(self) -> Drive:
        """Reboots the drive, resets a fault left by an earlier check, and returns it switched off."""
        report = self.drive.boot()
        if report.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            self.drive.fault_reset()
        return self.drive

    def slow(self, interrupted: Callable[[], bool]) -> SlowAxis:
        """Returns the axis for slow motion, freshly booted and still switched off."""
        return SlowAxis(self.boot(), self.torque_percent, interrupted)
