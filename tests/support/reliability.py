"""Table of faults that an axis in motion must survive, with the places at which each is tried.

A *place* is a control cycle on a bus: the bench's on the virtual bus and on vcan, the daemon's on the virtual
bus. Each has a `Bench`. `FURTHER` lists faults that only a daemon can show, each with its own test, and
`daemon_faults` those of a daemon in its own processes on vcan. ``tools/reliability_page.py`` makes
`docs/reliability.md` from the results.
"""

import json
import math
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import pytest

from hdbridge.device.behaviour import Controlword
from hdbridge.device.node import DriveNode
from hdbridge.drive.supervision import Event, Fault, Reaction, Supervision
from hdbridge.errors import SafetyStop
from support.characters import CHARACTERS, FRIENDLY, Character

RECORD: Final = "HDBRIDGE_RELIABILITY"
"""Environment variable with the path of a file, to which a line of JSON is added for each row tried."""
WORDS: Final = {
    Reaction.GO: "continue, count",
    Reaction.FREEZE: "freeze",
    Reaction.QUICK_STOP: "quick stop",
    Reaction.LATCH: "latch",
}
VIRTUAL, VCAN, DAEMON = "virtual", "vcan", "daemon"
DAEMON_VCAN = "daemon, vcan"
"""Places: the bench twice, the daemon's loop, and the whole daemon in processes."""


class Bench(Protocol):
    """Axis in motion at constant speed, and methods to disturb it."""

    node: DriveNode
    supervision: Supervision
    period_s: float

    def move(self) -> Any:
        """Runs one cycle at constant speed."""

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        """Sends a frame from another node, before the next cycle."""

    def hang(self, duration_s: float) -> None:
        """Stalls this process for ``duration_s``."""

    def interface_down(self) -> None: ...
    def interface_deleted(self) -> None: ...
    def transmit_queue_full(self) -> None: ...
    def bad_target(self, counts: float) -> None:
        """Makes the next cycle command this target, motor counts."""


Wish = Callable[[Bench], object]


@dataclass(frozen=True)
class Row:
    """One fault, with its expected reaction and the number of cycles allowed."""

    name: str
    make: Wish
    fault: Fault
    reaction: Reaction
    allowed: int | str
    """Maximum number of cycles; ``heartbeats`` is the time until the drive's heartbeat counts as lost."""
    again: bool = False
    """True if the fault is made before each cycle, not only once."""
    places: tuple[str, ...] = (VIRTUAL, VCAN, DAEMON)
    everybody: bool = False
    """True if the fault affects every axis on the bus."""
    without_a_word: bool = False
    """True if only the statusword shows the fault; the drive sends no EMCY."""

    def unseen_on(self, character: Character) -> bool:
        """Returns True if the messages of a drive of this character do not show the fault.

        This is so if it stops without an EMCY, and resumes at SYNC before it samples the values of its TPDOs.
        An option 605Ah below 5 rules that out.
        """
        return self.resumptions_on(character) > 0 and character.behaviour.rpdo_before_tpdo

    def resumptions_on(self, character: Character) -> int:
        """Returns how often a drive of this character may resume before a master can detect its stop.

        If it stops without an EMCY, it resumes at the next SYNC because of the buffered RPDO; its TPDO of the
        same SYNC shows the stop. An option 605Ah below 5 rules that out.
        """
        by_level = character.behaviour.controlword is Controlword.LEVEL
        return int(self.without_a_word and by_level and character.quick_stop_option >= 5)

    def allowed_cycles(self, heartbeat_timeout_s: float, period_s: float) -> int:
        """Returns the maximum number of cycles."""
        if isinstance(self.allowed, int):
            return self.allowed
        return math.ceil(heartbeat_timeout_s / period_s) + 1


def _drive(**wishes: Any) -> Wish:
    def make(bench: Bench) -> None:
        for name, value in wishes.items():
            setattr(bench.node.faults, name, value)

    return make


def _stale(bench: Bench) -> None:
    """Sends the TPDO of the last SYNC again."""
    bench.interfere(0x181, bench.node._tpdos[0].pack())


def _frame(can_id: int, data: bytes = b"", times: int = 1, **kind: bool) -> Wish:
    def make(bench: Bench) -> None:
        for _ in range(times):
            bench.interfere(can_id, data, **kind)

    return make


def _glitch(bench: Bench, counts: int) -> None:
    """Shifts only the next sample of the load encoder."""
    jumps = [counts]
    bench.node.faults.load_reading = lambda right: right + (jumps.pop() if jumps else 0)


def _miss(code: int) -> Wish:
    """Makes the drive stop, with an EMCY of this code, as if it had lost its master."""

    def make(bench: Bench) -> None:
        bench.node.faults.miss_master(code)

    return make


def patience_s(bench: Bench) -> float:
    """Returns the drive's time-out for set-points: four cycles, at least 10 ms."""
    return max(4.0 * bench.period_s, 0.01)


_F, _R = Fault, Reaction
_EMCY = struct.pack("<HB5x", 0x3110, 1)
ROWS: Final = (
    Row("a TPDO is lost", _drive(drop_tpdos=1), _F.LOST_TPDO, _R.FREEZE, 1),
    Row("TPDOs are lost in two cycles in a row", _drive(drop_tpdos=4), _F.LOST_TPDO, _R.QUICK_STOP, 2),
    Row("a TPDO comes one SYNC late", _drive(hold_tpdos=1), _F.LOST_TPDO, _R.FREEZE, 1),
    Row("TPDOs come twice", _drive(duplicate_tpdos=2), _F.DUPLICATE_TPDO, _R.GO, 2),
    Row("a TPDO is a byte short", _drive(shorten_tpdos=1), _F.WRONG_LENGTH, _R.FREEZE, 1),
    Row("TPDOs are short in two cycles in a row", _drive(shorten_tpdos=4), _F.WRONG_LENGTH, _R.QUICK_STOP, 2),
    Row("a remote frame", _frame(0x181, is_remote_frame=True), _F.DISCARDED_FRAME, _R.GO, 1),
    Row("a 29-bit identifier", _frame(0x181, bytes(8), is_extended_id=True), _F.DISCARDED_FRAME, _R.GO, 1,
        places=(VIRTUAL, DAEMON)),
    Row("a stale TPDO before SYNC", _stale, _F.DUPLICATE_TPDO, _R.GO, 1),
    Row("the drive falls silent (cable pulled)", _drive(silent=True), _F.LOST_TPDO, _R.QUICK_STOP, 2),
    Row("the drive's heartbeat is missing", _drive(mute_heartbeat=True), _F.HEARTBEAT_LOST, _R.QUICK_STOP,
        "heartbeats"),
    Row("the drive restarts", lambda bench: bench.node.faults.boot_up(), _F.BOOT_UP, _R.LATCH, 2),
    Row("the drive leaves OPERATIONAL", _frame(0x701, b"\x7f"), _F.NMT_CHANGE, _R.LATCH, 1),
    Row("32 emergency messages", _frame(0x081, _EMCY, 32), _F.EMERGENCY, _R.GO, 1),
    Row("the drive goes into fault (3210h)", lambda bench: bench.node.faults.raise_error(0x3210),
        _F.DRIVE_FAULT, _R.QUICK_STOP, 2),
    Row("the drive drops out on its own", lambda bench: bench.node.faults.lose_master(0x8130),
        _F.DROPPED_OUT, _R.QUICK_STOP, 2, without_a_word=True),
    Row("the drive has dropped out between two SYNCs", _frame(0x181, b"\x07\x16" + bytes(6)),
        _F.DROPPED_OUT, _R.QUICK_STOP, 1),
    # Two cycles, because the emergency message may follow the TPDOs of its cycle.
    Row("the drive misses the master's heartbeat (8130h)", _miss(0x8130), _F.MASTER_LOST, _R.QUICK_STOP, 2),
    Row("the drive misses set-points (8250h)", _miss(0x8250), _F.MASTER_LOST, _R.QUICK_STOP, 2),
    Row("the load encoder jumps and stays away", _drive(load_jump_counts=100_000), _F.ENCODER_JUMP,
        _R.QUICK_STOP, 3),
    Row("the load encoder jumps for one sample", lambda bench: _glitch(bench, 100_000), _F.ENCODER_JUMP,
        _R.FREEZE, 2),
    Row("SYNC of another master", _frame(0x080), _F.FOREIGN_SYNC, _R.QUICK_STOP, 1, everybody=True),
    Row("a set-point of another master", _frame(0x201, bytes(6)), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("heartbeat of another master", _frame(0x77F, b"\x05"), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1,
        everybody=True),
    Row("an NMT command of another master", _frame(0, b"\x01\x05"), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1,
        everybody=True),
    Row("an SDO request of another client", _frame(0x601, bytes(8)), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("a node floods the bus", _frame(0x7E5, bytes(8), 300), _F.FLOOD, _R.QUICK_STOP, 2, again=True,
        everybody=True, places=(VIRTUAL, DAEMON)),
    Row("a cycle starts 0.7 periods late", lambda bench: bench.hang(1.7 * bench.period_s), _F.OVERRUN,
        _R.GO, 1),
    Row("two cycles in a row start late", lambda bench: bench.hang(1.7 * bench.period_s), _F.OVERRUN,
        _R.QUICK_STOP, 2, again=True, everybody=True),
    Row("the master's process stalls for as long as the drive waits, and a period",
        lambda bench: bench.hang(patience_s(bench) + bench.period_s), _F.HANG, _R.QUICK_STOP, 1,
        everybody=True),
    Row("the master's process hangs for 0.5 s", lambda bench: bench.hang(0.5), _F.HANG, _R.QUICK_STOP, 1,
        everybody=True),
    Row("a target that is not a number", lambda bench: bench.bad_target(math.nan), _F.BAD_TARGET,
        _R.QUICK_STOP, 1),
    Row("a target that is infinite", lambda bench: bench.bad_target(math.inf), _F.BAD_TARGET,
        _R.QUICK_STOP, 1),
    Row("a target beyond 32 bits", lambda bench: bench.bad_target(1 << 31), _F.BAD_TARGET,
        _R.QUICK_STOP, 1),
    Row("the interface goes down", lambda bench: bench.interface_down(), _F.BUS_DOWN, _R.LATCH, 1,
        everybody=True),
    Row("the interface is deleted", lambda bench: bench.interface_deleted(), _F.BUS_DOWN, _R.LATCH, 1,
        everybody=True),
    Row("the transmit queue is full", lambda bench: bench.transmit_queue_full(), _F.TRANSMIT_FULL,
        _R.QUICK_STOP, 1, everybody=True, places=(VIRTUAL, DAEMON)),
)  # fmt: skip


@dataclass(frozen=True)
class Further:
    """Fault that the daemon's loop can show, but not a bench; each has its own test."""

    name: str
    expected: str
    allowed: float

    def show(self, taken: float) -> None:
        """Records the observed reaction; AssertionError if it took too many cycles."""
        assert taken <= self.allowed, f"{self.name}: {taken:g}, allowed are {self.allowed:g}"
        record(Seen(DAEMON, self.name, self.expected, taken, self.allowed))


FURTHER: Final = (
    Further("TPDOs come in another order", "no effect", 0),
    Further("the load encoder's counts pass the end of their 32 bits", "no effect", 0),
    Further("the motor does not follow", "quick stop, once the error is beyond the limit", 2),
    Further("a model asks for a step beyond the limits of speed and slew",
        "quick stop; the target is not sent", 1),
    Further("a client's target is not a number, infinite or outside the limits",
        "refused; the motion continues", 1),
    Further("a client streams a set-point that is not a number", "the stream ends, braking", 1),
    Further("a mailbox full of invalid commands", "each refused; the motion continues", 32),
    Further("an SDO write, an NMT reset, a set-point from the service in motion", "not sent", 0),
    Further("the position in the enable command is stale", "enabled in place; no motion", 0),
    Further("another drive identity, encoder or gear", "no set-point; not enabled", 0),
    Further("the control process is killed in motion", "the drives stop on their own", 25),
    Further("the control process restarts", "every axis disabled and unverified", 1),
    Further("the service dies during a jog", "the jog runs out and brakes", 150),
    Further("the interface comes back", "opened; verified again; disabled", 126),
    Further("the disk is full", "the recorder drops and reports it; no cycle is missed", 0),
)  # fmt: skip
"""Further faults, in the order of the page."""


def further(name: str) -> Further:
    """Returns the row of `FURTHER` with this name."""
    (found,) = (each for each in FURTHER if each.name == name)
    return found


@dataclass(frozen=True)
class Seen:
    """Result of a fault row at one place."""

    place: str
    name: str
    seen: str
    taken: float
    """Number of cycles until the reaction."""
    allowed: float
    character: str = FRIENDLY.name


def read_record(path: Path) -> list[Seen]:
    """Reads the recorded results."""
    return [Seen(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


ABOUT_POWER: Final = frozenset(
    {_F.HANG, _F.MASTER_LOST, _F.DROPPED_OUT, _F.HEARTBEAT_LOST, _F.TRANSMIT_FULL, _F.BOOT_UP, _F.BUS_DOWN}
)
"""Faults after which a drive may resume without a request, if its firmware allows it."""


def rows_of(place: str) -> list[Row]:
    """Returns the rows that can be tried at a place."""
    return [row for row in ROWS if place in row.places]


def cases_on(place: str, in_every_run: Callable[[Character, Row], bool]) -> list[Any]:
    """Returns all pairs of character and row as pytest parameters, marked slow unless ``in_every_run``."""
    return [
        pytest.param(character, row, marks=() if in_every_run(character, row) else pytest.mark.slow,
                     id=f"{character}-{row.name}")
        for character in CHARACTERS for row in ROWS if place in row.places
    ]  # fmt: skip


def try_out(
    row: Row, bench: Bench, place: str, heartbeat_timeout_s: float, character: Character = FRIENDLY
) -> Seen:
    """Makes the fault on an axis in motion; AssertionError without the expected reaction in time."""
    allowed = row.allowed_cycles(heartbeat_timeout_s, bench.period_s)
    bench.supervision.events.clear()
    row.make(bench)
    cycles = 0
    hits: list[Event] = []
    while not hits:
        if cycles == allowed:
            events = [str(event) for event in bench.supervision.events]
            raise AssertionError(f"no {row.reaction.name} for {row.fault.name} in {allowed} cycles: {events}")
        if cycles and row.again:
            row.make(bench)
        cycles += 1
        with suppress(SafetyStop):
            bench.move()
        hits = [
            event
            for event in bench.supervision.events
            if event.fault is row.fault and event.reaction >= row.reaction
        ]
    assert hits[0].reaction is row.reaction
    latched = bench.supervision.stop
    assert (latched is not None) == (row.reaction >= Reaction.QUICK_STOP)
    seen = Seen(place, row.name, _words(bench.supervision, hits[0]), cycles, allowed, character.name)
    record(seen)
    return seen


def _words(supervision: Supervision, hit: Event) -> str:
    stop, gravest = supervision.stop, supervision.gravest
    if stop is None or gravest is None:
        return f"{WORDS[hit.reaction]}: {hit.fault.value}"
    then = "" if gravest.fault is stop.fault else f", then {gravest.fault.value}"
    return f"{WORDS[gravest.reaction]}: {stop.fault.value}{then}"


def record(seen: Seen) -> None:
    """Records a result if `RECORD` is set."""
    path = os.environ.get(RECORD)
    if path:
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(seen)) + "\n")
