"""The simulated drive as a test has it in hand."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final
from uuid import uuid4

import can

from hdbridge.axis.config import BusConfig
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.drive.interfacelock import interface_lock
from hdbridge.drive.link import open_bus
from hdbridge.errors import BusInUseError, HdbridgeError, InputError
from hdbridge.sim.run import run
from hdbridge.testing.faulttable import FAULTS, Reach, find
from hdbridge.testing.history import Event, TrueState
from hdbridge.testing.port import INTERFACE, Port, StallingClock
from hdbridge.testing.settings import LOCKSTEP, BusChoice, Settings
from hdbridge.testing.watched import Fault, WatchedDrive, When, words

LONGEST_WAIT_S: Final = 0.005
"""In real time: how long the drive may not notice that a fault is wanted."""
LONGEST_TURN_S: Final = 600.0
"""How long a bus of the machine is waited for, that other tests use."""
POLL_S: Final = 0.005


class DriveTime:
    """The drive's time in the shape of the module ``time``; what is not here is that module's.

    In real time it is the module's own time. In lockstep a ``sleep`` lets the drive run for so long and
    returns at once. ``monkeypatch.setattr(program, "time", drive.time)`` lets a program live by it.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._offset_s = time.time() - clock.now()

    def monotonic(self) -> float:
        """Seconds since some moment."""
        return self._clock.now()

    perf_counter = monotonic

    def time(self) -> float:
        """Seconds since 1970."""
        return self._clock.now() + self._offset_s

    def monotonic_ns(self) -> int:
        """Nanoseconds since some moment."""
        return round(1e9 * self._clock.now())

    perf_counter_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        """Wait."""
        self._clock.sleep_until(self._clock.now() + seconds)

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


@dataclass(frozen=True)
class _Where:
    """How a program reaches the drive."""

    interface: str
    channel: str


class SimulatedDrive:
    """A CiA-402 drive with an axis on a bus. `simulated_drive` and the fixture ``hdbridge_drive`` make it.

    A program reaches it by ``interface`` and ``channel``, which it hands to python-can, and ``node_id``.
    """

    def __init__(
        self, settings: Settings, node: WatchedDrive, where: _Where, clock: Clock, reach: Reach
    ) -> None:
        self._settings = settings
        self._node = node
        self._clock = clock
        self._reach = reach
        self._failure: HdbridgeError | None = None
        self.interface: Final = where.interface
        """For ``can.Bus``: what python-can calls it."""
        self.channel: Final = where.channel
        """For ``can.Bus``."""
        self.in_process: Final = settings.bus.in_process
        """Whether only this process reaches the bus; else a program of its own can be the master."""
        self.lockstep: Final = settings.bus.interface == LOCKSTEP
        """Whether time passes only while the program waits."""
        self.node_id: Final = node.node_id
        self.eds_path: Final = settings.axis.eds_path
        """The EDS of the drive."""
        self.truth_path: Final = settings.truth_path
        """What the axis is like: the profile's twin.yaml or truth.yaml."""
        self.motor_counts_per_turn: Final = node.nameplate.motor_counts_per_turn
        self.load_counts_per_turn: Final = node.nameplate.load_counts_per_turn
        self.ratio: Final = node.ratio
        """Motor turns per load turn."""
        self.time: Final = DriveTime(clock)
        """The drive's time, in the shape of the module ``time``."""

    def __repr__(self) -> str:
        name, bus = self._settings.truth.name, self._settings.bus
        return f"<simulated drive {self.node_id}, axis {name!r}, on {bus}: {self.state}>"

    # ---------------------------------------------------------------- what is true

    @property
    def truth(self) -> TrueState:
        """The true angles now."""
        with self._node.lock:
            return self._node.true_state()

    @property
    def trace(self) -> tuple[TrueState, ...]:
        """The true angles after every period of the drive (60C2h) since it was made; the newest 250,000."""
        with self._node.lock:
            return tuple(self._node.history.trace)

    @property
    def state(self) -> str:
        """The power state of CiA 402 in words, such as ``operation enabled`` or ``fault``."""
        return words(self._node.firmware.state.name)

    @property
    def nmt_state(self) -> str:
        """The NMT state in words, such as ``operational``."""
        return words(self._node.nmt.name)

    # ---------------------------------------------------------------- what happened

    @property
    def log(self) -> tuple[Event, ...]:
        """What happened, in the order of time: states, EMCY, faults asked for; the newest 10,000."""
        with self._node.lock:
            return tuple(self._node.history.events)

    @property
    def emergencies(self) -> tuple[int, ...]:
        """The codes of the EMCY messages that the drive has sent, without those that end an error."""
        codes = (int(each.text[:4], 16) for each in self.log if each.kind == "emcy")
        return tuple(code for code in codes if code)

    def note(self, text: str) -> None:
        """Put a line of the test's own into the log."""
        self._node.note("note", text)

    def report(self) -> str:
        """The end of the log, the last frames and the true angles, for people."""
        with self._node.lock:
            return f"{self!r}\n{self._node.history.report()}"

    # ---------------------------------------------------------------- faults

    @property
    def faults(self) -> Mapping[str, str]:
        """What each fault does, by its name."""
        return MappingProxyType({row.name: row.what for row in FAULTS.values()})

    def fault(
        self,
        name: str,
        *,
        after_s: float = 0.0,
        beyond_deg: float | None = None,
        for_s: float | None = None,
        **arguments: float,
    ) -> Fault:
        """Make a fault: now, after a time (the drive's), or once the load passes an angle.

        It ends ``for_s`` after it began, with the block where it is used as a context manager, or by
        ``.end()``. InputError for a name or an argument that there is not, with the nearest right one, and
        where this bus has nothing to make it with.
        """
        __tracebackhide__ = True  # pytest shows the test's line
        row = find(name)
        checked = row.checked(arguments)
        for what, value in (("after_s", after_s), ("for_s", for_s), ("beyond_deg", beyond_deg)):
            if value is not None and not (
                abs(value) < float("inf") and (value >= 0.0 or what == "beyond_deg")
            ):
                raise InputError(f"fault '{name}': {what} is {value!r}; expected a number of at least 0")
        if after_s and beyond_deg is not None:
            raise InputError(f"fault '{name}': after_s and beyond_deg are both given; expected one of them")
        self._check()
        row.check(self._reach, checked)
        made = Fault(name, checked)
        self._node.make(made, lambda: row.begin(self._reach, checked), When(after_s, beyond_deg), for_s)
        if self.lockstep:
            self._node.poll(self._clock.now())  # frames of another node reach it as well
        return made

    # ---------------------------------------------------------------- time, and the bus

    @property
    def now(self) -> float:
        """Seconds of the drive's time since it was made: that of ``log`` and ``trace``."""
        return self._node.time_s

    def sleep(self, seconds: float) -> None:
        """Let the drive run for so long."""
        self.time.sleep(seconds)
        self._check()

    def wait_until(self, condition: Callable[[], object], timeout_s: float = 5.0, what: str = "it") -> None:
        """Let the drive run until a condition is true; TimeoutError with the log after ``timeout_s``."""
        __tracebackhide__ = True  # pytest shows the test's line
        end_s = self._clock.now() + timeout_s
        while not condition():
            if self._clock.now() >= end_s:
                raise TimeoutError(f"{what} did not come about in {timeout_s:g} s\n{self.report()}")
            self.sleep(POLL_S)

    def open_bus(self, **options: Any) -> can.BusABC:
        """Open the program's end of the bus: ``can.Bus`` with ``interface`` and ``channel``."""
        return can.Bus(interface=self.interface, channel=self.channel, ignore_config=True, **options)

    def _check(self) -> None:
        """Raise what ended the drive."""
        __tracebackhide__ = True  # pytest shows the test's line
        if self._failure is not None:
            raise self._failure


@contextmanager
def simulated_drive(
    profile: str = "demo",
    *,
    bus: str = "virtual",
    seed: int = 0,
    truth: str | Path | None = None,
    folder: Path | None = None,
) -> Iterator[SimulatedDrive]:
    """A simulated drive as long as the block lasts.

    ``profile`` is a folder with an axis.yaml, or a bundled profile (``article``, ``demo``), relative to
    ``folder``. ``bus`` is ``virtual`` (this process, in real time), ``lockstep`` (this process, one thread,
    time passes only while the program waits) or ``INTERFACE:CHANNEL`` of python-can, for programs of any
    process. ``truth`` replaces the profile's twin.yaml or truth.yaml. The same truth and seed give the same
    axis; in lockstep the same frames. While another test has a drive on a bus of the machine, this one waits.
    InputError, BusError in one line.
    """
    settings = Settings.load(profile, bus, seed, truth, folder)
    maker = _in_lockstep if settings.bus.interface == LOCKSTEP else _in_real_time
    with maker(settings) as drive:
        yield drive


@contextmanager
def _in_lockstep(settings: Settings) -> Iterator[SimulatedDrive]:
    clock = StallingClock()
    channel = f"hdbridge-{uuid4()}"
    opened = _virtual(channel)
    with opened() as bus:
        node = _node(settings, bus, clock)
        node.poll(clock.now())
        clock.nodes.append(node)
        with Port(channel, clock, node.note) as port:
            reach = Reach(node, opened, port, str(settings.bus))
            yield SimulatedDrive(settings, node, _Where(INTERFACE, channel), clock, reach)


@contextmanager
def _in_real_time(settings: Settings) -> Iterator[SimulatedDrive]:
    clock = MonotonicClock()
    with ExitStack() as stack:
        if settings.bus.in_process:
            channel = f"hdbridge-{uuid4()}"
            opened = _virtual(channel)
        else:
            channel = settings.bus.channel
            stack.enter_context(_turn(settings.bus))
            opened = _real(settings.bus)
        bus = stack.enter_context(opened())
        node = _node(settings, bus, clock)
        port = None
        if settings.bus.in_process:
            port = stack.enter_context(Port(channel, None, node.note))
        where = _Where(INTERFACE if port is not None else settings.bus.interface, channel)
        drive = SimulatedDrive(settings, node, where, clock, Reach(node, opened, port, str(settings.bus)))
        node.poll(clock.now())
        stack.enter_context(_served(drive, bus, node, clock))
        yield drive


@contextmanager
def _served(drive: SimulatedDrive, bus: can.BusABC, node: WatchedDrive, clock: Clock) -> Iterator[None]:
    """A thread in which the drive lives."""
    ended = threading.Event()

    def serve() -> None:
        try:
            run(bus, node, clock, ended.is_set, LONGEST_WAIT_S)
        except HdbridgeError as error:
            drive._failure = error
            node.note("bus", str(error))

    thread = threading.Thread(target=serve, name="simulated drive", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _node(settings: Settings, bus: can.BusABC, clock: Clock) -> WatchedDrive:
    axis = settings.axis
    return WatchedDrive(bus, settings.truth, settings.seed, axis.eds_path, axis.drive.node_id, clock)


def _virtual(channel: str) -> Callable[[], AbstractContextManager[can.BusABC]]:
    return lambda: can.Bus(interface="virtual", channel=channel, ignore_config=True)


def _real(choice: BusChoice) -> Callable[[], AbstractContextManager[can.BusABC]]:
    settings = BusConfig(interface=choice.interface, channel=choice.channel, bitrate_bps=None)
    return lambda: open_bus(settings, shared=True)


@contextmanager
def _turn(choice: BusChoice) -> Iterator[None]:
    """Wait until no other test of this machine has a drive on the bus: workers of pytest-xdist share it."""
    folder = Path(tempfile.gettempdir())
    end_s = time.monotonic() + LONGEST_TURN_S
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(interface_lock(f"testing-{choice.interface}", choice.channel, folder))
                break
            except BusInUseError:
                if time.monotonic() > end_s:
                    raise
            time.sleep(0.05)
        yield
