"""Bus of simulated drives, in lockstep or in real time, and the settings of a drive."""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self
from uuid import uuid4

import can
from pydantic import ValidationError

from hdbridge.axis import AxisConfig
from hdbridge.axis.config import BusConfig
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.run import run
from hdbridge.drive.interfacelock import InterfaceLock
from hdbridge.drive.link import open_bus
from hdbridge.errors import BusInUseError, HdbridgeError, InputError
from hdbridge.files.expectation import nearest
from hdbridge.files.profile import Profile
from hdbridge.sim.truth import Truth
from hdbridge.strictness import complaint
from hdbridge.testing.arguments import check_number
from hdbridge.testing.port import INTERFACE, Port, StallingClock
from hdbridge.testing.watched import WatchedDrive

VIRTUAL, LOCKSTEP = "virtual", "lockstep"
EXAMPLES: Final = (VIRTUAL, LOCKSTEP, "socketcan:vcan0", "udp_multicast:239.74.163.2")
"""Examples of bus names."""


@dataclass(frozen=True)
class BusChoice:
    """Choice of bus: a bus within this process, or an interface of python-can with its channel."""

    interface: str
    channel: str = ""

    @property
    def in_process(self) -> bool:
        """True if the bus is accessible only to this process."""
        return self.interface in (VIRTUAL, LOCKSTEP)

    def __str__(self) -> str:
        return f"{self.interface}:{self.channel}" if self.channel else self.interface

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parses ``virtual``, ``lockstep`` or ``INTERFACE:CHANNEL``; raises `InputError` for others."""
        interface, colon, channel = text.partition(":")
        known = [each.partition(":")[0] for each in EXAMPLES]
        if interface in (VIRTUAL, LOCKSTEP) and not colon:
            return cls(interface)
        if interface and channel and interface not in (VIRTUAL, LOCKSTEP):
            return cls(interface, channel)
        close = nearest(interface, known)
        example = next((each for each in EXAMPLES if each.startswith(f"{close}:") or each == close), None)
        hint = f"; did you mean '{example}'?" if example else ""
        raise InputError(
            f"the bus {text!r}; expected {', '.join(EXAMPLES)} or another INTERFACE:CHANNEL{hint}"
        )


@dataclass(frozen=True)
class Settings:
    """Settings of one drive, loaded and checked."""

    axis: AxisConfig
    truth: Truth
    truth_path: Path
    seed: int
    bus: BusChoice

    @classmethod
    def load(
        cls,
        profile: str | Path,
        bus: str,
        seed: int,
        truth: str | Path | None = None,
        folder: str | Path | None = None,
        firmware: Mapping[str, Any] = MappingProxyType({}),
    ) -> Self:
        """Loads and checks the settings; raises a one-line `InputError`.

        ``folder`` is the base of relative paths, by default the working folder. Without ``truth``, the
        profile's ``twin.yaml`` is used if it exists, else its ``truth.yaml``. ``firmware`` contains keys of
        the truth file's section of that name.
        """
        folder = Path(folder or "")
        choice = BusChoice.parse(bus)
        check_number("the seed", seed, whole=True)
        files = Profile.find(str(profile), folder)
        axis = AxisConfig.load(files.axis)
        path = folder / truth if truth is not None else files.simulated
        if truth is None and not path.is_file():
            raise InputError(
                f"{path}: no such file, and no twin.yaml in the same folder: the simulated axis is not "
                "defined; make a twin of the axis, or name a truth file"
            )
        known = Truth.load(path)
        behaviour = _behaviour({**known.firmware.model_dump(), **firmware})
        return cls(axis, known.model_copy(update={"firmware": behaviour}), path, seed, choice)


def _behaviour(keys: Mapping[str, Any]) -> Behaviour:
    try:
        return Behaviour.model_validate(keys)
    except ValidationError as error:
        known = ", ".join(Behaviour.model_fields)
        raise InputError(f"firmware: {complaint(error.errors()[0])}; keys are {known}") from error


LONGEST_WAIT_S: Final = 0.005
"""Maximum delay of a requested fault on a bus in real time; s."""
MAX_BUS_WAIT_S: Final = 600.0
"""Maximum wait for a bus of the computer that other tests are using; s."""

_IN_USE: Final[dict[str, int]] = {}
"""Buses of the computer on which this process has a drive; the value is the thread that created it."""


@dataclass
class Line:
    """Bus with its clock and its drives."""

    choice: BusChoice
    interface: str
    """Name of the python-can interface that the program opens, together with the channel."""
    channel: str
    clock: Clock
    opened: Callable[[], AbstractContextManager[can.BusABC]]
    """Opens the bus for a node."""
    port: Port | None = None
    """CAN interface of the program under test; None if the program is in another process."""
    nodes: list[WatchedDrive] = field(default_factory=list)

    def note(self, kind: str, text: str) -> None:
        """Adds an event to every drive's history."""
        for node in self.nodes:
            node.note(kind, text)

    @contextmanager
    def drive(self, settings: Settings) -> Iterator[tuple[WatchedDrive, list[HdbridgeError]]]:
        """Switches a drive on for the duration of the block; yields it and the list of errors that ended it.

        Raises `InputError` if the bus already has a drive with that node id.
        """
        axis = settings.axis
        node_id = axis.drive.node_id
        if any(node.node_id == node_id for node in self.nodes):
            raise InputError(
                f"{axis.path}: another simulated drive on this bus is node {node_id}; expected a free one"
            )
        with self.opened() as bus:
            source = axis.load_encoder.source.address
            node = WatchedDrive(
                bus, settings.truth, settings.seed, axis.eds_path, node_id, self.clock, source
            )
            self.nodes.append(node)
            try:
                node.poll(self.clock.now())
                with self._running(bus, node) as failures:
                    yield node, failures
            finally:
                self.nodes.remove(node)

    @contextmanager
    def _running(self, bus: can.BusABC, node: WatchedDrive) -> Iterator[list[HdbridgeError]]:
        """Runs the drive on the virtual clock, or in a thread."""
        if isinstance(self.clock, StallingClock):
            nodes = self.clock.nodes
            nodes.append(node)
            try:
                yield []
            finally:
                nodes.remove(node)
            return
        ended = threading.Event()
        failures: list[HdbridgeError] = []

        def serve() -> None:
            try:
                run(bus, node, self.clock, ended.is_set, LONGEST_WAIT_S)
            except HdbridgeError as error:
                failures.append(error)
                node.note("bus", str(error))

        thread = threading.Thread(target=serve, name=f"simulated drive {node.node_id}", daemon=True)
        thread.start()
        try:
            yield failures
        finally:
            ended.set()
            thread.join()


@contextmanager
def open_line(choice: BusChoice) -> Iterator[Line]:
    """Yields a bus for drives, waiting until it is free; raises `BusError` if it cannot be opened."""
    if not choice.in_process:
        settings = BusConfig(interface=choice.interface, channel=choice.channel, bitrate_bps=None)
        with _reserve(choice):
            yield Line(
                choice,
                choice.interface,
                choice.channel,
                MonotonicClock(),
                lambda: open_bus(settings, shared=True),
            )
        return
    channel = f"hdbridge-{uuid4()}"
    lockstep = StallingClock() if choice.interface == LOCKSTEP else None
    line = Line(
        choice,
        INTERFACE,
        channel,
        lockstep or MonotonicClock(),
        lambda: can.Bus(interface="virtual", channel=channel, ignore_config=True),
    )
    with Port(channel, lockstep, line.note) as line.port:
        yield line


@contextmanager
def _reserve(choice: BusChoice) -> Iterator[None]:
    """Reserves the bus; waits until no other test on this computer (pytest-xdist) has a drive on it."""
    name = str(choice)
    if _IN_USE.get(name) == threading.get_ident():
        raise InputError(
            f"{name}: this test already has a drive on this bus; put the second one beside it: "
            "simulated_drive(..., beside=drive)"
        )
    folder = Path(tempfile.gettempdir())
    end_s = time.monotonic() + MAX_BUS_WAIT_S
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(InterfaceLock(f"testing-{choice.interface}", choice.channel, folder))
                break
            except BusInUseError:
                if time.monotonic() > end_s:
                    raise
            time.sleep(0.05)
        _IN_USE[name] = threading.get_ident()
        try:
            yield
        finally:
            del _IN_USE[name]
