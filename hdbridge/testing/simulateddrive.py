"""Simulated drive for use in tests."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any, Final

import can

from hdbridge.clock import Clock
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.testing.arguments import check_number, check_type
from hdbridge.testing.faulttable import FAULTS, Reach, find
from hdbridge.testing.line import LOCKSTEP, Line, Settings, open_line
from hdbridge.testing.watched import Event, Fault, Frame, Trigger, TrueState, WatchedDrive, words

POLL_S: Final = 0.005


class DriveTime:
    """Drive time with the interface of the module ``time``, which provides all other names.

    In real time, it is the module's own time. In lockstep, ``sleep`` runs the simulation for that time and
    returns at once. ``monkeypatch.setattr(program, "time", drive.time)`` makes a program use it.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._offset_s = time.time() - clock.now()

    def monotonic(self) -> float:
        """Returns seconds since an arbitrary moment."""
        return self._clock.now()

    perf_counter = monotonic

    def time(self) -> float:
        """Returns seconds since 1970."""
        return self._clock.now() + self._offset_s

    def monotonic_ns(self) -> int:
        """Returns nanoseconds since an arbitrary moment."""
        return round(1e9 * self._clock.now())

    perf_counter_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        """Waits for this duration of drive time."""
        self._clock.sleep_until(self._clock.now() + seconds)

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


class SimulatedDrive:
    """CiA-402 drive with an axis on a bus, created by `simulated_drive` and the fixture ``hdbridge_drive``.

    A program addresses it by ``interface`` and ``channel``, which it passes to python-can, and ``node_id``.
    """

    def __init__(
        self, settings: Settings, node: WatchedDrive, line: Line, failures: Sequence[HdbridgeError]
    ) -> None:
        self._settings = settings
        self._node = node
        self._line = line
        self._clock = line.clock
        self._reach = Reach(node, line.opened, line.port, str(line.choice))
        self._failures = failures
        self.interface: Final = line.interface
        """Interface name for ``can.Bus``."""
        self.channel: Final = line.channel
        """Channel for ``can.Bus``."""
        self.in_process: Final = settings.bus.in_process
        """True if the bus is accessible only to this process; if False, a separate program can be the
        master."""
        self.lockstep: Final = settings.bus.interface == LOCKSTEP
        """True if time passes only while the program waits."""
        self.node_id: Final = node.node_id
        self.eds_path: Final = settings.axis.eds_path
        """EDS of the drive."""
        self.truth_path: Final = settings.truth_path
        """Description of the axis: the profile's twin.yaml or truth.yaml."""
        self.motor_counts_per_turn: Final = node.nameplate.motor_counts_per_turn
        self.load_counts_per_turn: Final = node.nameplate.load_counts_per_turn
        self.ratio: Final = node.ratio
        """Motor turns per load turn."""
        self.time: Final = DriveTime(line.clock)
        """Drive time, with the interface of the module ``time``."""

    def __repr__(self) -> str:
        name, bus = self._settings.truth.name, self._settings.bus
        return f"<simulated drive {self.node_id}, axis {name!r}, on {bus}: {self.state}>"

    # ---------------------------------------------------------------- true state

    @property
    def truth(self) -> TrueState:
        """Current true angles of motor and load."""
        with self._node.lock:
            return self._node.true_state()

    @property
    def trace(self) -> tuple[TrueState, ...]:
        """True angles after every period of the drive (60C2h) since its creation; the newest 250,000."""
        with self._node.lock:
            return tuple(self._node.history.trace)

    @property
    def state(self) -> str:
        """Power state of CiA 402 as text, such as ``operation enabled`` or ``fault``."""
        return words(self._node.firmware.state.name)

    @property
    def nmt_state(self) -> str:
        """NMT state as text, such as ``operational``."""
        return words(self._node.nmt.name)

    # ---------------------------------------------------------------- history

    @property
    def log(self) -> tuple[Event, ...]:
        """Events in chronological order: states, EMCY, requested faults; the newest 10,000."""
        with self._node.lock:
            return tuple(self._node.history.events)

    @property
    def emergencies(self) -> tuple[int, ...]:
        """Codes of the EMCY messages that the drive has sent, without those that end an error."""
        codes = (int(each.text[:4], 16) for each in self.log if each.kind == "emcy")
        return tuple(code for code in codes if code)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames sent and received by the drive; the newest 1,000."""
        with self._node.lock:
            return tuple(self._node.history.frames)

    def note(self, text: str) -> None:
        """Adds a note of the test to the log; raises `InputError` if it is not text."""
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        check_type("the note", text, str, "text")
        self._node.note("note", text)

    def report(self) -> str:
        """Returns the end of the log, the last frames and the true angles, as text."""
        with self._node.lock:
            return f"{self!r}\n{self._node.history.report()}"

    # ---------------------------------------------------------------- faults

    @property
    def faults(self) -> Mapping[str, str]:
        """Description of each fault, by its name."""
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
        """Causes a fault at once, after ``after_s`` of drive time, or when the load passes ``beyond_deg``.

        It ends ``for_s`` after it began, at the end of a ``with`` block, or by ``.end()``. Raises
        `InputError` if the fault is impossible on this bus, and for an unknown name or argument, with the
        most similar valid one.
        """
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        row = find(name)
        checked = row.checked(arguments)
        check_number(f"fault '{name}': after_s", after_s, 0.0)
        if for_s is not None:
            check_number(f"fault '{name}': for_s", for_s, 0.0)
        if beyond_deg is not None:
            check_number(f"fault '{name}': beyond_deg", beyond_deg)
        if after_s and beyond_deg is not None:
            raise InputError(f"fault '{name}': after_s and beyond_deg are both given; expected one of them")
        self._check()
        row.check(self._reach, checked)
        made = Fault(name, checked)
        self._node.schedule(
            made, lambda: row.begin(self._reach, checked), Trigger(after_s, beyond_deg), for_s
        )
        if self.lockstep:
            for node in self._line.nodes:  # frames from another node reach the drives as well
                node.poll(self._clock.now())
        return made

    # ---------------------------------------------------------------- time, and the bus

    @property
    def now(self) -> float:
        """Drive time since its creation, s, as in ``log`` and ``trace``."""
        return self._node.time_s

    def sleep(self, seconds: float) -> None:
        """Runs the drive for this time; raises `InputError` for a time that is not a number of at least 0."""
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        check_number("the time to sleep, in seconds,", seconds, 0.0)
        self.time.sleep(seconds)
        self._check()

    def wait_until(self, condition: Callable[[], object], timeout_s: float = 5.0, what: str = "it") -> None:
        """Runs the drive until a condition is true; raises `TimeoutError` with the log.

        Raises `InputError` for a condition that cannot be called, and an invalid time-out.
        """
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        check_type("the condition", condition, Callable, "a function without arguments")  # type: ignore[arg-type]
        check_number("timeout_s", timeout_s, 0.0)
        end_s = self._clock.now() + timeout_s
        while not condition():
            if self._clock.now() >= end_s:
                raise TimeoutError(f"{what} did not occur in {timeout_s:g} s\n{self.report()}")
            self.sleep(POLL_S)

    def open_bus(self, **options: Any) -> can.BusABC:
        """Opens the program's end of the bus: ``can.Bus`` with ``interface`` and ``channel``."""
        return can.Bus(interface=self.interface, channel=self.channel, ignore_config=True, **options)

    def _check(self) -> None:
        """Raises the error that ended the drive."""
        __tracebackhide__ = True  # hides this frame, so that pytest shows the test's line
        if self._failures:
            raise self._failures[0]


@contextmanager
def simulated_drive(
    profile: str | Path = "demo",
    *,
    bus: str = "virtual",
    seed: int = 0,
    truth: str | Path | None = None,
    folder: str | Path | None = None,
    beside: SimulatedDrive | None = None,
    firmware: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[SimulatedDrive]:
    """Yields a simulated drive for the duration of the block.

    ``profile`` is a folder with an axis.yaml, or a bundled profile (``article``, ``demo``), relative to
    ``folder``. ``bus`` is ``virtual`` (this process, in real time), ``lockstep`` (this process, one thread,
    time passes only while the program waits) or ``INTERFACE:CHANNEL`` of python-can, for programs of any
    process. ``truth`` replaces the profile's twin.yaml or truth.yaml. The same truth and seed give the same
    axis, and in lockstep the same frames. ``beside`` is another drive on the same bus; their node ids must
    differ. While another test has a drive on a bus of the computer, this function waits. ``firmware`` sets
    keys of the truth file's section of that name, such as ``{"controlword": "level"}``.

    Raises a one-line `InputError` or `BusError`.
    """
    for what, value, kinds, expected in (
        ("profile", profile, (str, Path), "the name or the folder of a profile"),
        ("bus", bus, str, "its name, as text"),
        ("truth", truth, (str, Path, NoneType), "the path of a truth file"),
        ("folder", folder, (str, Path, NoneType), "a path"),
        ("beside", beside, (SimulatedDrive, NoneType), "another simulated drive"),
        ("firmware", firmware, Mapping, "a mapping of keys to values"),
    ):
        check_type(what, value, kinds, expected)
    settings = Settings.load(
        profile, bus if beside is None else str(beside._line.choice), seed, truth, folder, firmware
    )
    with ExitStack() as stack:
        line = beside._line if beside is not None else stack.enter_context(open_line(settings.bus))
        node, failures = stack.enter_context(line.drive(settings))
        drive = SimulatedDrive(settings, node, line, failures)
        yield drive
        drive._check()
