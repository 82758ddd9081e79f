"""Checks of CiA 402 that need no power: objects, units, modes, and states up to *ready to switch on*."""

import struct
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.steps import (
    control,
    holds,
    parametrised,
    reaches,
    reads,
    refuses,
    reset_node,
    stays,
)
from hdbridge.conformance.tester import (
    RANGE,
    READ_ONLY,
    NodeTester,
    Table,
    expedited,
    pack,
    state_name,
)
from hdbridge.drive.states import State, decode

CHECKS: Final = Table(drives=True)
check: Final = CHECKS.check
_PROFILE: Final = "CiA 402-2"
_STATES: Final = "CiA 402-2, finite state automaton"
_MODES: Final = "CiA 402-2, objects 6060h, 6061h, 6502h"
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


@parametrised
def _is_mandatory(t: NodeTester, index: int, size: int, *, writable: bool) -> None:
    data = t.upload(index)
    t.equal(len(data), size, "bytes")
    if not writable:
        t.aborts(expedited(index, 0, data), READ_ONLY, f"download to {index:04X}h")


@parametrised
def _takes_mode(t: NodeTester, number: int) -> None:
    if t.read(0x6502) >> number - 1 & 1:
        t.write(0x6060, 0, number, 1)
        t.wait(0.05)
        t.equal(t.read(0x6061, signed=True), number, "6061h")
    else:
        _refuses_mode(t, number)


def _refuses_mode(t: NodeTester, number: int) -> None:
    t.write(0x6060, 0, t.read(0x6060, signed=True), 1)
    t.ask(expedited(0x6060, 0, pack(number, 1)))
    t.wait(0.05)
    t.true(t.read(0x6061, signed=True) != number, f"6061h = {number}", "another mode")


CHECKS.rows(
    _PROFILE,
    *((f"402.object.{index:04X}", f"{index:04X}h, {name}, exists with {size} byte{'s' * (size > 1)}",
       _is_mandatory(index, size, writable=writable))
      for index, size, name, writable in (
          (0x6040, 2, "controlword", True),
          (0x6041, 2, "statusword", False),
          (0x6060, 1, "modes of operation", True),
          (0x6061, 1, "modes of operation display", False),
          (0x6502, 4, "supported drive modes", False))),
)  # fmt: skip
CHECKS.rows(
    _MODES,
    ("402.modes", "6502h names at least one mode",
     lambda t: t.true(t.read(0x6502) & 0x3FF, f"6502h = {t.read(0x6502):08X}h", "a bit from 0 to 9")),
    *((f"402.mode.{number}", f"Mode {number}, {name}, is accepted if 6502h names it, else refused",
       _takes_mode(number)) for number, name in MODES.items()),
    ("402.mode.reserved", "A reserved mode, 5, is refused or not displayed", lambda t: _refuses_mode(t, 5)),
)  # fmt: skip


# ---------------------------------------------------------------- states without power


def ready(t: NodeTester) -> None:
    """Brings the drive to READY TO SWITCH ON."""
    t.disable()
    t.control(0x06)
    t.reaches(_READY)


@parametrised
def _bit(t: NodeTester, bit: int, value: int) -> None:
    t.equal(t.read(0x6041) >> bit & 1, value, f"bit {bit}")


CHECKS.rows(
    _STATES,
    ("402.state.reset", "After the NMT command reset node the drive reaches switch on disabled", reset_node,
     reaches(_DISABLED)),
    ("402.state.shutdown", "Shutdown leads from switch on disabled to ready to switch on (2)",
     NodeTester.disable, control(0x06), reaches(_READY)),
    ("402.state.disable-voltage", "Disable voltage leads from ready to switch on to switch on disabled (7)",
     ready, control(0x00), reaches(_DISABLED)),
    ("402.state.quick-stop", "Quick stop leads from ready to switch on to switch on disabled (7)", ready,
     control(0x02), reaches(_DISABLED)),
    ("402.state.mode-bits", "Bits 4 to 6 and 8 of the controlword do not disturb shutdown",
     NodeTester.disable, control(0x176), reaches(_READY)),
    *((f"402.state.disabled.{name}", f"{text} changes nothing in switch on disabled", NodeTester.disable,
       control(word), stays(_DISABLED))
      for name, text, word in (
          ("disable-voltage", "Disable voltage", 0x00), ("quick-stop", "Quick stop", 0x02),
          ("fault-reset", "Fault reset", 0x80))),
    ("402.state.ready.repeated", "Repeated shutdown changes nothing in ready to switch on", ready,
     control(0x06), stays(_READY)),
    ("402.state.stable", "The drive stays in ready to switch on without a command", ready,
     stays(_READY, 0.5)),
    ("402.status.quick-stop", "Bit 5 of the statusword is 1 in ready to switch on", ready, _bit(5, 1)),
    ("402.status.fault", "Bit 3 of the statusword is 0 without a fault", NodeTester.disable, _bit(3, 0)),
    ("402.status.remote", "Bit 9 of the statusword, remote, is 1 while the controlword is obeyed", ready,
     _bit(9, 1)),
    ("402.status.limit", "Bit 11 of the statusword, internal limit, is 0 at rest without power",
     NodeTester.disable, _bit(11, 0)),
)  # fmt: skip
CHECKS.add(
    "402.error-code", "603Fh is 0 without a fault", "CiA 402-2, object 603Fh", 0x603F, NodeTester.disable,
    holds(0x603F, 0, 0),
)  # fmt: skip
CHECKS.add(
    "402.controlword.read", "6040h reads as the controlword that was written", "CiA 402-2, object 6040h",
    ready, holds(0x6040, 0, 0x06),
)  # fmt: skip


@check("402.controlword.pdo", "The controlword is obeyed as an RPDO", _STATES, NodeTester.disable)
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


@check("402.statusword.pdo", "A TPDO carries the statusword", _STATES, ready)
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


@parametrised
def _holds_one_of(t: NodeTester, index: int, defined: tuple[int, ...]) -> None:
    """A signed object of two bytes has a defined value or one of the manufacturer, which is negative."""
    data = t.upload(index)
    t.equal(len(data), 2, "bytes")
    value = int.from_bytes(data, "little", signed=True)
    t.true(value in defined or value < 0, f"{index:04X}h = {value}", f"one of {defined}")


for _index, _name, _reserved, _defined in (
    (0x6007, "abort connection", 4, (0, 1, 2, 3)),
    (0x605A, "quick stop", 9, (0, 1, 2, 3, 4, 5, 6, 7, 8)),
    (0x605B, "shutdown", 2, (0, 1)),
    (0x605C, "disable operation", 2, (0, 1)),
    (0x605D, "halt", 5, (1, 2, 3, 4)),
    (0x605E, "fault reaction", 5, (0, 1, 2, 3, 4)),
):
    _id, _object = f"402.option.{_index:04X}", f"{_index:04X}h, {_name}"
    CHECKS.rows(
        "CiA 402-2, objects 605Ah to 605Eh, 6007h",
        (f"{_id}.reserved", f"{_object}: the reserved value {_reserved} is refused", _index,
         refuses(_index, 0, pack(_reserved, 2), RANGE)),
        (_id, f"{_object}, holds a defined value", _index, _holds_one_of(_index, _defined)),
    )  # fmt: skip


# ---------------------------------------------------------------- units and limits


@parametrised
def _are_positive(t: NodeTester, index: int) -> None:
    found = [t.read(index, sub) for sub in (1, 2)]
    t.true(all(found), f"{index:04X}h = {found}", "both above 0")


CHECKS.rows(
    _UNITS,
    ("402.units.encoder", "608Fh: increments and revolutions are not 0", (0x608F, 1), _are_positive(0x608F)),
    ("402.units.gear", "6091h: motor and driving shaft revolutions are not 0", (0x6091, 1),
     _are_positive(0x6091)),
    ("402.units.feed", "6092h: feed and driving shaft revolutions are not 0", (0x6092, 1),
     _are_positive(0x6092)),
)  # fmt: skip


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
    t.need(abs(internal) > 1000, "the axis is too close to zero to check the scale")
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


for _index, _name in (
    (0x607F, "max profile velocity"), (0x6080, "max motor speed"), (0x6081, "profile velocity"),
    (0x6083, "profile acceleration"), (0x6084, "profile deceleration"),
    (0x6085, "quick stop deceleration"), (0x6076, "motor rated torque"),
):  # fmt: skip
    CHECKS.add(
        f"402.limits.{_index:04X}", f"{_index:04X}h, {_name}, is above 0",
        f"CiA 402-2, object {_index:04X}h", _index, reads(_index, 0, bool, "a value above 0"),
    )  # fmt: skip


@check("402.period", "60C2h is a period from 0.1 ms to 1 s", "CiA 402-2, object 60C2h", (0x60C2, 1))
def _(t: NodeTester) -> None:
    period_s = t.read(0x60C2, 1) * 10.0 ** t.read(0x60C2, 2, signed=True)
    t.true(1e-4 <= period_s <= 1.0, f"{period_s:g} s", "0.1 ms to 1 s")


@check("402.homing.methods", "Every method in 60E3h is accepted by 6098h", "CiA 402-2, objects 6098h, 60E3h")
def _(t: NodeTester) -> None:
    t.require(0x60E3)
    for sub in range(1, t.read(0x60E3) + 1):
        t.write(0x6098, 0, t.read(0x60E3, sub, signed=True), 1)


CHECKS.add(
    "402.homing.reserved", "A reserved homing method, 38, is refused", "CiA 402-2, object 6098h", 0x6098,
    refuses(0x6098, 0, pack(38, 1), RANGE),
)  # fmt: skip
CHECKS.add(
    "402.profile-type.reserved", "6086h, motion profile type: the reserved value 5 is refused",
    "CiA 402-2, object 6086h", 0x6086, refuses(0x6086, 0, pack(5, 2), RANGE),
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
