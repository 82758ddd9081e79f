"""Faults seeded into the simulated drive, one at a time: a named check of the conformance suite finds each.

A fault changes the frames between the node and the bus, or substitutes one behaviour.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import can
import pytest
from support.conformance import simulated_drive

import hdbridge.device.firmware as firmware_module
from hdbridge.canframe import DataFrame
from hdbridge.conformance import Verdict, checks
from hdbridge.conformance.suite import run_one
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.node import DriveNode
from hdbridge.device.powerstate import TRANSITIONS, Command, State, next_state

CHECKS = {each.id: each for each in checks(moves=True, stores=True)}
Frame = tuple[int, bytes]


class Spoiled:
    """A bus that changes what the node sends and receives."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.outgoing: Callable[[int, bytes], list[Frame]] = lambda can_id, data: [(can_id, data)]
        self.incoming: Callable[[can.Message], can.Message | None] = lambda message: message

    def send(self, message: can.Message) -> None:
        for can_id, data in self.outgoing(message.arbitration_id, bytes(message.data)):
            self.bus.send(DataFrame(can_id, data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        while (message := self.bus.recv(timeout)) is not None:
            if (taken := self.incoming(message)) is not None:
                return taken
        return None


Seed = Callable[[Any, DriveNode, Spoiled], None]
FAULTS: list[tuple[str, str, Seed]] = []


def fault(check: str, text: str) -> Callable[[Seed], Seed]:
    def add(seed: Seed) -> Seed:
        FAULTS.append((check, text, seed))
        return seed

    return add


def entry(check: str, text: str, index: int, sub: int, **changes: Any) -> None:
    """A fault of an entry of the dictionary: another value or guard."""

    @fault(check, text)
    def _(patch, node, bus):
        for name, value in changes.items():
            setattr(node.dictionary[index, sub], name, value)


def replace_entry(node: DriveNode, index: int, sub: int = 0, **changes: Any) -> None:
    """Put another entry with changed attributes in the place of one."""
    old = node.dictionary[index, sub]
    new = object.__new__(type(old))
    for name in type(old).__slots__:
        object.__setattr__(new, name, changes.get(name, getattr(old, name)))
    node.dictionary._entries[index, sub] = new


def another(check: str, text: str, index: int, **changes: Any) -> None:
    """A fault of the description of an entry."""

    @fault(check, text)
    def _(patch, node, bus):
        replace_entry(node, index, **changes)


def sends(check: str, text: str, change: Callable[[int, bytes], list[Frame]]) -> None:
    """A fault of the frames that the node sends."""

    @fault(check, text)
    def _(patch, node, bus):
        bus.outgoing = change


def when(wanted: Callable[[int, bytes], bool], change: Callable[[int, bytes], list[Frame]]) -> Any:
    return lambda can_id, data: change(can_id, data) if wanted(can_id, data) else [(can_id, data)]


def is_boot(can_id, data):
    return can_id == 0x701 and data == b"\0"


def is_beat(can_id, data):
    return can_id == 0x701 and data != b"\0"


def is_sdo(can_id, data):
    return can_id == 0x581


def begins(command, mask=0xFF):
    return lambda can_id, data: can_id == 0x581 and data[0] & mask == command


def is_segment(can_id, data):
    return can_id == 0x581 and data[0] & 0xE0 == 0 and data[0] & 0x0F != 0x0F


def is_abort(code):
    return lambda can_id, data: (
        can_id == 0x581 and data[:1] == b"\x80" and data[4:] == struct.pack("<I", code)
    )


def is_emergency(can_id, data):
    return can_id == 0x081


def is_tpdo(can_id, data):
    return can_id == 0x181


# ---------------------------------------------------------------- network management

sends("nmt.reset-communication", "no boot-up message", when(is_boot, lambda i, d: []))
sends("nmt.boot-up.frame", "boot-up message of two bytes", when(is_boot, lambda i, d: [(i, d + b"\0")]))
sends("nmt.boot-up.once", "two boot-up messages", when(is_boot, lambda i, d: [(i, d)] * 2))
sends(
    "heartbeat.toggle",
    "heartbeats with a toggle bit",
    when(is_beat, lambda i, d: [(i, bytes((d[0] | 0x80,)))]),
)
sends("heartbeat.frame", "heartbeats of two bytes", when(is_beat, lambda i, d: [(i, d + b"\0")]))
sends(
    "heartbeat.operational",
    "the state in heartbeats never changes",
    when(is_beat, lambda i, d: [(i, b"\x7f")]),
)
sends(
    "guarding.toggle",
    "the toggle bit of node guarding stays",
    when(is_beat, lambda i, d: [(i, bytes((d[0] & 0x7F,)))]),
)


@fault("heartbeat.period", "heartbeats at one and a half times the period")
def _(patch, node, bus):
    start = node._start_heartbeat

    def slower(_=None):
        start()
        node._heartbeat_s *= 1.5

    node.dictionary[0x1017, 0].follower = slower


@fault("heartbeat.off", "heartbeats do not end")
def _(patch, node, bus):
    start = node._start_heartbeat
    node.dictionary[0x1017, 0].follower = lambda value: start() if value else None


@fault("nmt.sdo.stopped", "SDO in STOPPED")
def _(patch, node, bus):
    listen = node._listen

    def always():
        listen()
        node._takers[0x601] = node._on_sdo_request

    node._listen = always


@fault("nmt.broadcast", "commands to all nodes are ignored")
def _(patch, node, bus):
    bus.incoming = lambda m: None if m.arbitration_id == 0 and bytes(m.data)[1:] == b"\0" else m


@fault("nmt.ignores.other-node", "commands to other nodes are obeyed")
def _(patch, node, bus):
    def to_us(message):
        if message.arbitration_id == 0 and len(message.data) == 2:
            return DataFrame(0, bytes((message.data[0], 1)))
        return message

    bus.incoming = to_us


@fault("nmt.ignores.extended", "29-bit identifiers are taken for 11-bit ones")
def _(patch, node, bus):
    bus.incoming = lambda m: DataFrame(m.arbitration_id, m.data) if m.is_extended_id else m


@fault("nmt.ignores.short", "a command of one byte is obeyed")
def _(patch, node, bus):
    bus.incoming = lambda m: (
        DataFrame(0, bytes(m.data) + b"\0") if not m.arbitration_id and len(m.data) == 1 else m
    )


@fault("nmt.reset-communication.parameters", "reset communication restores nothing")
def _(patch, node, bus):
    patch.setattr(node._parameters, "restore", lambda *range: None)


@fault("nmt.reset-communication.application", "reset communication restores everything")
def _(patch, node, bus):
    restore = node._parameters.restore
    patch.setattr(node._parameters, "restore", lambda *range: restore())


@fault("nmt.pdo.pre-operational", "TPDOs in PRE-OPERATIONAL")
def _(patch, node, bus):
    def also():
        node._sync_tpdos = [pdo for pdo in node._tpdos if pdo.valid and pdo.is_synchronous]

    route_differently(node, also)


def route_differently(node, also):
    """Do more whenever frames are assigned to PDOs."""
    route = node._route

    def routed():
        route()
        also()

    node._route = routed
    for pdo in (*node._tpdos, *node._rpdos):
        pdo._changed = routed


@fault("consumer.loss", "a lost heartbeat goes unnoticed")
def _(patch, node, bus):
    node.faults.ignore_lost_heartbeat = True


@fault("error-behaviour.0", "the node stays OPERATIONAL after a lost heartbeat")
def _(patch, node, bus):
    node.faults.stay_operational = True


@fault("consumer.loss.time", "the consumer waits three times too long")
def _(patch, node, bus):
    watch = node._watch_heartbeat

    def longer():
        watch()
        node._watched_s *= 3.0

    node._watch_heartbeat = longer


@fault("consumer.idle", "the consumer does not wait for the first heartbeat")
def _(patch, node, bus):
    watch = node._watch_heartbeat

    def at_once():
        watch()
        if node._watched_s:
            node._watch_due_s = node._now_s + node._watched_s
            node._due_s = node._now_s

    node._watch_heartbeat = at_once


@fault("consumer.other-node", "any heartbeat counts")
def _(patch, node, bus):
    bus.incoming = lambda m: DataFrame(0x77E, m.data) if 0x702 <= m.arbitration_id <= 0x77F else m


@fault("guarding.loss", "the life time is not supervised")
def _(patch, node, bus):
    node._stop_guarding = lambda: setattr(node, "_life_s", 0.0)
    for index in (0x100C, 0x100D):
        node.dictionary[index, 0].follower = None


@fault("guarding.toggle.first", "the toggle bit survives a reset")
def _(patch, node, bus):
    begin = node._begin

    def keeping():
        kept = node._guard_toggle
        begin()
        node._guard_toggle = kept

    node._begin = keeping


# ---------------------------------------------------------------- SDO

sends("sdo.answer.length", "answers of seven bytes", when(is_sdo, lambda i, d: [(i, d[:7])]))
sends("sdo.answer.once", "every answer twice", when(is_sdo, lambda i, d: [(i, d)] * 2))
sends("sdo.upload.4", "no size in an expedited answer",
      when(begins(0x43), lambda i, d: [(i, b"\x42" + d[1:])]))  # fmt: skip
sends("sdo.upload.segmented.toggle", "the toggle bit of segments stays",
      when(is_segment, lambda i, d: [(i, bytes((d[0] & ~0x10,)) + d[1:])]))  # fmt: skip
sends("sdo.upload.segmented", "a wrong size is announced",
      when(begins(0x41), lambda i, d: [(i, d[:4] + b"\x99" + d[5:])]))  # fmt: skip
sends("sdo.download.response", "garbage in the reserved bytes of a download response",
      when(begins(0x60), lambda i, d: [(i, d[:4] + b"\1\2\3\4")]))  # fmt: skip
sends("sdo.abort.no-object.upload", "a general abort code for a missing object",
      when(is_abort(0x06020000), lambda i, d: [(i, d[:4] + struct.pack("<I", 0x08000000))]))  # fmt: skip
sends("sdo.abort.no-sub.upload", "a missing sub-index is called a missing object",
      when(is_abort(0x06090011), lambda i, d: [(i, d[:4] + struct.pack("<I", 0x06020000))]))  # fmt: skip
sends("sdo.abort.multiplexer", "aborts do not name the object",
      when(is_abort(0x06020000), lambda i, d: [(i, b"\x80\0\0\0" + d[4:])]))  # fmt: skip
sends("sdo.block.upload.crc", "a wrong checksum of a block upload",
      when(begins(0xC1, 0xE3), lambda i, d: [(i, d[:1] + b"\x12\x34" + d[3:])]))  # fmt: skip


@fault("sdo.other-node", "requests to another node are answered")
def _(patch, node, bus):
    bus.incoming = lambda m: DataFrame(0x601, m.data) if m.arbitration_id == 0x602 else m


def unchecked_toggle(patch, node, bus):
    check = node._sdo._check_segment

    def any_toggle(command, *, uploading):
        return check(command & ~0x10 | node._sdo._toggle, uploading=uploading)

    patch.setattr(node._sdo, "_check_segment", any_toggle)


fault("sdo.upload.toggle-error", "the toggle bit of upload requests is not checked")(unchecked_toggle)
fault("sdo.download.segmented.toggle-error", "the toggle bit of download segments is not checked")(
    unchecked_toggle
)


@fault("sdo.upload.client-abort", "an abort of the client is ignored")
def _(patch, node, bus):
    bus.incoming = lambda m: None if m.arbitration_id == 0x601 and bytes(m.data)[:1] == b"\x80" else m


@fault("sdo.block.download.crc", "the checksum of a block download is not checked")
def _(patch, node, bus):
    end = node._sdo._end_download

    def unchecked(command, request):
        node._sdo._checks_crc = False
        return end(command, request)

    patch.setattr(node._sdo, "_end_download", unchecked)


@fault("sdo.block.download.sequence", "segments out of order are taken")
def _(patch, node, bus):
    take = node._sdo._take_segment

    def any_order(command, request):
        return take(command & 0x80 | node._sdo._sequence + 1, request)

    patch.setattr(node._sdo, "_take_segment", any_order)


@fault("sdo.block.upload.repeat", "segments are not sent again")
def _(patch, node, bus):
    acknowledged = node._sdo._acknowledged
    patch.setattr(node._sdo, "_acknowledged", lambda number, size: acknowledged(node._sdo._sequence, size))


another("sdo.abort.read-only", "1000h can be written", 0x1000, writable=True)


@fault("sdo.abort.too-long", "the length of a download is not checked")
def _(patch, node, bus):
    entry = node.dictionary[0x1017, 0]
    patch.setattr(type(entry), "check_length", lambda self, size: None)
    patch.setattr(
        type(entry), "write", lambda self, data: self.put(int.from_bytes(data[: self.codec.size], "little"))
    )


@fault("sdo.abort.value", "a refused value is stored")
def _(patch, node, bus):
    entry = node.dictionary[0x1017, 0]
    write = type(entry).write

    def careless(self, data):
        if self is entry:
            self.value = int.from_bytes(data, "little")
        write(self, data)

    patch.setattr(type(entry), "write", careless)


# ---------------------------------------------------------------- PDO

sends("tpdo.mapping.data", "the bytes of a TPDO are reversed", when(is_tpdo, lambda i, d: [(i, d[::-1])]))
sends("tpdo.mapping.order", "the objects of a TPDO are in reverse order",
      when(is_tpdo, lambda i, d: [(i, d[2:] + d[:2])]))  # fmt: skip
sends("tpdo.event-timer", "event-driven TPDOs are lost", when(is_tpdo, lambda i, d: []))


@fault("tpdo.sync.2", "a TPDO at every SYNC, whatever its transmission type")
def _(patch, node, bus):
    for pdo in node._tpdos:
        patch.setattr(pdo, "_in_turn", lambda pdo=pdo: pdo.pack())


@fault("tpdo.sync.0", "type 0 is sent at every SYNC")
def _(patch, node, bus):
    for pdo in node._tpdos:
        patch.setattr(pdo, "_if_changed", lambda pdo=pdo: pdo.pack())


@fault("tpdo.inhibit", "the inhibit time is ignored")
def _(patch, node, bus):
    for pdo in node._tpdos:
        compile_ = pdo.compile

        def without(pdo=pdo, compile_=compile_):
            compile_()
            pdo.inhibit_s = 0.0

        patch.setattr(pdo, "compile", without)


@fault("tpdo.inhibit.last", "a change within the inhibit time is lost")
def _(patch, node, bus):
    for pdo in node._tpdos:
        on_event = pdo.on_event

        def forgetful(now_s, pdo=pdo, on_event=on_event):
            if now_s < pdo.sent_s + pdo.inhibit_s:
                pdo.sent = pdo.pack()
            return on_event(now_s)

        patch.setattr(pdo, "on_event", forgetful)


@fault("tpdo.event.255", "a change is not sent")
def _(patch, node, bus):
    for pdo in node._tpdos:
        patch.setattr(pdo, "on_event", lambda now_s: None)


@fault("tpdo.disabled", "bit 31 of a TPDO is ignored")
def _(patch, node, bus):
    _always_valid(patch, node._tpdos)


@fault("rpdo.disabled", "bit 31 of an RPDO is ignored")
def _(patch, node, bus):
    _always_valid(patch, node._rpdos[:1])


def _always_valid(patch, pdos):
    for pdo in pdos:
        compile_ = pdo.compile

        def valid(pdo=pdo, compile_=compile_):
            pdo.valid = False
            compile_()
            pdo.valid, pdo._dictionary[pdo._communication, 1].guard = True, None

        patch.setattr(pdo, "compile", valid)
        for sub in range(9):
            pdo._dictionary[pdo._mapping, sub].guard = None


entry("tpdo.mapping.valid", "a mapping can be changed while the PDO exists", 0x1A00, 0, guard=None)
entry("rpdo.identifier.fixed", "the identifier can be changed while the PDO exists", 0x1400, 1, guard=None)
entry("tpdo.type.241", "reserved transmission types are accepted", 0x1800, 2, guard=None)


@fault("rpdo.mapping.read-only", "read-only objects can be received")
def _(patch, node, bus):
    patch.setattr(node._rpdos[0], "_may_map", lambda entry: True)
    replace_entry(node, 0x1001, mappable=True)


@fault("tpdo.mapping.too-many-bytes", "nine bytes can be mapped")
def _(patch, node, bus):
    pdo = node._tpdos[0]
    node.dictionary[0x1A00, 0].guard = lambda count: None
    patch.setattr(pdo, "compile", lambda: None)


@fault("rpdo.sync.before", "synchronous RPDOs act at once")
def _(patch, node, bus):
    for pdo in node._rpdos:
        compile_ = pdo.compile

        def at_once(pdo=pdo, compile_=compile_):
            compile_()
            pdo.is_synchronous = False

        patch.setattr(pdo, "compile", at_once)


@fault("rpdo.sync.last", "of two RPDOs the first counts")
def _(patch, node, bus):
    take = node._on_rpdo

    def first(pdo, data, now_s):
        if not (pdo.is_synchronous and pdo.pending is not None):
            take(pdo, data, now_s)

    node._on_rpdo = first


@fault("rpdo.sync.once", "an RPDO acts at every later SYNC")
def _(patch, node, bus):
    def again():
        for pdo in node._sync_rpdos:
            if pdo.pending is not None:
                pdo.apply(pdo.pending)

    node._apply_rpdos = again


@fault("rpdo.short", "a short RPDO is filled up with zeros")
def _(patch, node, bus):
    take = node._on_rpdo
    node._on_rpdo = lambda pdo, data, now_s: take(pdo, bytearray(bytes(data).ljust(pdo.length, b"\0")), now_s)


@fault("rpdo.long", "an RPDO that is too long is ignored")
def _(patch, node, bus):
    take = node._on_rpdo
    node._on_rpdo = lambda pdo, data, now_s: take(pdo, data, now_s) if len(data) <= pdo.length else None


@fault("rpdo.pre-operational", "RPDOs act in PRE-OPERATIONAL")
def _(patch, node, bus):
    def also():
        node._rpdo_by_id = {pdo.can_id: pdo for pdo in node._rpdos if pdo.valid}
        node._listen()

    route_differently(node, also)


@fault("sync.identifier.other", "1005h is ignored")
def _(patch, node, bus):
    listen = node._listen

    def fixed():
        listen()
        node._takers[0x080] = node._on_sync
        node._takers.pop(0x57D, None)

    node._listen = fixed


@fault("sync.counter.start", "the SYNC start value is ignored")
def _(patch, node, bus):
    for pdo in node._tpdos:
        patch.setattr(pdo, "has_started", lambda data: True)


@fault("sync.counter", "SYNC with a counter is ignored")
def _(patch, node, bus):
    bus.incoming = lambda m: None if m.arbitration_id == 0x080 and len(m.data) else m


# ---------------------------------------------------------------- errors, storage, identity

sends("emcy.frame", "EMCY of seven bytes", when(is_emergency, lambda i, d: [(i, d[:7])]))
sends("emcy.once", "every EMCY twice", when(is_emergency, lambda i, d: [(i, d)] * 2))
sends("emcy.frame.register", "no error register in EMCY",
      when(is_emergency, lambda i, d: [(i, d[:2] + b"\0" + d[3:])]))  # fmt: skip
sends("consumer.recovery", "the end of an error is not reported",
      when(lambda i, d: is_emergency(i, d) and d[:2] == b"\0\0", lambda i, d: []))  # fmt: skip
sends("rpdo.short.emergency", "no EMCY for a short RPDO",
      when(lambda i, d: is_emergency(i, d) and d[:2] == b"\x10\x82", lambda i, d: []))  # fmt: skip
sends(
    "emcy.identifier.other",
    "1014h is ignored",
    lambda i, d: [(0x081 if i == 0x082 else i, d)],
)


@fault("emcy.disabled", "bit 31 of 1014h is ignored")
def _(patch, node, bus):
    emergency = node.emergency

    def transmit(code, more):
        node._send(0x81, struct.pack("<HB5s", code, emergency._register(), more))

    patch.setattr(emergency, "_transmit", transmit)


@fault("emcy.register.error", "1001h stays 0")
def _(patch, node, bus):
    node.dictionary[0x1001, 0].bind(lambda: 0)


@fault("emcy.history.clear", "1003h cannot be cleared")
def _(patch, node, bus):
    node.dictionary[0x1003, 0].follower = None


@fault("emcy.history.order", "1003h has the oldest error first")
def _(patch, node, bus):
    history = node.emergency._history
    for sub in range(1, 9):
        node.dictionary[0x1003, sub].bind(lambda sub=sub: history[-sub] if sub <= len(history) else 0)


entry("emcy.history.write", "anything can be written to 1003h:00", 0x1003, 0, guard=None)
entry("store.1010.signature", "1010h takes any signature", 0x1010, 1, guard=lambda value: None)
entry("store.save", "1010h saves nothing", 0x1010, 1, guard=lambda value: None)


@fault("store.load.later", "1011h restores at once")
def _(patch, node, bus):
    def at_once(value):
        node._parameters._forget()
        node._parameters.restore()

    node.dictionary[0x1011, 1].guard = at_once


entry("store.load", "1011h restores nothing", 0x1011, 1, guard=lambda value: None)
entry("identity.eds.revision", "another revision than in the EDS", 0x1018, 3, value=0x10001)
entry("identity.vendor", "no vendor id", 0x1018, 1, value=0)
another("eds.upper", "the limits of the EDS are not kept", 0x605A, high=None)


@fault("eds.objects", "an object of the EDS is missing")
def _(patch, node, bus):
    node.dictionary.remove(0x6066, 0)


@fault("eds.undeclared", "an object that the EDS does not name exists")
def _(patch, node, bus):
    node.dictionary._entries[0x1006, 0] = node.dictionary[0x1017, 0]
    node.dictionary._indices.add(0x1006)


another("eds.read-only", "a read-only object can be written", 0x6502, writable=True)
another("eds.mapping.none", "an object that is not mappable can be mapped", 0x6065, mappable=True)


# ---------------------------------------------------------------- power states


def transitions(check: str, text: str, state: State, command: Command, then: State | None) -> None:
    """A fault of the table of transitions: an additional, another or (None) a missing one."""

    @fault(check, text)
    def _(patch, node, bus):
        patch.setitem(TRANSITIONS, (state, command), then or state)


transitions("402.no-transition.disabled.enable", "enable operation acts in switch on disabled",
            State.SWITCH_ON_DISABLED, Command.ENABLE, State.OPERATION_ENABLED)  # fmt: skip
transitions("402.no-transition.disabled.switch-on", "switch on acts in switch on disabled",
            State.SWITCH_ON_DISABLED, Command.SWITCH_ON, State.SWITCHED_ON)  # fmt: skip
transitions("402.transition.3+4", "switch on and enable operation does nothing",
            State.READY_TO_SWITCH_ON, Command.ENABLE, None)  # fmt: skip
transitions(
    "402.transition.5", "disable operation does nothing", State.OPERATION_ENABLED, Command.SWITCH_ON, None
)
transitions("402.transition.8", "shutdown does nothing in operation enabled",
            State.OPERATION_ENABLED, Command.SHUTDOWN, None)  # fmt: skip
transitions("402.transition.10.quick-stop", "quick stop does nothing in switched on",
            State.SWITCHED_ON, Command.QUICK_STOP, None)  # fmt: skip
transitions("402.transition.9", "disable voltage leads to ready to switch on",
            State.OPERATION_ENABLED, Command.DISABLE_VOLTAGE, State.READY_TO_SWITCH_ON)  # fmt: skip
transitions("402.no-transition.stopped.shutdown", "shutdown leaves quick stop active",
            State.QUICK_STOP_ACTIVE, Command.SHUTDOWN, State.READY_TO_SWITCH_ON)  # fmt: skip
transitions("402.transition.16", "quick stop active cannot be left by enable operation",
            State.QUICK_STOP_ACTIVE, Command.ENABLE, None)  # fmt: skip
transitions("402.state.quick-stop", "quick stop does nothing in ready to switch on",
            State.READY_TO_SWITCH_ON, Command.QUICK_STOP, None)  # fmt: skip


@fault("402.state.mode-bits", "bits 4 to 6 and 8 belong to the command")
def _(patch, node, bus):
    patch.setattr(firmware_module, "next_state",
                  lambda state, word: state if word & 0x170 else next_state(state, word))  # fmt: skip


@fault("402.fault.reset.edge", "a fault reset that is held acts")
def _(patch, node, bus):
    control, firmware = node.firmware.control, node.firmware

    def by_level(word):
        if word & 0x80 and firmware.state is State.FAULT:
            firmware._word = 0
        control(word)

    node.dictionary[0x6040, 0].follower = by_level


@fault("402.fault.reset.enables-nothing", "a fault reset goes on to operation enabled")
def _(patch, node, bus):
    control, firmware = node.firmware.control, node.firmware

    def eager(word):
        was = firmware.state
        control(word)
        if was is State.FAULT and word & 0x0F == 0x0F:
            for each in (0x06, 0x07, 0x0F):
                control(each)

    node.dictionary[0x6040, 0].follower = eager


@fault("402.fault.code.reset", "603Fh survives the fault reset")
def _(patch, node, bus):
    node.dictionary[0x603F, 0].bind(lambda: 0x8130)


@fault("402.fault.register", "1001h survives the fault reset")
def _(patch, node, bus):
    seen = [0]

    def held():
        seen[0] |= node.emergency._register()
        return seen[0]

    node.dictionary[0x1001, 0].bind(held)


@fault("402.status.remote", "bit 9 of the statusword is 0")
def _(patch, node, bus):
    node.dictionary[0x6041, 0].bind(lambda: node.firmware.statusword() & ~0x200)


@fault("402.mode.reserved", "a reserved mode is displayed")
def _(patch, node, bus):
    entry = node.dictionary[0x6060, 0]
    entry.guard = entry.follower = None
    node.dictionary[0x6061, 0].bind(lambda: entry.value)


@fault("402.mode.8", "6061h does not change")
def _(patch, node, bus):
    node.dictionary[0x6061, 0].bind(lambda: 0)


@fault("402.controlword.pdo.sync", "a synchronous controlword acts at once")
def _(patch, node, bus):
    node._on_rpdo = lambda pdo, data, now_s: pdo.apply(data)


def option(check: str, index: int, text: str, value: int) -> None:
    """An option code is taken for another one, whatever it reads as."""

    @fault(check, text)
    def _(patch, node, bus):
        read = node.dictionary.value
        patch.setattr(node.dictionary, "value", lambda i, sub=0: value if i == index else read(i, sub))


option("402.option.605A.6", 0x605A, "quick stop always ends in switch on disabled", 2)
option("402.option.605A.2", 0x605A, "quick stop always stays in quick stop active", 6)
option("402.option.6007.2", 0x6007, "a lost master is always ignored", 0)
option("402.option.6007.0", 0x6007, "a lost master is always a fault", 1)


# ---------------------------------------------------------------- motion


def mode(number: int, node: DriveNode) -> Any:
    return node.firmware._modes[number]


def status_bit(check: str, text: str, clear: int, put: int = 0) -> None:
    @fault(check, text)
    def _(patch, node, bus):
        node.dictionary[0x6041, 0].bind(lambda: node.firmware.statusword() & ~clear | put)


status_bit("402.pp.acknowledge", "a set-point is not acknowledged", 0x1000)
status_bit("402.pp.acknowledge.end", "the acknowledgement stays", 0, 0x1000)
status_bit("402.pp.reached", "target reached is always 1", 0, 0x400)
status_bit("402.pp.move", "target reached is never 1", 0x400)
status_bit("402.csp.status", "bit 12 is 0 in mode 8", 0x1000)


def profile_position(check: str, text: str, change: Callable[[int], int]) -> None:
    """Profile position sees another controlword."""

    @fault(check, text)
    def _(patch, node, bus):
        control = mode(1, node).control
        patch.setattr(mode(1, node), "control", lambda word, rising: control(change(word), rising))


profile_position(
    "402.pp.relative", "a relative set-point is taken for an absolute one", lambda word: word & ~0x40
)
profile_position("402.pp.immediately", "bit 5 is ignored", lambda word: word & ~0x20)
profile_position("402.pp.queue", "every set-point acts at once", lambda word: word | 0x20)


@fault("402.pp.held", "bit 4 acts as a level")
def _(patch, node, bus):
    pp = mode(1, node)
    control = pp.control

    def by_level(word, rising):
        pp._acknowledged = False
        control(word, rising | word & 0x10)

    patch.setattr(pp, "control", by_level)
    node.firmware._by_level = True


@fault("402.pp.target-alone", "a target acts without a new set-point")
def _(patch, node, bus):
    pp = mode(1, node)
    step = pp.step

    def eager(period_s):
        goal = float(node.dictionary.value(0x607A))
        if goal != pp._goal:
            pp._start(goal)
        return step(period_s)

    patch.setattr(pp, "step", eager)


@fault("402.pp.stale", "the target from before enabling acts")
def _(patch, node, bus):
    pp = mode(1, node)
    enter = pp.enter
    patch.setattr(node.firmware.motion, "preload_target", lambda: None)

    def stale():
        enter()
        pp._start(float(node.dictionary.value(0x607A)))

    patch.setattr(pp, "enter", stale)


@fault("402.pp.velocity", "moves are three times too fast")
def _(patch, node, bus):
    read = node.dictionary.value
    patch.setattr(node.dictionary, "value", lambda i, sub=0: read(i, sub) * (3 if i == 0x6081 else 1))


@fault("402.pp.halt", "halt is ignored")
def _(patch, node, bus):
    patch.setattr(node.firmware, "_halt_or_go", lambda halt: None)


@fault("402.pp.halt.end", "a move is not continued after halt")
def _(patch, node, bus):
    pp = mode(1, node)
    patch.setattr(pp, "resume", lambda: setattr(pp, "_profile", None))


def no_limits(patch, node, bus):
    patch.setattr(node.firmware.motion, "goal", float)


fault("402.pp.limit", "607Dh is ignored in profile position")(no_limits)
fault("402.csp.limit", "607Dh is ignored in mode 8")(no_limits)


@fault("402.pp.ends.disable-voltage", "a move survives disable voltage")
def _(patch, node, bus):
    control = node.firmware.control
    node.dictionary[0x6040, 0].follower = lambda word: None if not word & 2 else control(word)


@fault("402.csp.lost-sync", "mode 8 extrapolates without SYNC")
def _(patch, node, bus):
    csp = mode(8, node)
    step = csp.step
    seen = [0, 0.0]

    def extrapolating(period_s):
        target = node.dictionary.value(0x607A)
        if target == seen[0]:
            return csp.motion.demand_counts + seen[1] * period_s, seen[1]
        seen[0] = target
        demand, seen[1] = step(period_s)
        return demand, seen[1]

    patch.setattr(csp, "step", extrapolating)


@fault("402.csp.nmt.stop", "NMT stop does not concern the axis")
def _(patch, node, bus):
    patch.setattr(node.firmware, "connection_lost", lambda code: None)


@fault("402.csp.follow", "mode 8 ignores the target")
def _(patch, node, bus):
    csp = mode(8, node)
    patch.setattr(csp, "step", lambda period_s: (csp.motion.demand_counts, 0.0))


@fault("402.csp.halt", "halt is ignored in mode 8")
def _(patch, node, bus):
    patch.setattr(node.firmware, "_halt_or_go", lambda halt: None)


@fault("402.csp.enable", "enabling jumps by 200 counts")
def _(patch, node, bus):
    motion = node.firmware.motion
    take = motion.take_actual_as_demand

    def jumping():
        take()
        if node.firmware.state is State.SWITCHED_ON:
            motion.home_counts -= 200

    patch.setattr(motion, "take_actual_as_demand", jumping)


@fault("402.homing.37", "607Ch is ignored")
def _(patch, node, bus):
    read = node.dictionary.value
    patch.setattr(node.dictionary, "value", lambda i, sub=0: 0 if i == 0x607C else read(i, sub))


@fault("402.homing.start", "homing starts without bit 4")
def _(patch, node, bus):
    homing = mode(6, node)
    control = homing.control
    patch.setattr(homing, "control", lambda word, rising: control(word | 0x10, rising | 0x10))
    node.firmware._by_level = True


@fault("402.following-error", "60F4h has the wrong sign and a constant")
def _(patch, node, bus):
    node.dictionary[0x60F4, 0].bind(lambda: 1000)


another("402.option.605D.reserved", "reserved option codes are accepted", 0x605D, high=None)
entry("402.homing.reserved", "any homing method is accepted", 0x6098, 0, guard=None)


def test_there_are_many_faults_and_their_checks_exist():
    assert len(FAULTS) >= 100
    assert {check for check, _, _ in FAULTS} <= set(CHECKS)


@pytest.mark.parametrize(
    ("check", "text", "seed"), FAULTS, ids=[f"{check}: {text}" for check, text, _ in FAULTS]
)
def test_a_seeded_fault_is_found(monkeypatch, check, text, seed):
    with simulated_drive(Behaviour()) as (tester, node, _):
        node.bus = bus = Spoiled(node.bus)
        seed(monkeypatch, node, bus)
        node._route()
        result = run_one(tester, CHECKS[check])
    assert result.verdict is Verdict.FAIL, (text, result)
