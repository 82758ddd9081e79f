"""Trace of the master on the outer bus: its configuration, its actions and its mistakes.

It takes frames and returns lines, without I/O. It sends nothing, so it may observe a bus in operation or read
a bus log.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from statistics import median
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODVariable
from canopen.sdo.exceptions import SdoAbortedError

from hdbridge.cia301 import NmtCommand, NmtState, wrap_int32
from hdbridge.drive.dictionary import find
from hdbridge.drive.emergencies import gateway_error
from hdbridge.drive.link import Frame
from hdbridge.drive.states import Command, State, decode

_MULTIPLEXER: Final = struct.Struct("<BHB")
_NMT: Final = {int(each): each.name.lower().replace("_", " ").replace("pre ", "pre-") for each in NmtCommand}
_NMT_STATES: Final = {int(each): each.name.replace("_", "-") for each in NmtState}
_CYCLIC: Final = (7, 8)
_READY: Final = (State.READY_TO_SWITCH_ON, State.SWITCHED_ON)
_INVALID: Final = 1 << 31
_LATE: Final = 1.5
"""Ratio of a SYNC interval to the period above which a SYNC counts as missing; after four periods without
SYNC, the gateway stops the axis."""
_QUIET_S: Final = 1.0
"""Time without an expected SYNC or heartbeat after which the master is at fault."""
_PDO_ADVICE: Final = (
    "to change a PDO: set bit 31 of its identifier, set the number of mapped objects to 0, write the entries "
    "and their number, then the identifier without bit 31"
)
_ADVICE: Final = {
    0x0601_0002: "the object is read-only",
    0x0602_0000: "the gateway does not have the object: use the EDS of 'hdbridge gateway eds'",
    0x0604_0041: "the object cannot be mapped to this PDO; see PDOMapping and AccessType in the EDS",
    0x0604_0042: "a PDO has at most eight bytes",
    0x0607_0010: "the length does not fit the type in the EDS",
    0x0607_0012: "the length does not fit the type in the EDS",
    0x0607_0013: "the length does not fit the type in the EDS",
    0x0609_0011: "the gateway does not have the sub-index: use the EDS of 'hdbridge gateway eds'",
    0x0800_0022: "not in this state: disable the drive first",
}
_LSS: Final = {
    0x11: ("node id", "node ids are 1 to 127, or 255 for none"),
    0x13: ("bit timing", "the bit rate is that of the interface: 'bitrate_bps' in the machine file"),
    0x17: ("store configuration", "the node id that lasts is that of the machine file: change it there"),
}
"""Names of LSS services with an effect, and the advice if they are refused."""
_LSS_FOUND: Final = {
    0x44: "LSS: a node is selected by its identity",
    0x4F: "LSS: a node is identified",
    0x50: "LSS: a node has no node id",
}


@dataclass(frozen=True)
class Line:
    """One line of the trace."""

    time_s: float
    text: str
    advice: str = ""
    """Advice to the author of the master; empty without a mistake."""


class Trace:
    """Trace of one node. ``od`` is the object dictionary from its EDS."""

    def __init__(self, node_id: int, od: ObjectDictionary) -> None:
        self._node, self._od = node_id, od
        self._values = _defaults(od)
        self.written: dict[tuple[int, int], int] = {}
        """Parameters written by the master, in the order of the first write."""
        self._pending: tuple[int, int, bytes | None] | None = None
        self._lss = bytes(8)
        """Last LSS request."""
        self._nmt: int | None = None
        self._state: State | None = None
        self._word: int | None = None
        self._reset_since_s: float | None = None
        self._targets: list[int] = []
        self._position: int | None = None
        self._intervals_s: list[float] = []
        self._sync_s: float | None = None
        self._rpdos_since_sync = 0
        self._heartbeat_s: dict[int, float] = {}
        self._reported: set[str] = set()
        self.mistakes: Counter[str] = Counter()
        """Number of occurrences of each piece of advice."""
        self._begun_s: float | None = None
        self._time_s = 0.0
        """Time of the current frame."""
        self._lines: list[Line] = []

    # ---------------------------------------------------------------- frames

    def take(self, frame: Frame) -> list[Line]:
        """Takes a frame; returns the resulting lines."""
        self._lines, self._time_s = [], frame.time_s
        if self._begun_s is None:
            self._begun_s = frame.time_s
        can_id, data, node = frame.can_id, frame.data, self._node
        if can_id == 0x000 and len(data) >= 2 and data[1] in (0, node):
            self._say(f"NMT {_NMT.get(data[0], f'command {data[0]}')}")
        elif can_id == self._value(0x1005) & 0x7FF:
            self._on_sync()
        elif can_id == 0x700 + node and data:
            self._on_own_heartbeat(data[0])
        elif can_id & 0x780 == 0x700:
            self._heartbeat_s[can_id & 0x7F] = frame.time_s
        elif can_id == 0x600 + node and len(data) == 8:
            self._on_request(data)
        elif can_id == 0x580 + node and len(data) == 8:
            self._on_answer(data)
        elif can_id == 0x7E5 and len(data) == 8:
            self._lss = data
        elif can_id == 0x7E4 and len(data) == 8:
            self._on_lss_answer(data)
        elif can_id == self._value(0x1014) & 0x7FF and len(data) == 8:
            code = int.from_bytes(data[:2], "little")
            self._say(f"EMCY {gateway_error(code)}" if code else "EMCY: error reset")
        else:
            self._on_pdo(frame)
        self._watch()
        return self._lines

    def _say(self, text: str, advice: str = "") -> None:
        self._lines.append(Line(self._time_s, text, advice))
        if advice:
            self.mistakes[advice] += 1

    def _say_once(self, key: str, text: str, advice: str) -> None:
        """Reports a lasting mistake once, until `_over`."""
        if key not in self._reported:
            self._reported.add(key)
            self._say(text, advice)

    def _over(self, key: str) -> None:
        self._reported.discard(key)

    # ---------------------------------------------------------------- SDO

    def _on_request(self, data: bytes) -> None:
        command, index, sub = _MULTIPLEXER.unpack_from(data)
        if command >> 5 == 1:
            size = 4 - (command >> 2 & 3) if command & 1 else 4
            self._pending = index, sub, data[4 : 4 + size] if command & 2 else None
        elif command >> 5 == 2:
            self._pending = index, sub, None

    def _on_answer(self, data: bytes) -> None:
        command, index, sub = _MULTIPLEXER.unpack_from(data)
        pending, self._pending = self._pending, None
        if command == 0x80:
            self._on_abort(index, sub, int.from_bytes(data[4:], "little"), pending)
        elif command == 0x60 and pending is not None and pending[2] is not None:
            self._on_written(index, sub, pending[2])
        elif command & 0xE2 == 0x42:
            raw = data[4 : 8 - (command >> 2 & 3 if command & 1 else 0)]
            self._on_value(index, int.from_bytes(raw, "little"), sub)

    def _on_abort(
        self, index: int, sub: int, code: int, pending: tuple[int, int, bytes | None] | None
    ) -> None:
        what = self._name(index, sub)
        if pending is not None and pending[2] is not None:
            what += f" = {self._number(index, sub, pending[2])}"
        advice = _ADVICE.get(code, "the value is not possible; see the limits in the EDS")
        if 0x1400 <= index <= 0x1BFF and code in (0x0800_0022, 0x0609_0030, 0x0601_0000):
            advice = _PDO_ADVICE
        elif index == 0x6060:
            modes = [str(bit + 1) for bit in range(32) if self._value(0x6502) >> bit & 1]
            advice = f"the modes are {', '.join(modes)} (6502h)"
        elif (
            0x0609_0030 <= code <= 0x0609_0032
            and (variable := find(self._od, index, sub)) is not None
            and (variable.min, variable.max) != (None, None)
        ):
            advice = f"expected {variable.min} to {variable.max}"
        text = SdoAbortedError.CODES.get(code, "manufacturer-specific")
        self._say(f"{what}: refused with {code:08X}h ({text})", advice)

    def _on_written(self, index: int, sub: int, raw: bytes) -> None:
        value = self._number(index, sub, raw)
        if index == 0x6040:
            self._on_controlword(value & 0xFFFF)
            return
        if index == 0x607A:
            self._on_target(value)
            return
        self._values[index, sub] = self.written[index, sub] = value
        self._say(self._assignment(index, sub, value))

    def _on_value(self, index: int, value: int, sub: int) -> None:
        if index == 0x6041:
            self._on_statusword(value)
        elif (index, sub) in ((0x6064, 0), (0x6502, 0)):
            self._values[index, sub] = value
            if index == 0x6064:
                self._position = wrap_int32(value)

    def _on_lss_answer(self, data: bytes) -> None:
        """Reports a change by LSS, and a node that was found; inquiries change nothing."""
        command, value = self._lss[:2]
        if data[0] in (0x44, 0x4F, 0x50):
            self._say_once(f"LSS {data[0]}", _LSS_FOUND[data[0]], "")
        elif data[0] == command and command in _LSS:
            name, advice = _LSS[command]
            words = f"LSS {name}" + f" {value}" * (command == 0x11)
            refused = f": refused with error {data[1]}" if data[1] else ""
            self._say(words + refused, advice if refused else "")

    # ---------------------------------------------------------------- PDO and SYNC

    def _mapping(self, index: int) -> list[tuple[int, int, int]]:
        words = (self._value(index, place) for place in range(1, self._value(index, 0) + 1))
        return [(word >> 16, word >> 8 & 0xFF, (word & 0xFF) // 8) for word in words]

    def _on_pdo(self, frame: Frame) -> None:
        for first, receives in ((0x1400, True), (0x1800, False)):
            for index in range(first, first + 4):
                word = self._value(index, 1)
                if word & 0x7FF == frame.can_id and word and not word & _INVALID:
                    self._decode(frame, index, receives=receives)
                    return

    def _decode(self, frame: Frame, index: int, *, receives: bool) -> None:
        mapping = self._mapping(index + 0x200)
        length = sum(size for *_, size in mapping)
        if receives:
            self._rpdos_since_sync += 1
            if len(frame.data) != length:
                key = f"length of {frame.can_id:03X}h"
                self._say_once(
                    key, f"RPDO {frame.can_id:03X}h has {len(frame.data)} bytes",
                    f"{length} bytes are mapped in {index + 0x200:04X}h",
                )  # fmt: skip
                return
            if self._nmt not in (None, 0x05):
                state = _NMT_STATES.get(self._nmt or 0, "reset")
                advice = "RPDOs count in OPERATIONAL only: NMT start first"
                self._say_once("early", f"RPDO {frame.can_id:03X}h in {state}", advice)
        place = 0
        for index_, sub, size in mapping:
            value = int.from_bytes(frame.data[place : place + size], "little")
            place += size
            if index_ == 0x6040:
                self._on_controlword(value)
            elif index_ == 0x607A:
                self._on_target(wrap_int32(value))
            else:
                self._on_value(index_, value, sub)

    def _on_sync(self) -> None:
        before_s, self._sync_s = self._sync_s, self._time_s
        self._over("no SYNC")
        if before_s is None:
            return
        interval_s = self._time_s - before_s
        usual_s = self.period_s
        self._intervals_s = [*self._intervals_s[-999:], interval_s]
        if usual_s is not None and interval_s > _LATE * usual_s and len(self._intervals_s) > 10:
            self._say(
                f"SYNC after {1000 * interval_s:.1f} ms, usually {1000 * usual_s:.2f} ms",
                "SYNC must be periodic: four periods without it stop the axis in a cyclic mode (8700h)",
            )  # fmt: skip
        if self._enabled_cyclic and not self._rpdos_since_sync:
            self._say_once(
                "no RPDO", "SYNC without an RPDO while enabled in a cyclic mode",
                "send a target before every SYNC; without one the axis stops at the last",
            )  # fmt: skip
        elif self._rpdos_since_sync:
            self._over("no RPDO")
        self._rpdos_since_sync = 0

    @property
    def period_s(self) -> float | None:
        """Median interval of SYNC; None before the third SYNC."""
        return median(self._intervals_s) if len(self._intervals_s) > 1 else None

    @property
    def jitter_s(self) -> float:
        """Largest deviation of an interval of SYNC from the median."""
        period_s = self.period_s or 0.0
        return max((abs(each - period_s) for each in self._intervals_s), default=0.0)

    # ---------------------------------------------------------------- the drive

    @property
    def _enabled_cyclic(self) -> bool:
        return self._state is State.OPERATION_ENABLED and self._value(0x6060) in _CYCLIC

    def _on_controlword(self, word: int) -> None:
        before, self._word = self._word, word
        if not word & 0x80:
            self._reset_since_s = None
            self._over("reset")
        elif self._reset_since_s is None:
            self._reset_since_s = self._time_s
        elif word != before or (self._state is State.FAULT and self._time_s - self._reset_since_s > 0.2):
            self._say_once(
                "reset", f"controlword {word:04X}h: fault reset held",
                "bit 7 acts by its rising edge, and no other command acts while it is set: take it back to 0",
            )  # fmt: skip
        if word == before:
            return
        advice = ""
        if word & 0x8F == 0x0F and self._state is State.SWITCH_ON_DISABLED:
            advice = "no transition from switch on disabled: send 0006h, wait, then 0007h, then 000Fh"
        elif word & 0x8F in (0x06, 0x07, 0x0F) and self._state is State.FAULT:
            advice = "the drive is in fault: an edge of bit 7 resets it"
        elif word & 0x8F == 0x0F and self._state in _READY and self._value(0x6060) in _CYCLIC:
            advice = self._start_advice()
        self._say(f"controlword {word:04X}h: {_command(word)}", advice)

    def _start_advice(self) -> str:
        if not self._targets or self._position is None:
            return ""
        off = self._targets[-1] - self._position
        if abs(off) <= self._value(0x6065):
            return ""
        return f"the target is {off} increments from 6064h: set it to the actual position before enabling"

    def _on_statusword(self, word: int) -> None:
        state = decode(word & 0xFFFF)
        if state is not self._state:
            self._say(f"statusword {word:04X}h: {state.value}")
            self._state = state
            self._targets = self._targets[-1:]

    def _on_target(self, target: int) -> None:
        low, high = self._value(0x607D, 1), self._value(0x607D, 2)
        if low < high and not low <= target <= high:
            self._say_once("limit", f"607Ah = {target}", f"the software limits (607Dh) are {low} to {high}")
        else:
            self._over("limit")
        if self._enabled_cyclic and self._targets and (period_s := self.period_s):
            speed = abs(target - self._targets[-1]) / period_s
            fastest = self._value(0x607F)
            if fastest and speed > 1.01 * fastest:
                step = target - self._targets[-1]
                self._say_once(
                    "speed", f"607Ah moved by {step} in one SYNC: {speed:.0f} inc/s",
                    f"the axis is not faster than 607Fh = {fastest} inc/s; it lags behind such targets",
                )  # fmt: skip
            else:
                self._over("speed")
        self._targets = [target]

    def _on_own_heartbeat(self, state: int) -> None:
        if state == 0:
            self._values = _defaults(self._od)
            self.written.clear()
            self._say("boot-up: parameters that were not saved (1010h) are those of the EDS")
        elif state & 0x7F != self._nmt:
            self._say(f"NMT state {_NMT_STATES.get(state & 0x7F, f'{state:02X}h')}")
        self._nmt = state & 0x7F or 0x7F

    def _watch(self) -> None:
        """Checks for missing frames."""
        assert self._begun_s is not None
        heard_s = self._sync_s if self._sync_s is not None else self._begun_s
        if self._enabled_cyclic and self._time_s - heard_s > _QUIET_S:
            self._say_once(
                "no SYNC", f"no SYNC for {_QUIET_S:g} s while enabled in a cyclic mode",
                "cyclic modes need SYNC; 1005h has its identifier",
            )  # fmt: skip
        word = self.written.get((0x1016, 1), 0)
        watched, wanted_s = word >> 16 & 0x7F, 1e-3 * (word & 0xFFFF)
        beat_s = self._heartbeat_s.get(watched, self._begun_s)
        if watched and wanted_s and self._time_s - beat_s > max(_QUIET_S, wanted_s):
            self._say_once(
                "heartbeat",
                f"1016h:01 expects node {watched} every {1000 * wanted_s:.0f} ms; none is heard",
                "let the master send its heartbeat, or write 0 to 1016h:01",
            )  # fmt: skip
        else:
            self._over("heartbeat")

    # ---------------------------------------------------------------- names and values

    def configured(self) -> list[str]:
        """Returns the master's configuration, one line per item."""
        lines = [self._assignment(*key, value) for key, value in self.written.items()]
        period_s = self.period_s
        if period_s is not None:
            lines.append(f"SYNC every {1000 * period_s:.3f} ms, at most {1000 * self.jitter_s:.3f} ms off")
            set_s = self._value(0x60C2, 1) * 10.0 ** self._value(0x60C2, 2)
            if (0x60C2, 1) in self.written and abs(set_s - period_s) > 0.1 * period_s:
                lines.append(
                    f"60C2h is {1000 * set_s:g} ms; the gateway takes the period from SYNC, others do not"
                )
        return lines

    def _value(self, index: int, sub: int = 0) -> int:
        return self._values.get((index, sub), 0)

    def _name(self, index: int, sub: int) -> str:
        variable = find(self._od, index, sub)
        return f"{index:04X}h:{sub:02X}" + (f" '{variable.qualname}'" if variable is not None else "")

    def _assignment(self, index: int, sub: int, value: int) -> str:
        """Returns ``name = value``; 32-bit values of the communication profile are hexadecimal."""
        variable = find(self._od, index, sub)
        wide = 0x1000 <= index <= 0x1FFF and variable is not None and variable.data_type == 0x07
        return f"{self._name(index, sub)} = " + (f"{value & 0xFFFFFFFF:08X}h" if wide else str(value))

    def _number(self, index: int, sub: int, raw: bytes) -> int:
        variable = find(self._od, index, sub)
        signed = variable is not None and variable.data_type in (0x02, 0x03, 0x04)
        size = len(variable) // 8 if variable is not None and variable.data_type in range(2, 8) else len(raw)
        return int.from_bytes(raw[:size], "little", signed=signed)


def _command(word: int) -> str:
    """Returns the command of a controlword and its other bits, in words."""
    command = next(each for each in Command if word & each.mask == each.word)
    others = {0x10: "bit 4", 0x20: "bit 5", 0x40: "bit 6", 0x100: "halt"} if command.word < 0x80 else {}
    return ", ".join([command.label, *(text for bit, text in others.items() if word & bit)])


def _defaults(od: ObjectDictionary) -> dict[tuple[int, int], int]:
    """Returns the default values of the integers, by index and sub-index."""
    found: dict[tuple[int, int], int] = {}
    for item in od.values():
        for each in [item] if isinstance(item, ODVariable) else item.subindices.values():
            if isinstance(each.default, int):
                found[each.index, each.subindex] = each.default
    return found
