"""SDO access to one axis's drive through the control process: boot, verify, prepare, home, read, write.

All methods block and run in worker threads. A drive serves one request at a time; a request that finds it
busy waits for `BUSY_S`. Other masters were listened for before the control process sent its first frame, so
nothing here listens for them.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hdbridge.axis import AxisConfig, Identity
from hdbridge.client import messages
from hdbridge.daemon.service.core import Arguments, Core
from hdbridge.daemon.service.relaybus import RelayBus
from hdbridge.drive.bootup import BootReport
from hdbridge.drive.drive import Drive, Positions
from hdbridge.drive.states import State
from hdbridge.drive.values import Object, Value, find_object
from hdbridge.errors import InputError, RefusedError

BUSY_S = 3.0
"""Maximum wait for a drive that is busy with another request."""


class Commissioning:
    """The drive of one axis, as the service sees it."""

    def __init__(self, axis: AxisConfig, core: Core) -> None:
        source = axis.load_encoder.source.node
        nodes = {axis.drive.node_id} | ({source} if source is not None else set())
        self.bus = RelayBus(core, nodes, f"{axis.bus.interface}:{axis.bus.channel}")
        self._drive = Drive(self.bus, axis, core.timing.clock, force=True)
        self._busy = threading.Lock()
        self._doing = ""

    @property
    def report(self) -> BootReport | None:
        """Result of the verification; None before."""
        return self._drive.report

    @property
    def identity(self) -> Identity:
        """Identity that the drive reported, else the one that the axis file expects."""
        return self._drive.identity

    def verify(self) -> Arguments:
        """Boots the drive and compares it with the axis file; power is off afterwards.

        Raises as `Drive.boot` does.
        """
        with self._asked("it is being booted"):
            self._drive.boot()
            return self._seeds(self._drive.read_positions())

    def take_over(self) -> None:
        """Compares a drive under control of the control process with the axis file; writes nothing."""
        with self._asked("it is being compared with its axis file"):
            self._drive.take_over()

    def abandon_homing(self) -> None:
        """Stops a drive that was lent to an earlier service, and switches its power off."""
        with self._asked("it is being stopped"):
            if self._drive.state() is State.OPERATION_ENABLED:
                self._drive.quick_stop()
            self._drive.disable()

    def prepare(self) -> Arguments:
        """Prepares the drive to be enabled by the control process. Raises as `Drive.enable` does."""
        with self._asked("it is being made ready"):
            return self._seeds(self._drive.prepare())

    def rest(self) -> None:
        """Ends the drive's monitoring of the master; power is off already."""
        with self._asked("it is being switched off"):
            self._drive.disable()

    def clear_fault(self) -> None:
        """Resets a fault of the drive, while the control process sends it nothing."""
        with self._asked("its fault is being reset"):
            if self._drive.state() is State.FAULT:
                self._drive.fault_reset()

    def home(self, run: messages.Home) -> tuple[Positions, Arguments]:
        """Homes a drive that the control process has lent; power is off afterwards.

        Raises as `Drive.home` does; even then the axis stops and its power is off, if the drive answers.
        """
        with self._asked("it is being homed"):
            try:
                positions = self._drive.home(**run.model_dump())
            finally:
                self._drive.disable()
            return positions, self._seeds(positions)

    def interrupt(self, reason: str) -> None:
        """Interrupts the present request with this reason; a homing axis stops. Thread-safe."""
        if self._busy.locked():
            self.bus.interrupt(reason)

    def read(self, object_: str) -> tuple[Object, Value]:
        """Reads an object by its number or its EDS name."""
        wanted = find_object(object_, self._drive.sdo.od)
        if not wanted.readable:
            raise InputError(f"{wanted}: is write-only by the EDS")
        with self._asked(f"{object_} is being read"):
            return wanted, wanted.decode(self._drive.sdo.read_bytes(wanted.index, wanted.sub))

    def write(self, object_: str, text: str) -> Object:
        """Writes an object; the control process refuses this while the axis is enabled."""
        wanted = find_object(object_, self._drive.sdo.od)
        if not wanted.writable:
            raise InputError(f"{wanted}: can only be read, by the EDS")
        data = wanted.encode(text)
        with self._asked(f"{object_} is being written"):
            self._drive.sdo.write_bytes(wanted.index, wanted.sub, data)
        return wanted

    def seeds(self) -> Arguments:
        """Reads the drive's present position and statusword."""
        with self._asked("its position is being read"):
            return self._seeds(self._drive.read_positions())

    def close(self) -> None:
        """Closes the relay bus; the drive stays as it is."""
        self.bus.shutdown()

    def _seeds(self, positions: Positions) -> Arguments:
        """Returns counts and statusword as arguments of VERIFIED, UNLEND and ENABLE."""
        self._drive.state()
        statusword = self._drive.image.statusword or 0
        return Arguments(i=positions.motor_counts, j=positions.load_counts, k=statusword)

    @contextmanager
    def _asked(self, doing: str) -> Iterator[None]:
        if not self._busy.acquire(timeout=BUSY_S):
            raise RefusedError(f"the drive of axis '{self._drive.axis.name}' is busy: {self._doing}")
        self._doing = doing
        self.bus.begin()
        try:
            yield
        finally:
            self._busy.release()
