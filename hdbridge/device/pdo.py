"""PDOs of the simulated drive, configured by SDO as in CiA 301 and compiled once for speed.

Each PDO guards its communication and mapping parameters in the dictionary. Whenever they change, the mapping
is compiled to one ``struct`` and the bound readers or writers; a cycle only calls these.
"""

import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable

from hdbridge.device.dictionary import Abort, Dictionary, Entry, SdoAbortError, refusing

INVALID: Final = 1 << 31
EXTENDED: Final = 1 << 29
MAX_ENTRIES: Final = 8
MAX_BITS: Final = 64
SYNC_ACYCLIC: Final = 0
SYNC_EVERY: Final = 1
SYNC_LAST: Final = 240
EVENT_DRIVEN: Final = (254, 255)
DUMMIES: Final = range(0x0002, 0x0008)
"""Data types that an RPDO maps instead of an object to leave a gap."""


class Pdo:
    """Base class of transmit and receive PDOs: parameters, guards, compilation.

    ``changed`` is called after every change that concerns the node: identifier, type, mapping, timers.
    """

    def __init__(
        self, dictionary: Dictionary, communication: int, mapping: int, changed: Callable[[], None]
    ) -> None:
        self._dictionary = dictionary
        self._communication = communication
        self._mapping = mapping
        self._changed = changed
        self.valid = False
        self.can_id = 0
        self.transmission_type = 0
        self.is_synchronous = True
        """True if SYNC triggers the PDO."""
        self.event_timer_s = 0.0
        self.inhibit_s = 0.0
        self._codec = struct.Struct("<")
        self._install()
        self.compile()

    def _install(self) -> None:
        guards: dict[int, Callable[[int], None] | None] = {
            1: self._check_can_id,
            2: refusing(lambda value: value > SYNC_LAST and value not in EVENT_DRIVEN),
            3: partial(self._check_fixed, 3),
            5: None,
            6: partial(self._check_fixed, 6),
        }
        for sub, guard in guards.items():
            if (self._communication, sub) in self._dictionary:
                entry = self._dictionary[self._communication, sub]
                entry.guard, entry.follower = guard, self._recompile
        count = self._dictionary[self._mapping, 0]
        count.guard, count.follower = self._check_count, self._recompile
        for sub in range(1, MAX_ENTRIES + 1):
            if (self._mapping, sub) in self._dictionary:
                self._dictionary[self._mapping, sub].guard = self._check_mapped

    def _recompile(self, _: int) -> None:
        self.compile()
        self._changed()

    def compile(self) -> None:
        """Reads the current parameters from the dictionary and compiles the mapping."""
        can_id = self._parameter(1)
        self.valid = not can_id & INVALID
        self.can_id = can_id & 0x7FF
        self.transmission_type = self._parameter(2)
        self.is_synchronous = self.transmission_type <= SYNC_LAST
        self.inhibit_s = self._parameter(3) * 1e-4
        self.event_timer_s = self._parameter(5) * 1e-3
        count = self._dictionary.value(self._mapping, 0)
        try:
            entries = self._entries(count)
        except SdoAbortError:  # a default of the EDS that cannot be mapped: the PDO does not exist
            self._dictionary[self._mapping, 0].value = 0
            self._dictionary[self._communication, 1].value |= INVALID
            self.valid, entries = False, []
        self._codec = struct.Struct("<" + "".join(_format(entry) for entry in entries))
        self._link(entries)

    def _parameter(self, sub: int) -> int:
        """Returns a communication parameter; 0 if the drive does not have it."""
        there = (self._communication, sub) in self._dictionary
        return self._dictionary.value(self._communication, sub) if there else 0

    def _entries(self, count: int) -> list[Entry]:
        """Returns the mapped entries; refuses objects that cannot be mapped to this PDO."""
        words = [self._dictionary.open(self._mapping, sub).number() for sub in range(1, count + 1)]
        entries = [self._mapped(word) for word in words]
        if sum(entry.bits for entry in entries) > MAX_BITS:
            raise SdoAbortError(Abort.PDO_LENGTH)
        return entries

    def _link(self, entries: list[Entry]) -> None:
        raise NotImplementedError

    def restart(self) -> None:
        """Resets timers and pending data, as on entering NMT state OPERATIONAL."""
        raise NotImplementedError

    def _may_map(self, entry: Entry) -> bool:
        raise NotImplementedError

    def _mapped(self, word: int) -> Entry:
        """Returns the entry of a mapping word; refuses an entry that cannot be mapped to this PDO."""
        index, sub = word >> 16, word >> 8 & 0xFF
        entry = _gap(index) if index in DUMMIES and sub == 0 else self._dictionary.open(index, sub)
        if not entry.mappable or not self._may_map(entry) or entry.bits != word & 0xFF:
            raise SdoAbortError(Abort.NOT_MAPPABLE)
        return entry

    def _check_can_id(self, value: int) -> None:
        if self.valid and not value & INVALID and (value & ~INVALID) != self._parameter(1) & ~INVALID:
            raise SdoAbortError(Abort.STATE)  # CiA 301: bits 0 to 29 are fixed while the PDO exists
        if value & EXTENDED or not (value & INVALID or 0x181 <= value & 0x7FF <= 0x57F):
            raise SdoAbortError(Abort.RANGE)

    def _check_fixed(self, sub: int, value: int) -> None:
        """Refuses a different value while the PDO exists; some masters write the current one again."""
        if self.valid and value != self._parameter(sub):
            raise SdoAbortError(Abort.STATE)

    def _check_mapped(self, word: int) -> None:
        if self.valid or self._dictionary.value(self._mapping, 0) != 0:
            raise SdoAbortError(Abort.STATE)
        if word:
            self._mapped(word)

    def _check_count(self, count: int) -> None:
        if self.valid:
            raise SdoAbortError(Abort.STATE)
        if count > MAX_ENTRIES:
            raise SdoAbortError(Abort.PDO_LENGTH)
        self._entries(count)


class TransmitPdo(Pdo):
    """Transmit PDO: packs the mapped values and decides when they are sent."""

    def __init__(self, dictionary: Dictionary, number: int, changed: Callable[[], None]) -> None:
        self.pack: Callable[[], bytes] = bytes
        """Function that returns the data of the TPDO, packed from the current values."""
        self.sent: bytes | None = None
        self.sent_s = -float("inf")
        self.syncs_to_go = 1
        self.sync_start = 0
        """SYNC counter at which the PDO starts (SYNC start value); 0 once it has started."""
        self.on_sync: Callable[[], bytes | None] = bytes
        """Function that returns the data to send upon a SYNC, or None if the PDO is not due at this SYNC."""
        super().__init__(dictionary, 0x1800 + number - 1, 0x1A00 + number - 1, changed)

    def _may_map(self, entry: Entry) -> bool:
        return entry.readable

    def _link(self, entries: list[Entry]) -> None:
        self.pack = _packer(self._codec, [entry.reader() for entry in entries])
        by_type = {SYNC_ACYCLIC: self._if_changed, SYNC_EVERY: self.pack}
        self.on_sync = by_type.get(self.transmission_type, self._in_turn)
        self.restart()

    def restart(self) -> None:
        """Forgets the data last sent, as on entering NMT state OPERATIONAL."""
        self.sent = None
        self.sent_s = -float("inf")
        self.syncs_to_go = max(1, self.transmission_type)
        self.sync_start = self._parameter(6)

    def has_started(self, sync: bytearray) -> bool:
        """Returns True once a SYNC has the start value as counter, or if it has no counter (CiA 301)."""
        if sync and sync[0] != self.sync_start:
            return False
        self.sync_start, self.syncs_to_go = 0, 1
        return True

    def _if_changed(self) -> bytes | None:
        data = self.pack()
        if data == self.sent:
            return None
        self.sent = data
        return data

    def _in_turn(self) -> bytes | None:
        self.syncs_to_go -= 1
        if self.syncs_to_go:
            return None
        self.syncs_to_go = self.transmission_type
        return self.pack()

    def on_event(self, now_s: float) -> bytes | None:
        """Returns the data of an event-driven TPDO that is due (changed, or timer elapsed), else None."""
        if now_s < self.sent_s + self.inhibit_s:
            return None
        data = self.pack()
        timer_ran_out = self.event_timer_s > 0.0 and now_s >= self.sent_s + self.event_timer_s
        if data == self.sent and not timer_ran_out:
            return None
        self.sent, self.sent_s = data, now_s
        return data

    def due_s(self, now_s: float) -> float:
        """Returns the next time after ``now_s`` at which the PDO may be due: event timer, end of inhibit."""
        due_s = self.sent_s + self.event_timer_s if self.event_timer_s > 0.0 else float("inf")
        inhibited_until_s = self.sent_s + self.inhibit_s
        return min(due_s, inhibited_until_s) if inhibited_until_s > now_s else due_s


class ReceivePdo(Pdo):
    """Receive PDO; synchronous data waits in ``pending`` for the next SYNC.

    ``deadline_s`` is the time by which the next RPDO must arrive (event timer), armed by the first one.
    """

    def __init__(
        self, dictionary: Dictionary, number: int, changed: Callable[[], None], *, holds: bool = False
    ) -> None:
        """``holds`` states that data waiting for SYNC survive a change of the NMT state."""
        self._holds = holds
        self._writers: tuple[Callable[[int], None], ...] = ()
        self.length = 0
        """Length of the mapped data; bytes."""
        self.pending: bytearray | None = None
        self.deadline_s = float("inf")
        super().__init__(dictionary, 0x1400 + number - 1, 0x1600 + number - 1, changed)

    def _may_map(self, entry: Entry) -> bool:
        return entry.writable

    def _link(self, entries: list[Entry]) -> None:
        self._writers = tuple(entry.writer() for entry in entries)
        self.length, self._unpack_from = self._codec.size, self._codec.unpack_from
        self.pending = None  # data received with the previous mapping are discarded
        self.restart()

    def restart(self) -> None:
        """Disarms the deadline, and discards the data waiting for SYNC unless the drive keeps them."""
        if not self._holds:
            self.pending = None
        self.deadline_s = float("inf")

    def apply(self, data: bytearray) -> None:
        """Writes ``data``, ``length`` bytes or more, to the mapped entries; drops refused values."""
        for write, value in zip(self._writers, self._unpack_from(data), strict=True):
            try:
                write(value)
            except SdoAbortError:
                continue  # a PDO has no answer that could report it


def _gap(data_type: int) -> Entry:
    variable = ODVariable("gap", data_type)
    variable.data_type, variable.access_type, variable.pdo_mappable = data_type, "wo", True
    return Entry(variable)


def _format(entry: Entry) -> str:
    assert entry.codec is not None  # only such entries can be mapped
    return entry.codec.format.removeprefix("<")


def _packer(codec: struct.Struct, readers: Sequence[Callable[[], int]]) -> Callable[[], bytes]:
    """Returns a function that packs the readers' values; the unrolled code takes half the time of a loop."""
    called = {f"read{place}": reader for place, reader in enumerate(readers)}
    pack: Callable[[], bytes] = eval(
        f"lambda: pack({', '.join(f'{name}()' for name in called)})", {"pack": codec.pack, **called}
    )
    return pack
