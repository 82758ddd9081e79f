"""Checks of CiA 402 that need no power: objects, units, modes, and states up to *ready to switch on*."""

import struct
from collections.abc import Callable
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import RANGE, READ_ONLY, NodeTester, Table, expedited, pack, state_name
from hdbridge.drive.states import State, decode

CHECKS: Final = Table(drives=True)
check: Final = CHECKS.check
_PROFILE: Final = "CiA 402-2"
_STATES: Final = "CiA 402-2, finite state automaton"
_MODES: Final = "CiA 402-2, objects 6060h, 6061h, 6502h"
_OPTIONS: Final = "CiA 402-2, objects 605Ah to 605Eh, 6007h"
_DISABLED: Final = State.SWITCH_ON_DISABLED
_READY: Final = State.READY_TO_SWITCH_ON
_UNITS: Final = "CiA 402-2, objects 608Fh, 6091h, 6092h"
MODES: Final = {
    1: "profile position",
    2: "velocity (frequency converter)",
    3: "profile velocity",
    4: "torque profile",
    6: "homing",
    7: "interpolated position",
    8: "cyclic synchronous position",
    9: "cyclic synchronous velocity",
    10: "cyclic synchronous torque",
}


@check("402.type", "1000h has the profile number 402 and a drive's type", _PROFILE)
def _(t: NodeTester) -> None:
    kind = t.read(0x1000) >> 16 & 0xFF
    t.true(
        kind & 0x07, f"type {kind:02X}h", "frequency converter, servo drive or stepper motor (bits 0 to 2)"
    )


def _mandatory(index: int, size: int, name: str, *, writable: bool) -> None:
    @check(
        f"402.object.{index:04X}",
        f"{index:04X}h, {name}, exists with {size} byte{'s' * (size > 1)}",
        _PROFILE,
    )
    def _(t: NodeTester) -> None:
        data = t.upload(index)
        t.equal(len(data), size, "bytes")
        if not writable:
            t.aborts(expedited(index, 0, data), READ_ONLY, f"download to {index:04X}h")


_mandatory(0x6040, 2, "controlword", writable=True)
_mandatory(0x6041, 2, "statusword", writable=False)
_mandatory(0x6060, 1, "modes of operation", writable=True)
_mandatory(0x6061, 1, "modes of operation display", writable=False)
_mandatory(0x6502, 4, "supported drive modes", writable=False)


@check("402.modes", "6502h names at least one mode", _MODES)
def _(t: NodeTester) -> None:
    t.true(t.read(0x6502) & 0x3FF, f"6502h = {t.read(0x6502):08X}h", "a bit from 0 to 9")


def _mode(number: int, name: str) -> None:
    @check(
        f"402.mode.{number}", f"Mode {number}, {name}, is accepted if 6502h names it, else refused", _MODES
    )
    def _(t: NodeTester) -> None:
        if t.read(0x6502) >> number - 1 & 1:
            t.write(0x6060, 0, number, 1)
            t.wait(0.05)
            t.equal(t.read(0x6061, signed=True), number, "6061h")
        else:
            _refuses_mode(t, number)


for _number, _name in MODES.items():
    _mode(_number, _name)


@check("402.mode.reserved", "A reserved mode, 5, is refused or not displayed", _MODES)
def _(t: NodeTester) -> None:
    _refuses_mode(t, 5)


def _refuses_mode(t: NodeTester, number: int) -> None:
    t.write(0x6060, 0, t.read(0x6060, signed=True), 1)
    t.ask(expedited(0x6060, 0, pack(number, 1)))
    t.wait(0.05)
    t.true(t.read(0x6061, signed=True) != number, f"6061h = {number}", "another mode")


# ---------------------------------------------------------------- states without power


@check("402.state.reset", "After the NMT command reset node the drive reaches switch on disabled", _STATES)
def _(t: NodeTester) -> None:
    t.reset(NmtCommand.RESET_NODE)
    t.reaches(_DISABLED)


def ready(t: NodeTester) -> None:
    """Brings the drive to READY TO SWITCH ON."""
    t.disable()
    t.control(0x06)
    t.reaches(_READY)


def _leads(name: str, text: str, begin: Callable[[NodeTester], None], word: int, state: State) -> None:
    @check(f"402.state.{name}", text, _STATES, first=begin)
    def _(t: NodeTester) -> None:
        t.control(word)
        t.reaches(state)


_leads(
    "shutdown", "Shutdown leads from switch on disabled to ready to switch on (2)", NodeTester.disable,
    0x06, _READY,
)  # fmt: skip
for _name, _word, _command in (
    ("disable-voltage", 0x00, "Disable voltage"),
    ("quick-stop", 0x02, "Quick stop"),
):
    _leads(
        _name, f"{_command} leads from ready to switch on to switch on disabled (7)", ready, _word, _DISABLED
    )
_leads(
    "mode-bits", "Bits 4 to 6 and 8 of the controlword do not disturb shutdown", NodeTester.disable,
    0x176, _READY,
)  # fmt: skip


def _no_effect(name: str, word: int, text: str, state: State) -> None:
    @check(f"402.state.{name}", f"{text} changes nothing in {state.value}", _STATES)
    def _(t: NodeTester) -> None:
        (ready if state is _READY else NodeTester.disable)(t)
        t.control(word)
        t.stays(state)


_no_effect("disabled.disable-voltage", 0x00, "Disable voltage", _DISABLED)
_no_effect("disabled.quick-stop", 0x02, "Quick stop", _DISABLED)
_no_effect("disabled.fault-reset", 0x80, "Fault reset", _DISABLED)
_no_effect("ready.repeated", 0x06, "Repeated shutdown", _READY)


@check("402.state.stable", "The drive stays in ready to switch on without a command", _STATES, first=ready)
def _(t: NodeTester) -> None:
    t.stays(_READY, 0.5)


def _bit(name: str, bit: int, value: int, text: str, begin: Callable[[NodeTester], None]) -> None:
    @check(f"402.status.{name}", f"Bit {bit} of the statusword{text}", _STATES, first=begin)
    def _(t: NodeTester) -> None:
        t.equal(t.read(0x6041) >> bit & 1, value, f"bit {bit}")


_bit("quick-stop", 5, 1, " is 1 in ready to switch on", ready)
_bit("fault", 3, 0, " is 0 without a fault", NodeTester.disable)
_bit("remote", 9, 1, ", remote, is 1 while the controlword is obeyed", ready)
_bit("limit", 11, 0, ", internal limit, is 0 at rest without power", NodeTester.disable)


@check("402.error-code", "603Fh is 0 without a fault", "CiA 402-2, object 603Fh", 0x603F)
def _(t: NodeTester) -> None:
    t.disable()
    t.equal(t.read(0x603F), 0, "603Fh")


@check("402.controlword.read", "6040h reads as the controlword that was written", "CiA 402-2, object 6040h")
def _(t: NodeTester) -> None:
    ready(t)
    t.equal(t.read(0x6040), 0x06, "6040h")


@check("402.controlword.pdo", "The controlword is obeyed as an RPDO", _STATES, first=NodeTester.disable)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(0x1400, ((0x6040, 0, 16),), 255)
    t.nmt(NmtCommand.START)
    t.send(can_id, b"\x06\0")
    t.reaches(_READY)
    t.send(can_id, b"\0\0")
    t.reaches(_DISABLED)


@check("402.controlword.pdo.sync", "A synchronous controlword is obeyed at SYNC, not before", _STATES)
def _(t: NodeTester) -> None:
    t.disable()
    can_id = t.map_pdo(0x1400, ((0x6040, 0, 16),), 1)
    t.nmt(NmtCommand.START)
    t.send(can_id, b"\x06\0")
    t.stays(_DISABLED)
    t.sync()
    t.reaches(_READY)


@check("402.statusword.pdo", "A TPDO carries the statusword", _STATES, first=ready)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(0x1800, ((0x6041, 0, 16),), 1)
    t.nmt(NmtCommand.START)
    data = t.true(t.reply(can_id, t.sync), "no TPDO", "the statusword")
    t.equal(state_name(struct.unpack("<H", data)[0]), _READY.value, "state in the TPDO")


@check("402.statusword.event", "An event-driven statusword is sent when the state changes", _STATES)
def _(t: NodeTester) -> None:
    ready(t)
    can_id = t.map_pdo(0x1800, ((0x6041, 0, 16),), 255)
    t.nmt(NmtCommand.START)
    t.wait(0.05)
    frames = t.heard_after(can_id, 0.1, lambda: t.control(0x00))
    words = [struct.unpack("<H", frame.data)[0] for frame in frames]
    t.true(
        _DISABLED in map(decode, words),
        f"statuswords {[f'{word:04X}h' for word in words]}", "one in switch on disabled",
    )  # fmt: skip


# ---------------------------------------------------------------- option codes


def _reserved(name: str, text: str, clause: str, index: int, value: int, size: int = 2) -> None:
    @check(f"402.{name}.reserved", text, clause, index)
    def _(t: NodeTester) -> None:
        t.refuses_value(index, 0, pack(value, size), RANGE)


def _option(index: int, name: str, reserved: int, defined: tuple[int, ...]) -> None:
    text = f"{index:04X}h, {name}: the reserved value {reserved} is refused"
    _reserved(f"option.{index:04X}", text, _OPTIONS, index, reserved)

    @check(f"402.option.{index:04X}", f"{index:04X}h, {name}, holds a defined value", _OPTIONS, index)
    def _(t: NodeTester) -> None:
        data = t.upload(index)
        t.equal(len(data), 2, "bytes")
        value = int.from_bytes(data, "little", signed=True)
        t.true(value in defined or value < 0, f"{index:04X}h = {value}", f"one of {defined}")


_option(0x6007, "abort connection", 4, (0, 1, 2, 3))
_option(0x605A, "quick stop", 9, (0, 1, 2, 3, 4, 5, 6, 7, 8))
_option(0x605B, "shutdown", 2, (0, 1))
_option(0x605C, "disable operation", 2, (0, 1))
_option(0x605D, "halt", 5, (1, 2, 3, 4))
_option(0x605E, "fault reaction", 5, (0, 1, 2, 3, 4))


# ---------------------------------------------------------------- units and limits


def _ratio(index: int, name: str, words: str) -> None:
    @check(f"402.units.{name}", f"{index:04X}h: {words} are not 0", _UNITS, (index, 1))
    def _(t: NodeTester) -> None:
        found = [t.read(index, sub) for sub in (1, 2)]
        t.true(all(found), f"{index:04X}h = {found}", "both above 0")


_ratio(0x608F, "encoder", "increments and revolutions")
_ratio(0x6091, "gear", "motor and driving shaft revolutions")
_ratio(0x6092, "feed", "feed and driving shaft revolutions")


@check(
    "402.units.position", "6064h is 6063h · 6092h / (608Fh · 6091h) apart from a home offset", _UNITS,
    (0x608F, 1), (0x6091, 1), (0x6092, 1),
)  # fmt: skip
def _(t: NodeTester) -> None:
    t.require(0x6063)
    increments, turns, motor, shaft, feed, driven = (
        t.read(index, sub) for index in (0x608F, 0x6091, 0x6092) for sub in (1, 2)
    )
    scale = feed * shaft * turns / (increments * motor * driven)
    offset = t.read(0x607C, signed=True) if t.has(0x607C) else 0
    internal, actual = t.read(0x6063, signed=True), t.read(0x6064, signed=True)
    t.need(abs(internal) > 1000, "the axis is too near to zero to see a scale")
    t.true(
        abs(abs(actual - offset) - abs(internal) * scale) <= 2 + 0.001 * abs(internal) * scale,
        f"6064h = {actual} at 6063h = {internal}", f"{internal * scale:.0f}",
    )  # fmt: skip


@check(
    "402.limits.position", "607Dh: the lower position limit is below the upper one", "CiA 402-2, object 607Dh"
)
def _(t: NodeTester) -> None:
    t.require(0x607D, 1)
    low, high = (t.read(0x607D, sub, signed=True) for sub in (1, 2))
    t.true(low < high or low == high == 0, f"607Dh = {low}, {high}", "lower below upper")


def _positive(index: int, name: str) -> None:
    text, clause = f"{index:04X}h, {name}, is above 0", f"CiA 402-2, object {index:04X}h"

    @check(f"402.limits.{index:04X}", text, clause, index)
    def _(t: NodeTester) -> None:
        t.true(t.read(index), f"{index:04X}h = 0", "a value above 0")


_positive(0x607F, "max profile velocity")
_positive(0x6080, "max motor speed")
_positive(0x6081, "profile velocity")
_positive(0x6083, "profile acceleration")
_positive(0x6084, "profile deceleration")
_positive(0x6085, "quick stop deceleration")
_positive(0x6076, "motor rated torque")


@check("402.period", "60C2h is a period from 0.1 ms to 1 s", "CiA 402-2, object 60C2h", (0x60C2, 1))
def _(t: NodeTester) -> None:
    period_s = t.read(0x60C2, 1) * 10.0 ** t.read(0x60C2, 2, signed=True)
    t.true(1e-4 <= period_s <= 1.0, f"{period_s:g} s", "0.1 ms to 1 s")


@check("402.homing.methods", "Every method in 60E3h is accepted by 6098h", "CiA 402-2, objects 6098h, 60E3h")
def _(t: NodeTester) -> None:
    t.require(0x60E3)
    for sub in range(1, t.read(0x60E3) + 1):
        t.write(0x6098, 0, t.read(0x60E3, sub, signed=True), 1)


_reserved("homing", "A reserved homing method, 38, is refused", "CiA 402-2, object 6098h", 0x6098, 38, 1)
_reserved(
    "profile-type", "6086h, motion profile type: the reserved value 5 is refused", "CiA 402-2, object 6086h",
    0x6086, 5,
)  # fmt: skip


@check("402.following-error", "60F4h is 6062h minus 6064h", "CiA 402-2, object 60F4h", 0x60F4, 0x6062)
def _(t: NodeTester) -> None:
    error = t.read(0x60F4, signed=True)
    found = t.read(0x6062, signed=True) - t.read(0x6064, signed=True)
    noise = max(2, t.travel // 10)
    t.true(abs(error - found) <= noise, f"60F4h = {error}", f"about {found}")


@check("402.still", "The axis has not moved during the checks without power", _PROFILE)
def _(t: NodeTester) -> None:
    start = t.start_position
    t.need(start is not None, "the position at the start is not known")
    moved = t.read(0x6064, signed=True) - (start or 0)
    t.true(abs(moved) <= t.travel, f"moved by {moved}", f"at most {t.travel}")
