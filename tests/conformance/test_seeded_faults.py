"""Faults seeded into the simulated drive, one at a time: a named check of the conformance suite finds each.

A fault changes the frames between the node and the bus, or substitutes one behaviour.
"""

import struct
from collections.abc import Callable
from operator import attrgetter
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
    """Bus that modifies the frames that the node sends and receives."""

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
Fault = tuple[str, str, Seed]
Method = Callable[..., Any]


# ---------------------------------------------------------------- kinds of faults


def sends(check: str, text: str, change: Callable[[int, bytes], list[Frame]]) -> Fault:
    """Modifies frames from the node."""
    return check, text, lambda patch, node, bus: setattr(bus, "outgoing", change)


def receives(check: str, text: str, change: Callable[[can.Message], can.Message | None]) -> Fault:
    """Modifies frames to the node."""
    return check, text, lambda patch, node, bus: setattr(bus, "incoming", change)


def wraps(check: str, text: str, path: str, make: Callable[[Method, DriveNode], Method]) -> Fault:
    """Replaces a method by one made from the original and the node; the path begins at node or mode."""

    def seed(patch: Any, node: DriveNode, bus: Spoiled) -> None:
        *owners, name = path.split(".")
        modes = {"pp": 1, "homing": 6, "csp": 8}
        owner: Any = node
        if owners and owners[0] in modes:
            owner = node.firmware._modes[modes[owners.pop(0)]]
        owner = attrgetter(".".join(owners))(owner) if owners else owner
        patch.setattr(owner, name, make(getattr(owner, name), node))

    return check, text, seed


def wraps_pdos(check: str, text: str, kind: str, name: str, make: Callable[[Method, Any], Method]) -> Fault:
    """Replaces a method of each PDO of a kind by one made from the original and the PDO."""

    def seed(patch: Any, node: DriveNode, bus: Spoiled) -> None:
        for pdo in getattr(node, kind):
            patch.setattr(pdo, name, make(getattr(pdo, name), pdo))

    return check, text, seed


def entry(check: str, text: str, index: int, sub: int, **changes: Any) -> Fault:
    """Changes attributes of a dictionary entry, for example its value or the guard that checks new values."""

    def seed(patch: Any, node: DriveNode, bus: Spoiled) -> None:
        for name, value in changes.items():
            setattr(node.dictionary[index, sub], name, value)

    return check, text, seed


def follows(check: str, text: str, index: int, make: Callable[[DriveNode], Method | None]) -> Fault:
    """Changes the effect of writing an object."""
    return check, text, lambda patch, node, bus: setattr(node.dictionary[index, 0], "follower", make(node))


def reads(check: str, text: str, index: int, value: Callable[[DriveNode], int]) -> Fault:
    """Changes the value read from an object."""
    return check, text, lambda patch, node, bus: node.dictionary[index, 0].bind(lambda: value(node))


def described(check: str, text: str, index: int, **changes: Any) -> Fault:
    """Changes the description of an entry."""
    return check, text, lambda patch, node, bus: replace_entry(node, index, **changes)


def replace_entry(node: DriveNode, index: int, **changes: Any) -> None:
    old = node.dictionary[index, 0]
    new = object.__new__(type(old))
    for name in vars(old):
        object.__setattr__(new, name, changes.get(name, getattr(old, name)))
    node.dictionary._entries[index, 0] = new


def used_as(check: str, text: str, index: int, change: Callable[[int], int]) -> Fault:
    """Changes the effect of an object's value, but not the value read."""
    return wraps(check, text, "dictionary.value", lambda read, node: (
        lambda i, sub=0: change(read(i, sub)) if i == index else read(i, sub)
    ))  # fmt: skip


def transition(check: str, text: str, state: State, command: Command, then: State | None) -> Fault:
    """Adds, changes or (None) removes a transition."""
    return check, text, lambda patch, node, bus: patch.setitem(TRANSITIONS, (state, command), then or state)


def status_bit(check: str, text: str, clear: int, put: int = 0) -> Fault:
    return reads(check, text, 0x6041, lambda node: node.firmware.statusword() & ~clear | put)


def also(check: str, text: str, more: Callable[[DriveNode], object]) -> Fault:
    """Runs an additional action whenever frames are assigned to PDOs."""

    def seed(patch: Any, node: DriveNode, bus: Spoiled) -> None:
        route = node._route
        node._route = lambda: (route(), more(node))  # type: ignore[method-assign, func-returns-value]
        for pdo in (*node._tpdos, *node._rpdos):
            pdo._changed = node._route

    return check, text, seed


def then(first: Method, *more: Callable[[], object]) -> Method:
    """Runs a method and returns its result; runs more afterwards."""

    def both(*arguments: Any, **options: Any) -> Any:
        result = first(*arguments, **options)
        for each in more:
            each()
        return result

    return both


def when(wanted: Callable[[int, bytes], bool], change: Callable[[int, bytes], list[Frame]]) -> Any:
    return lambda i, d: change(i, d) if wanted(i, d) else [(i, d)]


def is_boot(i, d):
    return i == 0x701 and d == b"\0"


def is_beat(i, d):
    return i == 0x701 and d != b"\0"


def is_sdo(i, d):
    return i == 0x581


def begins(command, mask=0xFF):
    return lambda i, d: i == 0x581 and d[0] & mask == command


def is_segment(i, d):
    return i == 0x581 and d[0] & 0xE0 == 0 and d[0] & 0x0F != 0x0F


def is_abort(code):
    return lambda i, d: i == 0x581 and d[:1] == b"\x80" and d[4:] == struct.pack("<I", code)


def is_emergency(*code):
    return lambda i, d: i == 0x081 and (not code or d[:2] == bytes(code))


def is_tpdo(i, d):
    return i == 0x181


def renamed(message: can.Message, can_id: int, data: bytes | None = None) -> DataFrame:
    return DataFrame(can_id, message.data if data is None else data)


NETWORK = (
    sends("nmt.reset-communication", "no boot-up message", when(is_boot, lambda i, d: [])),
    sends("nmt.boot-up.frame", "boot-up message of two bytes", when(is_boot, lambda i, d: [(i, d + b"\0")])),
    sends("nmt.boot-up.once", "two boot-up messages", when(is_boot, lambda i, d: [(i, d)] * 2)),
    sends("heartbeat.toggle", "heartbeats with a toggle bit",
          when(is_beat, lambda i, d: [(i, bytes((d[0] | 0x80,)))])),
    sends("heartbeat.frame", "heartbeats of two bytes", when(is_beat, lambda i, d: [(i, d + b"\0")])),
    sends("heartbeat.operational", "the state in heartbeats never changes",
          when(is_beat, lambda i, d: [(i, b"\x7f")])),
    sends("guarding.toggle", "the toggle bit of node guarding stays",
          when(is_beat, lambda i, d: [(i, bytes((d[0] & 0x7F,)))])),
    follows("heartbeat.period", "heartbeats at one and a half times the period", 0x1017, lambda node:
            lambda _=None: (node._start_heartbeat(), setattr(node, "_heartbeat_s", 1.5 * node._heartbeat_s))),
    follows("heartbeat.off", "heartbeats do not end", 0x1017,
            lambda node: lambda value: node._start_heartbeat() if value else None),
    wraps("nmt.sdo.stopped", "SDO in STOPPED", "_listen", lambda listen, node:
          then(listen, lambda: node._takers.update({0x601: node._on_sdo_request}))),
    receives("nmt.broadcast", "commands to all nodes are ignored",
             lambda m: None if m.arbitration_id == 0 and bytes(m.data)[1:] == b"\0" else m),
    receives("nmt.ignores.other-node", "commands to other nodes are obeyed", lambda m:
             renamed(m, 0, bytes((m.data[0], 1))) if m.arbitration_id == 0 and len(m.data) == 2 else m),
    receives("nmt.ignores.extended", "29-bit identifiers are taken for 11-bit ones",
             lambda m: renamed(m, m.arbitration_id) if m.is_extended_id else m),
    receives("nmt.ignores.short", "a command of one byte is obeyed", lambda m:
             renamed(m, 0, bytes(m.data) + b"\0") if not m.arbitration_id and len(m.data) == 1 else m),
    wraps("nmt.reset-communication.parameters", "reset communication restores nothing",
          "_parameters.restore", lambda restore, node: lambda *range: None),
    wraps("nmt.reset-communication.application", "reset communication restores everything",
          "_parameters.restore", lambda restore, node: lambda *range: restore()),
    also("nmt.pdo.pre-operational", "TPDOs in PRE-OPERATIONAL", lambda node: setattr(
         node, "_sync_tpdos", [pdo for pdo in node._tpdos if pdo.valid and pdo.is_synchronous])),
    ("consumer.loss", "a lost heartbeat goes unnoticed",
     lambda patch, node, bus: setattr(node.faults, "ignore_lost_heartbeat", True)),
    ("error-behaviour.0", "the node stays OPERATIONAL after a lost heartbeat",
     lambda patch, node, bus: setattr(node.faults, "stay_operational", True)),
    wraps("consumer.loss.time", "the consumer waits three times too long", "_watch_heartbeat",
          lambda watch, node: then(watch, lambda: setattr(node, "_watched_s", 3.0 * node._watched_s))),
    receives("consumer.other-node", "any heartbeat counts",
             lambda m: renamed(m, 0x77E) if 0x702 <= m.arbitration_id <= 0x77F else m),
)  # fmt: skip


def at_once(watch: Method, node: DriveNode) -> Method:
    def more() -> None:
        if node._watched_s:
            node._watch_due_s = node.now_s + node._watched_s
            node._due_s = node.now_s

    return then(watch, more)


def life_time(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    node._stop_guarding = lambda: setattr(node, "_life_s", 0.0)  # type: ignore[method-assign]
    for index in (0x100C, 0x100D):
        node.dictionary[index, 0].follower = None


def toggle_kept(begin: Method, node: DriveNode) -> Method:
    def keeping() -> None:
        kept = node._guard_toggle
        begin()
        node._guard_toggle = kept

    return keeping


WATCHING = (
    wraps("consumer.idle", "the consumer does not wait for the first heartbeat", "_watch_heartbeat", at_once),
    ("guarding.loss", "the life time is not supervised", life_time),
    wraps("guarding.toggle.first", "the toggle bit survives a reset", "_begin", toggle_kept),
)


def lss_answers(check: str, text: str, command: int, *values: int) -> Fault:
    """Changes bytes of an LSS answer."""
    return sends(check, text, when(lambda i, d: i == 0x7E4 and d[0] == command,
                                   lambda i, d: [(i, bytes(values).ljust(8, b"\0"))]))  # fmt: skip


def lss(check: str, text: str, name: str, make: Callable[[Method, Any], Method]) -> Fault:
    """Replaces a method of the LSS slave by one made from the original and the slave."""
    return wraps(check, text, f"_lss.{name}", lambda right, node: make(right, node._lss))


LSS = (
    *(lss(f"lss.select.{part}", f"any {part} number selects", "_agrees", lambda right, _, command=command:
          lambda c, span, agrees: right(c, span, agrees or c == command))
      for command, part in enumerate(("vendor", "product", "revision", "serial"), start=0x40)),
    *(lss_answers(f"lss.inquire.{part}", f"another {part} number", command, command, 9)
      for command, part in enumerate(("vendor", "product", "revision", "serial"), start=0x5A)),
    lss_answers("lss.select", "a selection has another answer", 0x44, 0x4F),
    lss_answers("lss.inquire.node-id", "another node id", 0x5E, 0x5E, 9),
    lss_answers("lss.node-id.range", "node id 0 is accepted", 0x11, 0x11, 0),
    lss_answers("lss.bit-timing.reserved", "a reserved bit timing is accepted", 0x13, 0x13, 0),
    lss_answers("lss.store", "storing has an error code of its own", 0x17, 0x17, 2),
    lss("lss.waiting", "inquiries are answered in waiting state", "respond", lambda right, slave:
        lambda d: slave._configure(d[0], d) if d[0] == 0x5E else right(d)),
    lss("lss.short", "short requests are obeyed", "respond",
        lambda right, _: lambda d: right(d.ljust(8, b"\0"))),
    lss("lss.identify", "every range contains the identity", "_in_range", lambda right, _: lambda c, n: True),
    lss("lss.node-id.pending", "a node id acts at once", "respond", lambda right, slave:
        then(right, lambda: setattr(slave, "node_id", slave.pending))),
    receives("lss.node-id.used", "a node id never acts", lambda m: renamed(m, 0x7E5, b"\x11\1" + bytes(6))
             if m.arbitration_id == 0x7E5 and m.data[0] == 0x11 else m),
    lss("lss.fast-scan", "a fast scan compares nothing", "_fast_scan", lambda right, slave:
        lambda n, bit, part, following: b"\x4f" + bytes(7)),
    lss("lss.fast-scan.configured", "a node with a node id says that it has none", "respond", lambda right, _:
        lambda d: b"\x50" + bytes(7) if d[0] == 0x4C else right(d)),
)  # fmt: skip


def any_toggle(check: Method, node: DriveNode) -> Method:
    return lambda command, *, uploading: check(command & ~0x10 | node._sdo._toggle, uploading=uploading)


def unchecked_crc(end: Method, node: DriveNode) -> Method:
    return lambda *request: (setattr(node._sdo, "_checks_crc", False), end(*request))[1]


def any_length(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    kind = type(node.dictionary[0x1017, 0])
    patch.setattr(kind, "check_length", lambda self, size: None)
    patch.setattr(kind, "write", lambda self, d: self.put(int.from_bytes(d[: self.codec.size], "little")))


def stored_first(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    entry = node.dictionary[0x1017, 0]
    write = type(entry).write

    def careless(self, data):
        if self is entry:
            self.value = int.from_bytes(data, "little")
        write(self, data)

    patch.setattr(type(entry), "write", careless)


SDO = (
    sends("sdo.answer.length", "answers of seven bytes", when(is_sdo, lambda i, d: [(i, d[:7])])),
    sends("sdo.answer.once", "every answer twice", when(is_sdo, lambda i, d: [(i, d)] * 2)),
    sends("sdo.upload.4", "no size in an expedited answer",
          when(begins(0x43), lambda i, d: [(i, b"\x42" + d[1:])])),
    sends("sdo.upload.segmented.toggle", "the toggle bit of segments stays",
          when(is_segment, lambda i, d: [(i, bytes((d[0] & ~0x10,)) + d[1:])])),
    sends("sdo.upload.segmented", "a wrong size is announced",
          when(begins(0x41), lambda i, d: [(i, d[:4] + b"\x99" + d[5:])])),
    sends("sdo.download.response", "garbage in the reserved bytes of a download response",
          when(begins(0x60), lambda i, d: [(i, d[:4] + b"\1\2\3\4")])),
    sends("sdo.abort.no-object.upload", "a general abort code for a missing object",
          when(is_abort(0x06020000), lambda i, d: [(i, d[:4] + struct.pack("<I", 0x08000000))])),
    sends("sdo.abort.no-sub.upload", "a missing sub-index is called a missing object",
          when(is_abort(0x06090011), lambda i, d: [(i, d[:4] + struct.pack("<I", 0x06020000))])),
    sends("sdo.abort.multiplexer", "aborts do not name the object",
          when(is_abort(0x06020000), lambda i, d: [(i, b"\x80\0\0\0" + d[4:])])),
    sends("sdo.block.upload.crc", "a wrong checksum of a block upload",
          when(begins(0xC1, 0xE3), lambda i, d: [(i, d[:1] + b"\x12\x34" + d[3:])])),
    receives("sdo.other-node", "requests to another node are answered",
             lambda m: renamed(m, 0x601) if m.arbitration_id == 0x602 else m),
    wraps("sdo.upload.toggle-error", "the toggle bit of upload requests is not checked",
          "_sdo._check_segment", any_toggle),
    wraps("sdo.download.segmented.toggle-error", "the toggle bit of download segments is not checked",
          "_sdo._check_segment", any_toggle),
    receives("sdo.upload.client-abort", "an abort of the client is ignored", lambda m:
             None if m.arbitration_id == 0x601 and bytes(m.data)[:1] == b"\x80" else m),
    wraps("sdo.block.download.crc", "the checksum of a block download is not checked",
          "_sdo._end_download", unchecked_crc),
    wraps("sdo.block.download.sequence", "segments out of order are taken", "_sdo._take_segment",
          lambda take, node: lambda command, d: take(command & 0x80 | node._sdo._sequence + 1, d)),
    wraps("sdo.block.upload.repeat", "segments are not sent again", "_sdo._acknowledged",
          lambda acknowledged, node: lambda number, size: acknowledged(node._sdo._sequence, size)),
    described("sdo.abort.read-only", "1000h can be written", 0x1000, writable=True),
    ("sdo.abort.too-long", "the length of a download is not checked", any_length),
    ("sdo.abort.value", "a refused value is stored", stored_first),
)  # fmt: skip


def without_inhibit(compile_: Method, pdo: Any) -> Method:
    return then(compile_, lambda: setattr(pdo, "inhibit_s", 0.0))


def forgetful(on_event: Method, pdo: Any) -> Method:
    def forgets(now_s: float) -> Any:
        if now_s < pdo.sent_s + pdo.inhibit_s:
            pdo.sent = pdo.pack()
        return on_event(now_s)

    return forgets


def always_valid(patch: Any, pdos: Any) -> None:
    for pdo in pdos:
        compile_ = pdo.compile

        def valid(pdo=pdo, compile_=compile_):
            pdo.valid = False
            compile_()
            pdo.valid, pdo._dictionary[pdo._communication, 1].guard = True, None

        patch.setattr(pdo, "compile", valid)
        for sub in range(9):
            pdo._dictionary[pdo._mapping, sub].guard = None


def any_received(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    patch.setattr(node._rpdos[0], "_may_map", lambda entry: True)
    replace_entry(node, 0x1001, mappable=True)


def nine_bytes(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    node.dictionary[0x1A00, 0].guard = lambda count: None
    patch.setattr(node._tpdos[0], "compile", lambda: None)


def first_counts(take: Method, node: DriveNode) -> Method:
    return lambda pdo, *more: None if pdo.is_synchronous and pdo.pending is not None else take(pdo, *more)


def applied_again(apply: Method, node: DriveNode) -> Method:
    return lambda: [pdo.apply(pdo.pending) for pdo in node._sync_rpdos if pdo.pending is not None]


def in_pre_operational(node: DriveNode) -> None:
    node._rpdo_by_id = {pdo.can_id: pdo for pdo in node._rpdos if pdo.valid}
    node._listen()


PDO = (
    sends("tpdo.mapping.data", "the bytes of a TPDO are reversed",
          when(is_tpdo, lambda i, d: [(i, d[::-1])])),
    sends("tpdo.mapping.order", "the objects of a TPDO are in reverse order",
          when(is_tpdo, lambda i, d: [(i, d[2:] + d[:2])])),
    sends("tpdo.event-timer", "event-driven TPDOs are lost", when(is_tpdo, lambda i, d: [])),
    wraps_pdos("tpdo.sync.2", "a TPDO at every SYNC, whatever its transmission type", "_tpdos", "_in_turn",
               lambda in_turn, pdo: pdo.pack),
    wraps_pdos("tpdo.sync.0", "type 0 is sent at every SYNC", "_tpdos", "_if_changed",
               lambda if_changed, pdo: pdo.pack),
    wraps_pdos("tpdo.inhibit", "the inhibit time is ignored", "_tpdos", "compile", without_inhibit),
    wraps_pdos("tpdo.inhibit.last", "a change within the inhibit time is lost", "_tpdos", "on_event",
               forgetful),
    wraps_pdos("tpdo.event.255", "a change is not sent", "_tpdos", "on_event",
               lambda on_event, pdo: lambda now_s: None),
    ("tpdo.disabled", "bit 31 of a TPDO is ignored",
     lambda patch, node, bus: always_valid(patch, node._tpdos)),
    ("rpdo.disabled", "bit 31 of an RPDO is ignored",
     lambda patch, node, bus: always_valid(patch, node._rpdos[:1])),
    entry("tpdo.mapping.valid", "a mapping can be changed while the PDO exists", 0x1A00, 0, guard=None),
    entry("rpdo.identifier.fixed", "the identifier can be changed while the PDO exists", 0x1400, 1,
          guard=None),
    entry("tpdo.type.241", "reserved transmission types are accepted", 0x1800, 2, guard=None),
    ("rpdo.mapping.read-only", "read-only objects can be received", any_received),
    ("tpdo.mapping.too-many-bytes", "nine bytes can be mapped", nine_bytes),
    wraps_pdos("rpdo.sync.before", "synchronous RPDOs act at once", "_rpdos", "compile",
               lambda compile_, pdo: then(compile_, lambda: setattr(pdo, "is_synchronous", False))),
    wraps("rpdo.sync.last", "of two RPDOs the first counts", "_on_rpdo", first_counts),
    wraps("rpdo.sync.once", "an RPDO acts at every later SYNC", "_apply_rpdos", applied_again),
    wraps("rpdo.short", "a short RPDO is filled up with zeros", "_on_rpdo", lambda take, node:
          lambda pdo, d, now_s: take(pdo, bytearray(bytes(d).ljust(pdo.length, b"\0")), now_s)),
    wraps("rpdo.long", "an RPDO that is too long is ignored", "_on_rpdo", lambda take, node:
          lambda pdo, d, now_s: take(pdo, d, now_s) if len(d) <= pdo.length else None),
    also("rpdo.pre-operational", "RPDOs act in PRE-OPERATIONAL", in_pre_operational),
    wraps("sync.identifier.other", "1005h is ignored", "_listen", lambda listen, node: then(
          listen, lambda: (node._takers.update({0x080: node._on_sync}), node._takers.pop(0x57D, None)))),
    wraps_pdos("sync.counter.start", "the SYNC start value is ignored", "_tpdos", "has_started",
               lambda has_started, pdo: lambda data: True),
    receives("sync.counter", "SYNC with a counter is ignored",
             lambda m: None if m.arbitration_id == 0x080 and len(m.data) else m),
)  # fmt: skip


def oldest_first(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    history = node.emergency._history
    for sub in range(1, 9):
        node.dictionary[0x1003, sub].bind(lambda sub=sub: history[-sub] if sub <= len(history) else 0)


def restored_at_once(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    parameters = node._parameters
    node.dictionary[0x1011, 1].guard = lambda value: (parameters._keep({}), parameters.restore())


def undeclared(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    node.dictionary._entries[0x1006, 0] = node.dictionary[0x1017, 0]
    node.dictionary._indices.add(0x1006)


ERRORS_STORAGE_IDENTITY = (
    sends("emcy.frame", "EMCY of seven bytes", when(is_emergency(), lambda i, d: [(i, d[:7])])),
    sends("emcy.once", "every EMCY twice", when(is_emergency(), lambda i, d: [(i, d)] * 2)),
    sends("emcy.frame.register", "no error register in EMCY",
          when(is_emergency(), lambda i, d: [(i, d[:2] + b"\0" + d[3:])])),
    sends("consumer.recovery", "the end of an error is not reported",
          when(is_emergency(0, 0), lambda i, d: [])),
    sends("rpdo.short.emergency", "no EMCY for a short RPDO",
          when(is_emergency(0x10, 0x82), lambda i, d: [])),
    sends("emcy.identifier.other", "1014h is ignored", lambda i, d: [(0x081 if i == 0x082 else i, d)]),
    wraps("emcy.disabled", "bit 31 of 1014h is ignored", "emergency._transmit", lambda transmit, node:
          lambda code, more: node._send(0x81, struct.pack("<HB5s", code, node.emergency._register(), more))),
    reads("emcy.register.error", "1001h stays 0", 0x1001, lambda node: 0),
    follows("emcy.history.clear", "1003h cannot be cleared", 0x1003, lambda node: None),
    ("emcy.history.order", "1003h has the oldest error first", oldest_first),
    entry("emcy.history.write", "anything can be written to 1003h:00", 0x1003, 0, guard=None),
    entry("store.1010.signature", "1010h takes any signature", 0x1010, 1, guard=lambda value: None),
    entry("store.save", "1010h saves nothing", 0x1010, 1, guard=lambda value: None),
    ("store.load.later", "1011h restores at once", restored_at_once),
    entry("store.load", "1011h restores nothing", 0x1011, 1, guard=lambda value: None),
    entry("identity.eds.revision", "another revision than in the EDS", 0x1018, 3, value=0x10001),
    entry("identity.vendor", "no vendor id", 0x1018, 1, value=0),
    described("eds.upper", "the limits of the EDS are not kept", 0x605A, high=None),
    ("eds.objects", "an object of the EDS is missing",
     lambda patch, node, bus: node.dictionary.remove(0x6066, 0)),
    ("eds.undeclared", "an object that the EDS does not name exists", undeclared),
    described("eds.read-only", "a read-only object can be written", 0x6502, writable=True),
    described("eds.mapping.none", "an object that is not mappable can be mapped", 0x6065, mappable=True),
)  # fmt: skip


def mode_bits(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    patch.setattr(firmware_module, "next_state",
                  lambda state, word: state if word & 0x170 else next_state(state, word))  # fmt: skip


def reset_by_level(node: DriveNode) -> Method:
    def control(word: int) -> None:
        if word & 0x80 and node.firmware.state is State.FAULT:
            node.firmware._word = 0
        node.firmware.control(word)

    return control


def eager_reset(node: DriveNode) -> Method:
    def control(word: int) -> None:
        was = node.firmware.state
        for each in (word, 0x06, 0x07, 0x0F) if was is State.FAULT and word & 0x0F == 0x0F else (word,):
            node.firmware.control(each)

    return control


def register_held(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    seen = [0]

    def held() -> int:
        seen[0] |= node.emergency._register()
        return seen[0]

    node.dictionary[0x1001, 0].bind(held)


def reserved_mode(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    entry = node.dictionary[0x6060, 0]
    entry.guard = entry.follower = None
    node.dictionary[0x6061, 0].bind(lambda: entry.value)


_S, _C = State, Command
POWER = (
    transition("402.no-transition.disabled.enable", "enable operation acts in switch on disabled",
               _S.SWITCH_ON_DISABLED, _C.ENABLE, _S.OPERATION_ENABLED),
    transition("402.no-transition.disabled.switch-on", "switch on acts in switch on disabled",
               _S.SWITCH_ON_DISABLED, _C.SWITCH_ON, _S.SWITCHED_ON),
    transition("402.transition.3+4", "switch on and enable operation does nothing",
               _S.READY_TO_SWITCH_ON, _C.ENABLE, None),
    transition("402.transition.5", "disable operation does nothing",
               _S.OPERATION_ENABLED, _C.SWITCH_ON, None),
    transition("402.transition.8", "shutdown does nothing in operation enabled",
               _S.OPERATION_ENABLED, _C.SHUTDOWN, None),
    transition("402.transition.10.quick-stop", "quick stop does nothing in switched on",
               _S.SWITCHED_ON, _C.QUICK_STOP, None),
    transition("402.transition.9", "disable voltage leads to ready to switch on",
               _S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE, _S.READY_TO_SWITCH_ON),
    transition("402.no-transition.stopped.shutdown", "shutdown leaves quick stop active",
               _S.QUICK_STOP_ACTIVE, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    transition("402.transition.16", "quick stop active cannot be left by enable operation",
               _S.QUICK_STOP_ACTIVE, _C.ENABLE, None),
    transition("402.state.quick-stop", "quick stop does nothing in ready to switch on",
               _S.READY_TO_SWITCH_ON, _C.QUICK_STOP, None),
    ("402.state.mode-bits", "bits 4 to 6 and 8 belong to the command", mode_bits),
    follows("402.fault.reset.edge", "a fault reset that is held acts", 0x6040, reset_by_level),
    follows("402.fault.reset.enables-nothing", "a fault reset goes on to operation enabled", 0x6040,
            eager_reset),
    reads("402.fault.code.reset", "603Fh survives the fault reset", 0x603F, lambda node: 0x8130),
    ("402.fault.register", "1001h survives the fault reset", register_held),
    status_bit("402.status.remote", "bit 9 of the statusword is 0", 0x200),
    ("402.mode.reserved", "a reserved mode is displayed", reserved_mode),
    reads("402.mode.8", "6061h does not change", 0x6061, lambda node: 0),
    wraps("402.controlword.pdo.sync", "a synchronous controlword acts at once", "_on_rpdo",
          lambda take, node: lambda pdo, d, now_s: pdo.apply(d)),
    used_as("402.option.605A.6", "quick stop always ends in switch on disabled", 0x605A, lambda value: 2),
    used_as("402.option.605A.2", "quick stop always stays in quick stop active", 0x605A, lambda value: 6),
    used_as("402.option.6007.2", "a lost master is always ignored", 0x6007, lambda value: 0),
    used_as("402.option.6007.0", "a lost master is always a fault", 0x6007, lambda value: 1),
)  # fmt: skip


def profile_position(check: str, text: str, change: Callable[[int], int]) -> Fault:
    """Changes the controlword that profile position mode sees."""
    return wraps(check, text, "pp.control",
                 lambda control, node: lambda word, rising: control(change(word), rising))  # fmt: skip


def set_point_by_level(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    pp = node.firmware._modes[1]
    control = pp.control

    def by_level(word, rising):
        pp._acknowledged = False
        control(word, rising | word & 0x10)

    patch.setattr(pp, "control", by_level)
    node.firmware._by_level = True


def homing_at_once(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    homing = node.firmware._modes[6]
    control = homing.control
    patch.setattr(homing, "control", lambda word, rising: control(word | 0x10, rising | 0x10))
    node.firmware._by_level = True


def eager_target(step: Method, node: DriveNode) -> Method:
    pp = node.firmware._modes[1]

    def eager(period_s):
        goal = float(node.dictionary.value(0x607A))
        if goal != pp._goal:
            pp._start(goal)
        return step(period_s)

    return eager


def stale_target(patch: Any, node: DriveNode, bus: Spoiled) -> None:
    pp = node.firmware._modes[1]
    patch.setattr(node.firmware.motion, "preload_target", lambda: None)
    patch.setattr(pp, "enter", then(pp.enter, lambda: pp._start(float(node.dictionary.value(0x607A)))))


def extrapolating(step: Method, node: DriveNode) -> Method:
    csp, seen = node.firmware._modes[8], [0, 0.0]

    def extrapolated(period_s):
        target = node.dictionary.value(0x607A)
        if target == seen[0]:
            return csp.motion.demand_counts + seen[1] * period_s, seen[1]
        seen[0] = target
        demand, seen[1] = step(period_s)
        return demand, seen[1]

    return extrapolated


def jumping(take: Method, node: DriveNode) -> Method:
    def more() -> None:
        if node.firmware.state is State.SWITCHED_ON:
            node.firmware.motion.home_counts -= 200

    return then(take, more)


MOTION = (
    status_bit("402.pp.acknowledge", "a set-point is not acknowledged", 0x1000),
    status_bit("402.pp.acknowledge.end", "the acknowledgement stays", 0, 0x1000),
    status_bit("402.pp.reached", "target reached is always 1", 0, 0x400),
    status_bit("402.pp.move", "target reached is never 1", 0x400),
    status_bit("402.csp.status", "bit 12 is 0 in mode 8", 0x1000),
    profile_position("402.pp.relative", "a relative set-point is taken for an absolute one",
                     lambda word: word & ~0x40),
    profile_position("402.pp.immediately", "bit 5 is ignored", lambda word: word & ~0x20),
    profile_position("402.pp.queue", "every set-point acts at once", lambda word: word | 0x20),
    ("402.pp.held", "bit 4 acts as a level", set_point_by_level),
    wraps("402.pp.target-alone", "a target acts without a new set-point", "pp.step", eager_target),
    ("402.pp.stale", "the target from before enabling acts", stale_target),
    used_as("402.pp.velocity", "moves are three times too fast", 0x6081, lambda value: 3 * value),
    wraps("402.pp.halt", "halt is ignored", "firmware._halt_or_go", lambda act, node: lambda halt: None),
    wraps("402.pp.halt.end", "a move is not continued after halt", "pp.resume",
          lambda resume, node: lambda: setattr(node.firmware._modes[1], "_profile", None)),
    wraps("402.pp.limit", "607Dh is ignored in profile position", "firmware.motion.goal",
          lambda goal, node: float),
    wraps("402.csp.limit", "607Dh is ignored in mode 8", "firmware.motion.goal", lambda goal, node: float),
    follows("402.pp.ends.disable-voltage", "a move survives disable voltage", 0x6040,
            lambda node: lambda word: node.firmware.control(word) if word & 2 else None),
    wraps("402.csp.lost-sync", "mode 8 extrapolates without SYNC", "csp.step", extrapolating),
    wraps("402.csp.nmt.stop", "NMT stop does not concern the axis", "firmware.connection_lost",
          lambda lost, node: lambda code: None),
    wraps("402.csp.follow", "mode 8 ignores the target", "csp.step",
          lambda step, node: lambda period_s: (node.firmware.motion.demand_counts, 0.0)),
    wraps("402.csp.halt", "halt is ignored in mode 8", "firmware._halt_or_go",
          lambda act, node: lambda halt: None),
    wraps("402.csp.enable", "enabling jumps by 200 counts", "firmware.motion.take_actual_as_demand", jumping),
    used_as("402.homing.37", "607Ch is ignored", 0x607C, lambda value: 0),
    ("402.homing.start", "homing starts without bit 4", homing_at_once),
    reads("402.following-error", "60F4h has the wrong sign and a constant", 0x60F4, lambda node: 1000),
    described("402.option.605D.reserved", "reserved option codes are accepted", 0x605D, high=None),
    entry("402.homing.reserved", "any homing method is accepted", 0x6098, 0, guard=None),
)  # fmt: skip

FAULTS: tuple[Fault, ...] = (
    *NETWORK, *WATCHING, *LSS, *SDO, *PDO, *ERRORS_STORAGE_IDENTITY, *POWER, *MOTION,
)  # fmt: skip


def test_every_seeded_fault_names_an_existing_check():
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
