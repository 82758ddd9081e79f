"""Fault table: the reaction to each fault in a control cycle. Pure: no bus, no clock.

The cycle reports its faults, and the table returns the reaction. A stop is latched. Only `Supervision.reset`
releases it, and after a `Reaction.LATCH` only when the drive has been fully verified again. The table is
data: a fault with a different reaction requires a new row, not an `if`.
"""

from collections import deque
from collections.abc import Iterable
from enum import Enum, IntEnum
from itertools import islice
from typing import Final, NamedTuple

from hdbridge.errors import RESET, SafetyStop


class Reaction(IntEnum):
    """Reaction of the cycle, in order of severity."""

    GO = 0
    """Continue; the fault is counted."""
    FREEZE = 1
    """Continue with the compensation's correction frozen, because this cycle's feedback is the last good
    one."""
    QUICK_STOP = 2
    """Command a quick stop until the drive reports it; latched."""
    LATCH = 3
    """Send no more RPDOs after a last quick stop; a drive that restarted is put into PRE-OPERATIONAL instead.

    Latched until the drive has been verified again, from identity to limits."""


class Fault(Enum):
    """Faults of a cycle."""

    LOST_TPDO = "a TPDO is missing"
    OVERRUN = "the cycle started too late"
    HANG = "the control process stalled for longer than the drive waits"
    DUPLICATE_TPDO = "a TPDO came twice or out of its cycle"
    WRONG_LENGTH = "a TPDO has the wrong length"
    DISCARDED_FRAME = "a frame of the wrong kind was discarded"
    FLOOD = "more frames waited than one cycle reads"
    EMERGENCY = "the drive sent an emergency message"
    MASTER_LOST = "the drive reports that it missed its master"
    DRIVE_FAULT = "the drive reports a fault"
    DROPPED_OUT = "the drive changed its power state on its own"
    BOOT_UP = "a node restarted"
    NMT_CHANGE = "a node is not operational"
    HEARTBEAT_LOST = "the drive's heartbeat is missing"
    OWN_ID_ELSEWHERE = "another node sends with an identifier of this master"
    FOREIGN_SYNC = "another node sends SYNC"
    ENCODER_JUMP = "an encoder moved faster than the axis can"
    FOLLOWING_ERROR = "the drive does not follow its demand"
    BAD_TARGET = "the target is not a number within the limits"
    BUS_DOWN = "the CAN interface went away"
    TRANSMIT_FULL = "the transmit queue is full"
    CHANNEL_HELD = "a load torque or temperature did not arrive, or is implausible"
    CHANNEL_LOST = "a load torque or temperature is missing"


class Row(NamedTuple):
    """Reactions to one fault: ``first``, and ``then`` from ``threshold`` consecutive cycles on."""

    fault: Fault
    first: Reaction
    threshold: int
    then: Reaction
    hint: str
    """Advice to the user."""


_GO, _FREEZE, _STOP, _LATCH = Reaction.GO, Reaction.FREEZE, Reaction.QUICK_STOP, Reaction.LATCH

TABLE: Final[tuple[Row, ...]] = (
    Row(Fault.LOST_TPDO, _FREEZE, 2, _STOP, "check the cable, the bus load and the drive's PDOs"),
    Row(
        Fault.OVERRUN, _GO, 2, _STOP, "see 'hdbridge latency' for the cycle time that this computer sustains"
    ),
    Row(Fault.HANG, _STOP, 1, _STOP, "see 'hdbridge latency' for what this computer sustains; keep it awake"),
    Row(Fault.DUPLICATE_TPDO, _GO, 1, _GO, "look for a second node with the drive's node id"),
    Row(Fault.WRONG_LENGTH, _FREEZE, 2, _STOP, "boot the drive again: its PDO mapping (1A00h) was changed"),
    Row(Fault.DISCARDED_FRAME, _GO, 1, _GO, "look for a node that is not CANopen, or restart the drive"),
    Row(Fault.FLOOD, _FREEZE, 2, _STOP, "look for a node that floods the bus"),
    Row(Fault.EMERGENCY, _GO, 1, _GO, "look the code up in the drive's manual"),
    Row(Fault.MASTER_LOST, _STOP, 1, _STOP, "check the bus load, and 'hdbridge latency' for this machine"),
    Row(
        Fault.DRIVE_FAULT,
        _STOP,
        1,
        _STOP,
        f"read its error code (603Fh), remove the cause, then reset the fault: {RESET}",
    ),
    Row(Fault.DROPPED_OUT, _STOP, 1, _STOP, "check the enable input, the supply and the limit switches"),
    Row(Fault.BOOT_UP, _LATCH, 1, _LATCH, "check its supply, then boot and verify the drive again"),
    Row(Fault.NMT_CHANGE, _LATCH, 1, _LATCH, "read the drive's error history (1003h), then boot it again"),
    Row(Fault.HEARTBEAT_LOST, _STOP, 1, _STOP, "check that the drive runs and that the cable is whole"),
    Row(Fault.OWN_ID_ELSEWHERE, _STOP, 1, _STOP, "stop the other master on this bus"),
    Row(Fault.FOREIGN_SYNC, _STOP, 1, _STOP, "switch the other SYNC producer off (object 1005h, bit 30)"),
    Row(Fault.ENCODER_JUMP, _FREEZE, 2, _STOP, "check the encoder, its cable and counts_per_turn"),
    Row(Fault.FOLLOWING_ERROR, _GO, 2, _STOP, "check for an obstacle, the tuning and following_error_deg"),
    Row(Fault.BAD_TARGET, _STOP, 1, _STOP, "correct what computes the target"),
    Row(Fault.BUS_DOWN, _LATCH, 1, _LATCH, "bring the interface up, open it and boot the drive again"),
    Row(Fault.TRANSMIT_FULL, _STOP, 1, _STOP, "check that another node acknowledges and the bus load"),
    Row(Fault.CHANNEL_HELD, _GO, 1, _GO, "check the sensor, its range in the axis file and the bus load"),
    Row(Fault.CHANNEL_LOST, _GO, 1, _GO, "check the sensor and its cable"),
)
ROWS: Final[dict[Fault, Row]] = {row.fault: row for row in TABLE}

EVENTS_KEPT: Final = 1000
EMERGENCIES_SHOWN: Final = 3
_BY_THE_DRIVE: Final = frozenset({Fault.DRIVE_FAULT, Fault.DROPPED_OUT, Fault.NMT_CHANGE})
"""Faults that the drive raises on its own, with the reason in its emergency messages."""
_EMERGENCIES: Final = frozenset({Fault.EMERGENCY, Fault.MASTER_LOST})
EXPLAINED_HINT: Final = f"remove that cause, then reset the fault: {RESET}"
"""Advice for a stop that an emergency message of the drive explains."""


class Event(NamedTuple):
    """Occurrence of a fault, with the reaction to it."""

    cycle: int
    fault: Fault
    reaction: Reaction
    detail: str

    def __str__(self) -> str:
        """For example ``cycle 120: a TPDO is missing (282h): freeze``."""
        detail = f" ({self.detail})" if self.detail else ""
        return (
            f"cycle {self.cycle}: {self.fault.value}{detail}: {self.reaction.name.lower().replace('_', ' ')}"
        )


class Supervision:
    """Judges each cycle by the table; keeps the latch and the log of events.

    Memory is bounded: the newest `EVENTS_KEPT` events and a count of each fault are kept.
    """

    def __init__(self) -> None:
        self._runs: dict[Fault, int] = {}
        self._frozen = False
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        """Newest `EVENTS_KEPT` events, oldest first."""
        self.noted = 0
        """Number of all events, including those dropped."""
        self.counts: dict[Fault, int] = dict.fromkeys(Fault, 0)
        """Number of cycles in which each fault was seen."""
        self.stop: Event | None = None
        """Event that stopped the axis first; None while it may run."""
        self.gravest: Event | None = None
        """Event that decides how the axis is stopped: the first cause, or a more severe consequence."""

    @property
    def quiet(self) -> bool:
        """True if a cycle without faults changes nothing, so that `judge` need not be called."""
        return not self._runs and self.stop is None

    @property
    def reaction(self) -> Reaction:
        """Latched reaction; GO without a latch."""
        return self.gravest.reaction if self.gravest is not None else Reaction.GO

    def judge(self, cycle: int, faults: Iterable[tuple[Fault, str]]) -> Reaction:
        """Returns the reaction to one cycle's faults, each with its detail; a good cycle has none.

        Once latched, the reaction persists even through cycles without faults. Two consecutive cycles without
        usable feedback cause a stop, whichever faults caused the loss.
        """
        previous, self._runs = self._runs, {}
        frozen, self._frozen = self._frozen, False
        worst = Reaction.GO
        for fault, detail in faults:
            if fault not in self._runs:
                worst = max(worst, self._note(cycle, fault, detail, previous.get(fault, 0) + 1, frozen))
        return max(worst, self.reaction)

    def add_fault(self, cycle: int, fault: Fault, detail: str) -> Reaction:
        """Adds a fault that arose during the reaction to the cycle that `judge` has just judged."""
        self._note(cycle, fault, detail, self._runs.get(fault, 0) + 1, frozen=False)
        return self.reaction

    def _note(self, cycle: int, fault: Fault, detail: str, run: int, frozen: bool) -> Reaction:
        self._runs[fault] = run
        row = ROWS[fault]
        reaction = row.then if run >= row.threshold else row.first
        if reaction is Reaction.FREEZE:
            self._frozen = True
            if frozen:
                reaction = Reaction.QUICK_STOP
        event = Event(cycle, fault, reaction, detail)
        self.events.append(event)
        self.noted += 1
        self.counts[fault] += 1
        if reaction >= Reaction.QUICK_STOP:
            self.stop = self.stop or event
            if reaction > self.reaction:
                self.gravest = event
        return reaction

    def since(self, noted: int) -> list[Event]:
        """Returns the kept events after the first ``noted`` events, oldest first."""
        new = min(self.noted - noted, len(self.events))
        return list(islice(self.events, len(self.events) - new, None)) if new > 0 else []

    def error(self) -> SafetyStop:
        """Returns the latched stop as an error."""
        stop, gravest = self.stop, self.gravest
        assert stop is not None, "there is no stop to report"
        assert gravest is not None
        row = ROWS[stop.fault]
        detail = f" ({stop.detail})" if stop.detail else ""
        again = ", the second cycle in a row" if row.first < row.then else ""
        done = "quick stop" if self.reaction is Reaction.QUICK_STOP else "set-points stopped"
        then = "" if gravest.fault is stop.fault else f"; then {gravest.fault.value}"
        said = self._emergencies(stop.cycle - 1)
        sent = f"; the drive sent {', '.join(said)}" if said else ""
        hint = EXPLAINED_HINT if said and stop.fault in _BY_THE_DRIVE else row.hint
        return SafetyStop(
            f"cycle {stop.cycle}: {stop.fault.value}{again}{detail}{then}{sent}: {done}, latched", hint
        )

    def _emergencies(self, since_cycle: int) -> list[str]:
        """Returns the first emergencies that came with the stop, in which the drive explains the stop."""
        said = [
            event.detail
            for event in self.events
            if event.fault in _EMERGENCIES and event.cycle >= since_cycle and event is not self.stop
        ]
        return list(dict.fromkeys(said))[:EMERGENCIES_SHOWN]

    def reset(self, *, verified: bool = False) -> None:
        """Releases the latch.

        After a LATCH, ``verified`` must state that the drive was booted and verified again; otherwise raises
        `SafetyStop` and changes nothing. Events are kept.
        """
        if self.reaction is Reaction.LATCH and not verified:
            raise self.error()
        self.stop = self.gravest = None
        self._runs = {}
        self._frozen = False
