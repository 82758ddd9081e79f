"""The faults that an axis under way has to survive, as rows; each bus has a bench on which they are tried.

`docs/reliability.md` is made of what came of them, by ``tools/reliability_page.py``.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from hdbridge.control.cycle import Cycle
from hdbridge.drive.supervision import Event, Fault, Reaction, Supervision
from hdbridge.errors import SafetyStop
from hdbridge.sim.node import SimulatedDrive

RECORD: Final = "HDBRIDGE_RELIABILITY"
"""Environment variable: the file to which a line of JSON is added for each row that was tried."""
WORDS: Final = {
    Reaction.GO: "go on, count",
    Reaction.FREEZE: "freeze",
    Reaction.QUICK_STOP: "quick stop",
    Reaction.LATCH: "latch",
}
VIRTUAL, VCAN = "virtual", "vcan"


class Bench(Protocol):
    """An axis under way at constant speed, and what can be done to it."""

    node: SimulatedDrive
    supervision: Supervision
    cycle: Cycle

    def move(self) -> Any:
        """One cycle further at constant speed."""

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        """A frame from another node, on the bus before the next cycle."""

    def hang(self, duration_s: float) -> None:
        """This process does nothing for so long."""

    def interface_down(self) -> None: ...
    def interface_deleted(self) -> None: ...
    def transmit_queue_full(self) -> None: ...


Wish = Callable[[Bench], object]


@dataclass(frozen=True)
class Row:
    """One fault: how it is made, and what has to come of it within how many cycles."""

    name: str
    make: Wish
    fault: Fault
    reaction: Reaction
    allowed: int | str
    """Cycles; or ``heartbeats``: until the drive's heartbeat counts as lost."""
    again: bool = False
    """Made before each cycle, not once."""
    buses: tuple[str, ...] = (VIRTUAL, VCAN)
    command: Callable[[Any], Any] | None = None
    """In place of the next target."""

    def allowed_cycles(self, heartbeat_timeout_s: float, period_s: float) -> int:
        """The same in cycles of an axis."""
        if isinstance(self.allowed, int):
            return self.allowed
        return math.ceil(heartbeat_timeout_s / period_s) + 1


def _drive(**wishes: Any) -> Wish:
    def make(bench: Bench) -> None:
        for name, value in wishes.items():
            setattr(bench.node.faults, name, value)

    return make


def _frame(can_id: int, data: bytes = b"", times: int = 1, **kind: bool) -> Wish:
    def make(bench: Bench) -> None:
        for _ in range(times):
            bench.interfere(can_id, data, **kind)

    return make


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
        buses=(VIRTUAL,)),
    Row("a stale TPDO before SYNC", _frame(0x181, bytes(8)), _F.DUPLICATE_TPDO, _R.GO, 1),
    Row("the drive falls silent (cable pulled)", _drive(silent=True), _F.LOST_TPDO, _R.QUICK_STOP, 2),
    Row("the drive's heartbeat stays away", _drive(mute_heartbeat=True), _F.HEARTBEAT_LOST, _R.QUICK_STOP,
        "heartbeats"),
    Row("the drive restarts", lambda bench: bench.node.faults.boot_up(), _F.BOOT_UP, _R.LATCH, 2),
    Row("the drive leaves OPERATIONAL", _frame(0x701, b"\x7f"), _F.NMT_CHANGE, _R.LATCH, 1),
    Row("32 emergency messages", _frame(0x081, _EMCY, 32), _F.EMERGENCY, _R.GO, 1),
    Row("the drive goes into fault (3210h)", lambda bench: bench.node.faults.raise_error(0x3210),
        _F.DRIVE_FAULT, _R.QUICK_STOP, 2),
    Row("the drive drops out by itself", lambda bench: bench.node.faults.lose_master(0x8130),
        _F.DROPPED_OUT, _R.QUICK_STOP, 2),
    Row("the load encoder jumps and stays away", _drive(load_jump_counts=100_000), _F.ENCODER_JUMP,
        _R.QUICK_STOP, 3),
    Row("SYNC of another master", _frame(0x080), _F.FOREIGN_SYNC, _R.QUICK_STOP, 1),
    Row("a set-point of another master", _frame(0x201, bytes(6)), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("heartbeat of another master", _frame(0x77F, b"\x05"), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("an NMT command of another master", _frame(0, b"\x01\x05"), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("an SDO request of another client", _frame(0x601, bytes(8)), _F.OWN_ID_ELSEWHERE, _R.QUICK_STOP, 1),
    Row("a node babbles", _frame(0x7E5, bytes(8), 300), _F.FLOOD, _R.QUICK_STOP, 2, again=True,
        buses=(VIRTUAL,)),
    Row("a cycle starts 0.7 periods late", lambda bench: bench.hang(1.7 * bench.cycle.period_s), _F.OVERRUN,
        _R.GO, 1),
    Row("two cycles in a row start late", lambda bench: bench.hang(1.7 * bench.cycle.period_s), _F.OVERRUN,
        _R.QUICK_STOP, 2, again=True),
    Row("the master's process hangs for 0.5 s", lambda bench: bench.hang(0.5), _F.HANG, _R.GO, 1),
    Row("a target that is not a number", lambda bench: None, _F.BAD_TARGET, _R.QUICK_STOP, 1,
        command=lambda feedback: math.nan),
    Row("a target beyond 32 bits", lambda bench: None, _F.BAD_TARGET, _R.QUICK_STOP, 1,
        command=lambda feedback: 1 << 31),
    Row("the interface goes down", lambda bench: bench.interface_down(), _F.BUS_DOWN, _R.LATCH, 1),
    Row("the interface is deleted", lambda bench: bench.interface_deleted(), _F.BUS_DOWN, _R.LATCH, 1),
    Row("the transmit queue is full", lambda bench: bench.transmit_queue_full(), _F.TRANSMIT_FULL,
        _R.QUICK_STOP, 1, buses=(VIRTUAL,)),
)  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """What came of a row on a bus."""

    bus: str
    name: str
    seen: str
    cycles: int
    allowed: int


def read_record(path: Path) -> list[Seen]:
    """What was written for each row that was tried."""
    return [Seen(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def rows_of(bus: str) -> list[Row]:
    """The rows that this bus can show."""
    return [row for row in ROWS if bus in row.buses]


def try_out(row: Row, bench: Bench, bus: str, heartbeat_timeout_s: float) -> Seen:
    """Make the fault on an axis under way; AssertionError where its reaction does not come in time."""
    allowed = row.allowed_cycles(heartbeat_timeout_s, bench.cycle.period_s)
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
            bench.cycle.tick(row.command) if row.command else bench.move()
        hits = [
            event
            for event in bench.supervision.events
            if event.fault is row.fault and event.reaction >= row.reaction
        ]
    assert hits[0].reaction is row.reaction
    latched = bench.supervision.stop
    assert (latched is not None) == (row.reaction >= Reaction.QUICK_STOP or row.fault is Fault.HANG)
    seen = Seen(bus, row.name, _words(bench.supervision, hits[0]), cycles, allowed)
    _record(seen)
    return seen


def _words(supervision: Supervision, hit: Event) -> str:
    stop, gravest = supervision.stop, supervision.gravest
    if stop is None or gravest is None:
        return f"{WORDS[hit.reaction]}: {hit.fault.value}"
    then = "" if gravest.fault is stop.fault else f", then {gravest.fault.value}"
    return f"{WORDS[gravest.reaction]}: {stop.fault.value}{then}"


def _record(seen: Seen) -> None:
    path = os.environ.get(RECORD)
    if path:
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(seen)) + "\n")
