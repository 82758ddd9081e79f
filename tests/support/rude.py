"""CiA-402 drive that misbehaves as real makes do, written independently of the simulated drive.

It is a node of `VirtualClock`. Its plant is ideal: in *operation enabled* the motor goes to the target, at
most a quarter of a turn in each SYNC. `RudeDrive.ways` holds its bad manners, which a test may change at any
time.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace

import can
from can.interfaces.virtual import VirtualBus
from canopen.objectdictionary import ODVariable, import_od

from hdbridge.axis import AxisConfig
from hdbridge.drive.layout import Layout
from hdbridge.sim.lockstep import VirtualClock

NOT_READY, OFF, READY, ON, ENABLED, STOPPED, FAULT = 0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
"""State bits of the statusword, with quick stop active as STOPPED."""
_NMT = {0x01: 5, 0x02: 4, 0x80: 127}


@dataclass
class Ways:
    """Bad manners; all off by default."""

    keeps_power: bool = False
    """Power, controlword and the buffered RPDO survive a reset of the communication."""
    starts_itself: bool = False
    """Goes to OPERATIONAL after its boot-up message, with the PDOs configured before."""
    ignores_quick_stop: bool = False
    coasts: bool = False
    """In *operation enabled* with *quick stop* commanded, it keeps its last speed."""
    resumes: bool = False
    """Applies its last RPDO again at each SYNC."""
    ignores_enable: bool = False
    powers_itself: bool = False
    """Goes to *operation enabled* after each SYNC, whatever the controlword."""
    guards: bool = False
    """Sends no heartbeat."""
    mode_delay_s: float = 0.0
    boot_delay_s: float = 0.0
    boots_again_s: float = 0.0
    """Time after which it repeats its boot-up message; 0 if it does not."""
    loses_turns: int = 0
    """Motor turns by which its position is wrong after a restart."""
    sdo_delay_s: float = 0.0
    """Age of its SDO answers."""
    tpdo_again_s: float = 0.0
    """Time after which it sends its TPDOs a second time in each cycle, with new values; 0 if it does not."""
    runs_on: bool = False
    """Keeps its speed in modes without cyclic set-points."""
    stale_tpdos: int = 0
    """Number of SYNCs after a restart that it answers with its last TPDO."""
    status_delay: int = 0
    """Age of the statusword in its TPDO, in SYNCs."""
    reached: int | None = None
    """Statusword bits 10, 12 and 13 in HM and PP, whatever happens; None if it sets them correctly."""
    heals: bool = False
    """A fault ends without a reset, with an emergency 0000h."""
    words: deque[int] = field(default_factory=deque)
    """Statuswords of the next TPDOs, in place of the true one."""
    jumps: deque[int] = field(default_factory=deque)
    """Errors of the position in the next TPDOs, counts."""
    mute_sdo: deque[bool] = field(default_factory=deque)
    """True for each coming SDO request that it obeys but does not answer."""
    mangles_sdo: deque[str] = field(default_factory=deque)
    """For each coming SDO answer: ``twice``, ``before`` (after the answer before), ``toggle``, ``abort``, or
    nothing."""


class RudeDrive:
    """One drive on a virtual channel."""

    def __init__(self, channel: str, axis: AxisConfig, clock: VirtualClock) -> None:
        node_id = axis.drive.node_id
        motor, load = round(axis.motor_encoder.counts_per_turn), round(axis.load_encoder.counts_per_turn)
        self.node_id, self.ways, self.faults = node_id, Ways(), self
        self._per_turn, self._load_per_motor = motor, load / axis.gear.ratio / motor
        self.motor_counts = 0
        self.state, self.nmt = OFF, 127
        self.claims_arrival = False
        """True from its first set-point in PP on; it does not move in PP."""
        self.powered = 0
        """Number of times that it entered *operation enabled*."""
        self.moved_s = 0.0
        """Time of the last motion."""
        self.firmware = SimpleNamespace(motion=SimpleNamespace(machine=self))
        self._bus, self._clock = VirtualBus(channel), clock
        self._types: dict[tuple[int, int], ODVariable] = {}
        self._values: dict[tuple[int, int], int] = {}
        od = import_od(str(axis.eds_path), node_id)
        for entry in od.values():
            for each in [entry] if isinstance(entry, ODVariable) else entry.values():
                self._types[each.index, each.subindex] = each
                default = each.value if each.value is not None else each.default
                self._values[each.index, each.subindex] = default if isinstance(default, int) else 0
        self._values |= {
            (0x608F, 1): motor, (0x608F, 2): 1, (0x6092, 1): motor, (0x6092, 2): 1, (0x6091, 1): 1,
            (0x6091, 2): 1, (0x60E6, 1): load, (0x60EB, 1): 1, (0x6076, 0): 320, (0x607E, 0): 0,
        }  # fmt: skip
        self._kept = dict(self._values)
        self._rpdo: bytes | None = None
        self._speed = 0
        self._events: list[tuple[float, Callable[[], None]]] = []
        self._booting = False
        self._zero = 0
        self._beat_s = self._heal_s = float("inf")
        self._heard_s: float | None = None
        self._words: deque[int] = deque(maxlen=64)
        self._sent: list[tuple[int, bytes]] = []
        self._answer = b""
        self._segments: tuple[bytes, int] | None = None
        self.silent = self.mute_heartbeat = False
        self.drop_tpdos = self.shorten_tpdos = self.duplicate_tpdos = self.hold_tpdos = 0
        """Numbers of the next SYNCs whose TPDOs are dropped, too short, sent twice, or sent later."""
        self.load_jump_counts = 0
        self._held: list[tuple[int, bytes]] = []
        self._send(0x700 + node_id, b"\0")

    # ---------------------------------------------------------------- bus

    def close(self) -> None:
        self._bus.shutdown()

    def next_event_s(self) -> float:
        due = [self._beat_s, self._heal_s, *(each[0] for each in self._events)]
        if self._heard_s is not None:
            due.append(self._heard_s + (self[0x1016, 1] & 0xFFFF) / 1e3)
        return min(due)

    def poll(self, now_s: float) -> None:
        while (message := self._bus.recv(0)) is not None:
            if not message.is_extended_id and not message.is_remote_frame:
                self._take(message.arbitration_id, bytes(message.data), now_s)
        for event in [each for each in self._events if each[0] <= now_s]:
            self._events.remove(event)
            event[1]()
        if now_s >= self._heal_s:
            self._heal_s = float("inf")
            if self.state == FAULT:
                self.state = OFF
                self._send(0x80 + self.node_id, bytes(8))
        if now_s >= self._beat_s:
            self._send(0x700 + self.node_id, bytes((self.nmt,)))
            self._beat_s = now_s + self[0x1017, 0] / 1e3
        if self._heard_s is not None and now_s >= self._heard_s + (self[0x1016, 1] & 0xFFFF) / 1e3:
            self._heard_s = None
            self.lose_master()

    def _send(self, can_id: int, data: bytes) -> None:
        if self.silent or (self.mute_heartbeat and can_id == 0x700 + self.node_id):
            return
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def _take(self, can_id: int, data: bytes, now_s: float) -> None:
        if self._booting:
            return
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node_id):
            if data[0] in (0x81, 0x82):
                self.restart(everything=not self.ways.keeps_power)
            else:
                self.nmt = _NMT.get(data[0], self.nmt)
        elif can_id == 0x080:
            self._sync()
        elif can_id == 0x200 + self.node_id and self.nmt == 5 and len(data) == 6:
            self._rpdo = data
        elif can_id == 0x600 + self.node_id and len(data) == 8 and self.nmt != 0:
            self._sdo(data, now_s)
        elif can_id == 0x700 + (self[0x1016, 1] >> 16 & 0x7F) and self[0x1016, 1] & 0xFFFF:
            self._heard_s = now_s

    # ---------------------------------------------------------------- what a test may do to it

    def restart(self, *, everything: bool = True, lasts: bool = True) -> None:
        """Restarts; without ``everything``, only its communication. ``lasts`` keeps its parameters."""
        if everything:
            self.state, self._rpdo, self._speed = OFF, None, 0
        if not lasts:
            self._values = dict(self._kept)
        self._heard_s, self._beat_s, self.nmt = None, float("inf"), 0
        self._values[0x1016, 1] = self._values[0x1017, 0] = 0
        self._events, self._booting = [], True
        self._after(self.ways.boot_delay_s, self._booted)

    def configure(self, tpdos: Iterable[Layout]) -> None:
        """Makes it OPERATIONAL in CSP with these PDOs, as if a master had booted it."""
        self.nmt = 5
        self._values[0x6061, 0] = 8
        for layout in tpdos:
            place, entries = layout.number - 1, layout.codec.entries
            self._values[0x1800 + place, 1] = layout.can_id
            self._values[0x1A00 + place, 0] = len(entries)
            for sub, entry in enumerate(entries, 1):
                self._values[0x1A00 + place, sub] = entry.mapping

    def _booted(self) -> None:
        self.nmt, self._booting = 5 if self.ways.starts_itself else 127, False
        self._zero = self.ways.loses_turns * self._per_turn
        self._send(0x700 + self.node_id, b"\0")
        if self.ways.boots_again_s:
            self._after(self.ways.boots_again_s, lambda: self._send(0x700 + self.node_id, b"\0"))

    def _after(self, delay_s: float, happens: Callable[[], None]) -> None:
        self._events.append((self._clock.now() + delay_s, happens))

    def swap_mode(self, mode: int) -> None:
        """Changes the mode of operation, which nobody requested."""
        self._values[0x6061, 0] = mode

    def boot_up(self) -> None:
        self.restart()

    def leave_operational(self) -> None:
        self.nmt = 127

    def lose_master(self, code: int = 0x8130) -> None:
        """Stops because its master is silent, and sends an emergency."""
        if self.state == ENABLED:
            self.miss_master(code)
            self._send(0x80 + self.node_id, struct.pack("<HB5x", code, 0x11))

    def miss_master(self, code: int = 0) -> None:
        """Stops without an emergency."""
        if self.state == ENABLED:
            self.state = STOPPED if self[0x605A, 0] > 4 else OFF
            self._speed = 0

    def raise_error(self, code: int) -> None:
        self.state, self._speed = FAULT, 0
        self._values[0x603F, 0] = code
        self._send(0x80 + self.node_id, struct.pack("<HB5x", code, 1))
        if self.ways.heals:
            self._heal_s = self._clock.now() + 0.02

    # ---------------------------------------------------------------- profile

    def __getitem__(self, key: tuple[int, int]) -> int:
        return self._values[key]

    def statusword(self) -> int:
        word = self.state | 0x210 | (0x20 if self.state in (OFF,) else 0)
        if self[0x6061, 0] == 8:
            return word | (0x1000 if self.state == ENABLED else 0)
        done = self.ways.reached
        if done is None and self[0x6061, 0] == 1:
            return word | (0x1000 if self[0x6040, 0] & 0x10 else 0x400 * self.claims_arrival)
        return word | (0x1400 if done is None and self.state == ENABLED else done or 0)

    def _control(self, word: int) -> None:
        before, state = self._values[0x6040, 0], self.state
        self.claims_arrival |= bool(word & 0x10)
        self._values[0x6040, 0] = word
        if state == FAULT:
            if word & 0x80 and not before & 0x80:
                self.state = OFF
        elif not word & 0x02:
            self.state = OFF
        elif not word & 0x04:
            if state in (READY, ON):
                self.state = OFF
            elif state == ENABLED and not self.ways.ignores_quick_stop:
                self.state = STOPPED if self[0x605A, 0] > 4 else OFF
        elif word & 0x0F == 0x06 and state in (OFF, READY, ON, ENABLED):
            self.state = READY
        elif word & 0x0F == 0x07 and state in (READY, ON, ENABLED):
            self.state = ON
        elif word & 0x0F == 0x0F and state in (ON, STOPPED) and not self.ways.ignores_enable:
            self.state = ENABLED
            self.powered += 1
        if self.state != ENABLED:
            self._speed = 0

    def _sync(self) -> None:
        if self.nmt != 5:
            return
        if self._rpdo is not None:
            word, target = struct.unpack("<Hi", self._rpdo)
            if not self.ways.resumes:
                self._rpdo = None
            self._values[0x607A, 0] = target
            self._control(word)
        if self.ways.powers_itself:
            self.state = ENABLED
        self._move()
        if self.ways.stale_tpdos and self._sent:
            self.ways.stale_tpdos -= 1
        else:
            self._sent = self._tpdos()
        frames, self._held = [*self._held, *self._sent], []
        if self._count("drop_tpdos"):
            frames = []
        if self._count("shorten_tpdos"):
            frames = [(can_id, data[:-1]) for can_id, data in frames]
        if self._count("duplicate_tpdos"):
            frames *= 2
        if self._count("hold_tpdos"):
            frames, self._held = [], frames
        for frame in frames:
            self._send(*frame)
        if self.ways.tpdo_again_s:
            self._after(self.ways.tpdo_again_s, self._send_again)

    def _send_again(self) -> None:
        for frame in self._tpdos():
            self._send(*frame)

    def _count(self, fault: str) -> bool:
        left: int = getattr(self, fault)
        setattr(self, fault, max(left - 1, 0))
        return left > 0

    def _move(self) -> None:
        cyclic = self[0x6061, 0] == 8
        if self.state != ENABLED or not (cyclic or self.ways.runs_on):
            return
        if cyclic and not (self.ways.coasts and not self[0x6040, 0] & 0x04):
            most = self._per_turn // 4
            self._speed = max(-most, min(most, self[0x607A, 0] - self._zero - self.motor_counts))
        self.motor_counts += self._speed
        if self._speed:
            self.moved_s = self._clock.now()

    def _tpdos(self) -> list[tuple[int, bytes]]:
        ways = self.ways
        self._words.append(self.statusword())
        word = self._words[-1 - min(ways.status_delay, len(self._words) - 1)]
        live = self._live()
        live[0x6041] = ways.words.popleft() if ways.words else word
        live[0x6064] += ways.jumps.popleft() if ways.jumps else 0
        frames = []
        for number in range(4):
            identifier, data = self[0x1800 + number, 1], b""
            for sub in range(1, self[0x1A00 + number, 0] + 1):
                entry = self[0x1A00 + number, sub]
                bits, index = entry & 0xFF, entry >> 16
                value = live[index] if index in live else self._values.get((index, entry >> 8 & 0xFF), 0)
                data += (value & ((1 << bits) - 1)).to_bytes(bits // 8, "little")
            if data and not identifier >> 31:
                frames.append((identifier & 0x7FF, data))
        return frames

    def _live(self) -> dict[int, int]:
        """Values that the drive measures, by index."""
        shown = self.motor_counts + self._zero
        demand = self[0x607A, 0] if self.state == ENABLED else shown
        load = round(self.motor_counts * self._load_per_motor) + self.load_jump_counts
        return {
            0x6041: self.statusword(),
            0x6062: demand,
            0x6064: shown,
            0x6077: 0,
            0x60E4: load,
        }

    # ---------------------------------------------------------------- SDO server

    def _sdo(self, data: bytes, now_s: float) -> None:
        command, index, sub = struct.unpack_from("<BHB", data)
        key = index, sub
        if command == 0x80:
            return
        if command >> 5 == 3:
            self._reply(self._segment(command))
        elif key not in self._types:
            self._reply(struct.pack("<BHBI", 0x80, index, sub, 0x06020000))
        elif command >> 5 == 2:
            self._reply(self._read(key))
        elif command >> 5 == 1:
            kind = self._types[key]
            size = len(kind) // 8 or 4
            signed = kind.data_type in (2, 3, 4, 0x15)
            self._write(key, int.from_bytes(data[4 : 4 + size], "little", signed=signed), now_s)
            self._reply(struct.pack("<BHB4x", 0x60, index, sub))

    def _read(self, key: tuple[int, int]) -> bytes:
        kind = self._types[key]
        size = len(kind) // 8 if kind.data_type not in (9, 10, 15) else 0
        if not size:
            self._segments = b"rude", 0
            return struct.pack("<BHBI", 0x41, *key, 4)
        value = self._live().get(key[0], self[key]) & ((1 << 8 * size) - 1)
        return struct.pack("<BHBI", 0x43 | (4 - size) << 2, *key, value)

    def _segment(self, command: int) -> bytes:
        text, toggle = self._segments or (b"", 0)
        wrong = bool(self.ways.mangles_sdo) and self.ways.mangles_sdo[0] == "toggle"
        return bytes(((toggle ^ (0x10 if wrong else 0)) | (7 - len(text)) << 1 | 1,)) + text.ljust(7, b"\0")

    def _reply(self, answer: bytes) -> None:
        before, self._answer = self._answer, answer
        if self.ways.mute_sdo and self.ways.mute_sdo.popleft():
            return
        way = self.ways.mangles_sdo.popleft() if self.ways.mangles_sdo else ""
        abort = struct.pack("<B3sI", 0x80, answer[1:4], 0x08000000)
        frames = {"twice": [answer, answer], "before": [before, answer], "abort": [abort]}.get(way, [answer])
        for frame in filter(None, frames):
            if self.ways.sdo_delay_s:
                self._after(self.ways.sdo_delay_s, partial(self._send, 0x580 + self.node_id, frame))
            else:
                self._send(0x580 + self.node_id, frame)

    def _write(self, key: tuple[int, int], value: int, now_s: float) -> None:
        if key == (0x6040, 0):
            self._control(value)
            return
        self._values[key] = value
        if key == (0x6060, 0):
            self._after(self.ways.mode_delay_s, lambda: self.swap_mode(value))
        elif key == (0x1017, 0):
            self._beat_s = now_s + value / 1e3 if value and not self.ways.guards else float("inf")
        elif key == (0x1016, 1):
            self._heard_s = None
