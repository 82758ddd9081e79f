"""Simulated drive that keeps its history and causes faults on request."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import can

from hdbridge.canframe import DataFrame
from hdbridge.clock import Clock
from hdbridge.device.nameplate import LOAD_OBJECT
from hdbridge.device.node import DriveNode
from hdbridge.drive.emergencies import error_name
from hdbridge.sim.lockstep import nameplate_of
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG

EVENTS: Final = 10_000
FRAMES: Final = 1_000
PERIODS: Final = 250_000
"""Maximum numbers of events, frames and periods kept; older ones are dropped. The periods cover 1000 s at 4
ms."""

SHOWN_EVENTS: Final = 40
SHOWN_FRAMES: Final = 12
"""Numbers of events and frames shown in the report of a failed test."""


@dataclass(frozen=True)
class Event:
    """Event at the drive time ``time_s``, with a ``kind`` and a text.

    Kinds: ``state`` (power states of CiA 402), ``nmt``, ``emcy``, ``fault`` (start and end of a requested
    fault), ``bus`` (the program opens or closes its end), ``note`` (from the test).
    """

    time_s: float
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.time_s:9.3f} s  {self.kind:<5}  {self.text}"


class TrueState(NamedTuple):
    """True state of the simulated axis at one moment, independent of encoders and frames."""

    time_s: float
    """Drive time, which starts with the test."""
    motor_deg: float
    """Motor angle; the axis starts at 0."""
    load_deg: float
    """Load angle, which starts near 0, displaced by the gear's error."""
    ratio: float
    """Nominal motor turns per load turn."""

    @property
    def error_arcsec(self) -> float:
        """Deviation of the load from the angle of an ideal gear."""
        return (self.load_deg - self.motor_deg / self.ratio) * ARCSEC_PER_DEG


class Frame(NamedTuple):
    """Frame sent or received by the drive."""

    time_s: float
    sent: bool
    """True if the drive sent it."""
    message: can.Message

    def __str__(self) -> str:
        message = self.message
        kind = "".join(
            f" {name}"
            for name, is_so in (
                ("29-bit", message.is_extended_id),
                ("remote", message.is_remote_frame),
                ("error", message.is_error_frame),
            )
            if is_so
        )
        way = "drive sent" if self.sent else "drive saw "
        data = bytes(message.data).hex(" ")
        return f"{self.time_s:9.3f} s  {way}  {message.arbitration_id:03X}{kind}  {data}"


class History:
    """Newest events, frames and true states; bounded in size."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.frames: deque[Frame] = deque(maxlen=FRAMES)
        self.trace: deque[TrueState] = deque(maxlen=PERIODS)

    def report(self) -> str:
        """Returns the last events, frames and true angles, for the report of a failed test."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        events, frames = list(self.events), list(self.frames)
        if len(events) > SHOWN_EVENTS:
            yield f"... {len(events) - SHOWN_EVENTS} events before"
        yield from map(str, events[-SHOWN_EVENTS:])
        yield f"the last {min(SHOWN_FRAMES, len(frames))} frames:"
        yield from map(str, frames[-SHOWN_FRAMES:])
        if self.trace:
            last = self.trace[-1]
            yield (
                f"true angles in the end: load {last.load_deg:.4f} deg, motor {last.motor_deg:.3f} deg, "
                f"transmission error {last.error_arcsec:.1f} arcsec"
            )


End = Callable[[], None]
"""Function that undoes a fault."""

_NEVER: Final = float("inf")
_EMERGENCIES: Final = range(0x081, 0x100)
_TPDOS: Final = range(0x180, 0x580)
_BOOT_UP: Final = (0x700, b"\0")


@dataclass
class Fault:
    """Fault requested by a test. As a context manager, it ends with its block."""

    name: str
    arguments: Mapping[str, Any]
    begun_s: float | None = None
    """Start in drive time, s; None while pending."""
    ended_s: float | None = None
    """End or cancellation in drive time, s; None before."""
    _finish: Callable[[Fault], None] = field(default=lambda _: None, repr=False)
    _undo: End | None = field(default=None, repr=False)

    def end(self) -> None:
        """Ends the fault now, or cancels it if it has not begun. Ending it again is not an error."""
        self._finish(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def __str__(self) -> str:
        return self.name + "".join(f" {name}={shown(name, value)}" for name, value in self.arguments.items())


@dataclass(frozen=True)
class Trigger:
    """Trigger of a fault; immediate if neither time nor angle is given."""

    after_s: float = 0.0
    beyond_deg: float | None = None
    """Load angle at which the fault begins, passed from either side."""


@dataclass
class _ScheduledAction:
    """Action at a time, or once the load has passed an angle."""

    act: Callable[[], None]
    at_s: float = _NEVER
    beyond_deg: float | None = None
    from_below: bool = True

    def is_due(self, now_s: float, load_deg: float) -> bool:
        if now_s >= self.at_s:
            return True
        if self.beyond_deg is None:
            return False
        return load_deg >= self.beyond_deg if self.from_below else load_deg <= self.beyond_deg


class WatchedDrive(DriveNode):
    """Simulated drive with a `History`, and with faults that begin and end at given times of the drive's
    clock.

    Thread-safe.
    """

    def __init__(
        self,
        bus: can.BusABC,
        truth: Truth,
        seed: int,
        eds_path: Path,
        node_id: int,
        clock: Clock,
        load_object: tuple[int, int] = LOAD_OBJECT,
    ) -> None:
        self.lock = threading.RLock()
        self.history = History()
        self.machine = Machine(truth, seed)
        self.nameplate = nameplate_of(truth, load_object=load_object)
        self.ratio = self.nameplate.gear_motor_turns / self.nameplate.gear_load_turns
        self.last_tpdos: dict[int, bytes] = {}
        """Data of the last TPDO sent with each identifier."""
        self._scheduled: list[_ScheduledAction] = []
        self._begin_s = clock.now()
        super().__init__(bus, self.machine, eds_path, node_id, clock, self.nameplate, truth.firmware)
        self._last_state, self._last_nmt = self.firmware.state, self.nmt

    @property
    def time_s(self) -> float:
        """Time since the drive was created, s."""
        return self._clock.now() - self._begin_s

    def note(self, kind: str, text: str) -> None:
        """Adds an event to the history."""
        self.history.events.append(Event(self.time_s, kind, text))

    def true_state(self) -> TrueState:
        """Returns the current true state of the axis."""
        machine = self.machine
        return TrueState(self.time_s, machine.true_motor_deg, machine.true_load_deg, self.ratio)

    # ---------------------------------------------------------------- faults

    def schedule(self, fault: Fault, begin: Callable[[], End], when: Trigger, for_s: float | None) -> None:
        """Starts a fault at its trigger; it ends ``for_s`` later, or on request."""

        def begins() -> None:
            if fault.ended_s is not None:
                return
            fault.begun_s = self.time_s
            self.note("fault", str(fault))
            fault._undo = begin()
            if for_s is not None:
                self._scheduled.append(
                    _ScheduledAction(lambda: self._finish(fault), at_s=self._clock.now() + for_s)
                )

        fault._finish = self._finish
        with self.lock:
            if when.beyond_deg is not None:
                below = self.machine.true_load_deg < when.beyond_deg
                self._scheduled.append(_ScheduledAction(begins, beyond_deg=when.beyond_deg, from_below=below))
            else:
                self._scheduled.append(_ScheduledAction(begins, at_s=self._clock.now() + when.after_s))
            self.run_until(self._clock.now())

    def _finish(self, fault: Fault) -> None:
        with self.lock:
            if fault.ended_s is not None:
                return
            fault.ended_s = self.time_s
            if fault._undo is not None:
                fault._undo()
            self.note("fault", f"{fault.name} {'ends' if fault._undo is not None else 'is cancelled'}")

    def report_false_value(self, index: int, subindex: int, value: int) -> End:
        """Makes the drive report a false value of an object, by SDO and in TPDOs."""
        entry = self.dictionary[index, subindex]
        before = entry.bound

        def bind(read: Callable[[], int] | None) -> None:
            entry.bound = read
            for pdo in self._tpdos:  # compiled mappings still read the old source
                pdo.compile()

        bind(lambda: value)
        return lambda: bind(before)

    # ---------------------------------------------------------------- methods of the drive, with recording

    def next_event_s(self) -> float:
        """Returns the time by which ``poll`` must be called; triggers of faults count as events."""
        event_s = super().next_event_s()
        return min((event_s, *(action.at_s for action in self._scheduled))) if self._scheduled else event_s

    def handle(self, message: can.Message, now_s: float) -> None:
        with self.lock:
            self.history.frames.append(Frame(self.time_s, False, message))
            super().handle(message, now_s)
            self._look()

    def run_until(self, now_s: float) -> None:
        with self.lock:
            while due := next((each for each in self._scheduled if self._is_due(each, now_s)), None):
                self._scheduled.remove(due)
                due.act()
            super().run_until(now_s)
            self._look()

    def _is_due(self, action: _ScheduledAction, now_s: float) -> bool:
        return action.is_due(now_s, self.machine.true_load_deg)

    def _send(self, can_id: int, data: bytes) -> None:
        if not (self.faults.silent or can_id in self.faults.muted_ids):
            self.history.frames.append(Frame(self.time_s, True, DataFrame(can_id, data)))
            if can_id in _TPDOS:
                self.last_tpdos[can_id] = data
            elif can_id in _EMERGENCIES:
                code = int.from_bytes(data[:2], "little")
                self.note(
                    "emcy", f"{code:04X}h ({error_name(code)})" if code else "0000h (no error any more)"
                )
            elif (can_id & 0x780, data) == _BOOT_UP:
                self.note("nmt", "boot-up message")
        super()._send(can_id, data)

    def _advance(self) -> None:
        super()._advance()
        self.history.trace.append(self.true_state())
        self._look()

    def _look(self) -> None:
        """Records state changes."""
        if self.firmware.state is not self._last_state:
            self._last_state = self.firmware.state
            self.note("state", words(self._last_state.name))
        if self.nmt is not self._last_nmt:
            self._last_nmt = self.nmt
            self.note("nmt", words(self._last_nmt.name))


def shown(name: str, value: float) -> str:
    """Formats an argument of a fault: codes and objects in hexadecimal."""
    return f"0x{value:04X}" if name in ("code", "index") and isinstance(value, int) else str(value)


def words(name: str) -> str:
    """Converts the name of an enumeration member to words."""
    return name.lower().replace("_", " ")
