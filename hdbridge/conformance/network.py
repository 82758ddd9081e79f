"""Checks of network management: NMT, boot-up, heartbeat, node guarding."""

from collections.abc import Callable
from itertools import pairwise
from statistics import median
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.steps import no_emergency, parametrised, puts, sends_nmt, waits, writes
from hdbridge.conformance.tester import ENTERED, MASTER, NodeTester, Step, Table, upload_request

CHECKS: Final = Table()
check: Final = CHECKS.check
_NMT: Final = "CiA 301, 7.2.8"
_BOOT: Final = "CiA 301, 7.3.2"
_HEARTBEAT: Final = "CiA 301, 7.2.8 and object 1017h"
_CONSUMER: Final = "CiA 301, 7.2.8 and object 1016h"
_GUARDING: Final = "CiA 301, 7.2.8 and objects 100Ch, 100Dh"

# ---------------------------------------------------------------- boot-up


_PRE: Final = NmtCommand.PRE_OPERATIONAL
_START: Final = NmtCommand.START
_STOP: Final = NmtCommand.STOP


_enters = parametrised(NodeTester.enter)
_resets = parametrised(NodeTester.reset)


@parametrised
def _is_in(t: NodeTester, command: NmtCommand) -> None:
    """The node is in the NMT state to which the command leads."""
    t.equal(t.state(), ENTERED[command], "NMT state")


def _boots(command: int) -> None:
    name = "node" if command == NmtCommand.RESET_NODE else "communication"

    CHECKS.rows(
        _BOOT,
        (f"nmt.reset-{name}", f"NMT reset {name} is followed by a boot-up message",
         _resets(command)),
        (f"nmt.reset-{name}.pre-operational", f"After reset {name} the node is PRE-OPERATIONAL",
         _resets(command), NodeTester.watch_state, _is_in(_PRE)),
    )  # fmt: skip

    @check(f"nmt.reset-{name}.first", f"After reset {name} nothing is sent before the boot-up message", _BOOT)
    def _(t: NodeTester) -> None:
        t.enter(_START)
        t.put(0x1017, 0, 0, 2)
        since = t.mark()
        t.nmt(command)
        boot = t.boot_up(since)
        before = t.log[since : t.log.index(boot)]
        ids = {kind + t.node_id for kind in (0x180, 0x280, 0x380, 0x480, 0x580)}
        own = [f"{frame.can_id:03X}h" for frame in before if frame.can_id in ids]
        t.true(not own, f"before the boot-up message: {', '.join(own)}", "nothing")


_boots(NmtCommand.RESET_NODE)
_boots(NmtCommand.RESET_COMMUNICATION)


CHECKS.rows(
    _BOOT,
    ("nmt.boot-up.frame", "The boot-up message is 700h + node id with one byte, 00h",
     lambda t: t.equal(t.reset().data, b"\0", "data of the boot-up message")),
    ("nmt.boot-up.once", "A reset is followed by one boot-up message",
     lambda t: t.equal([frame.data for frame in t.heard_after(0x700 + t.node_id, 0.1, t.reset)].count(b"\0"),
                       1, "number of boot-up messages")),
)  # fmt: skip


@check("nmt.reset-communication.parameters", "Reset communication restores 1000h to 1FFFh", _BOOT, 0x1017)
def _(t: NodeTester) -> None:
    t.reset()
    before = t.read(0x1017)
    t.put(0x1017, 0, before + 500, 2)
    t.reset()
    t.equal(t.read(0x1017), before, "1017h")


@check(
    "nmt.reset-communication.application", "Reset communication does not change application objects", _BOOT
)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    value = t.change(index, sub, bits)
    t.reset()
    t.equal(t.read(index, sub), value, f"{index:04X}h:{sub:02X}")


@check("nmt.reset-node.application", "Reset node restores application objects", _BOOT)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    t.need(index != 0x607A, "the object that can be written, 607Ah, is not a parameter")
    t.reset(NmtCommand.RESET_NODE)
    before = t.read(index, sub)
    t.change(index, sub, bits)
    t.reset(NmtCommand.RESET_NODE)
    t.equal(t.read(index, sub), before, f"{index:04X}h:{sub:02X}")


# ---------------------------------------------------------------- states


def _ignores(send: Step) -> tuple[Step, Step, Step]:
    return NodeTester.watch_state, send, _is_in(_PRE)


CHECKS.rows(
    _NMT,
    *((f"nmt.{name}", f"NMT command {command} leads from {ENTERED[first]} to {ENTERED[command]}",
       _enters(first), _enters(command))
      for name, first, command in (
          ("start", _PRE, _START), ("stop", _PRE, _STOP), ("start-from-stopped", _STOP, _START),
          ("stop-from-operational", _START, _STOP), ("enter-pre-operational", _START, _PRE),
          ("enter-pre-operational-from-stopped", _STOP, _PRE))),
    ("nmt.repeated", "A repeated NMT start changes nothing", _enters(_START), _enters(_START)),
    ("nmt.reset-from-stopped", "Reset communication is obeyed in STOPPED", _enters(_STOP), NodeTester.reset),
    ("nmt.broadcast", "A command to node 0 is obeyed", NodeTester.watch_state, lambda t: t.nmt(_START, 0),
     _is_in(_START)),
    ("nmt.ignores.other-node", "The node ignores a command to another node",
     *_ignores(lambda t: t.nmt(_START, t.node_id % 127 + 1))),
    ("nmt.ignores.reserved", "The node ignores a reserved command", *_ignores(lambda t: t.nmt(3))),
    ("nmt.ignores.short", "The node ignores a command of one byte",
     *_ignores(lambda t: t.send(0x000, bytes((_START,))))),
    ("nmt.ignores.extended", "The node ignores a command with a 29-bit identifier",
     *_ignores(lambda t: t.send_special(0, bytes((_START, t.node_id))))),
)  # fmt: skip


@parametrised
def _no_pdo(t: NodeTester, command: NmtCommand) -> None:
    can_id = t.map_pdo(0x1800, ((0x1001, 0, 8),), 1)
    t.enter(command)
    found = [t.heard_after(can_id, 0.02, t.sync) for _ in range(3)]
    t.equal(sum(map(len, found)), 0, "number of TPDOs")


@parametrised
def _answers_sdo(t: NodeTester, expected: str) -> None:
    t.equal("an answer" if t.ask(upload_request(0x1000)) else "no answer", expected)


CHECKS.rows(
    _BOOT,
    *((f"nmt.sdo.{ENTERED[command].lower()}", f"SDO requests are answered in {ENTERED[command]}",
       _enters(command), _answers_sdo("an answer")) for command in (_PRE, _START)),
    ("nmt.sdo.stopped", "SDO requests are not answered in STOPPED", _enters(_STOP),
     _answers_sdo("no answer")),
    *((f"nmt.pdo.{ENTERED[command].lower()}", f"No PDO is sent in {ENTERED[command]}", _no_pdo(command))
      for command in (_PRE, _STOP)),
)  # fmt: skip


# ---------------------------------------------------------------- heartbeat


def _beats(t: NodeTester, period_ms: int) -> list[float]:
    t.require(0x1017)
    t.write(0x1017, 0, period_ms, 2)
    duration_s = 6e-3 * period_ms + t.timing.jitter_s
    times = [frame.time_s for frame in t.heard_after(0x700 + t.node_id, duration_s)]
    t.true(len(times) >= 4, f"{len(times)} heartbeats in 6 periods", "about 5")
    return times


@parametrised
def _period(t: NodeTester, period_ms: int) -> None:
    times = _beats(t, period_ms)
    intervals = [after - before for before, after in pairwise(times)]
    t.near(median(intervals), 1e-3 * period_ms, "period of the heartbeat")


@parametrised
def _beats_with(t: NodeTester, value: int) -> None:
    """The data of the next heartbeat are this byte."""
    t.equal(t.reply(0x700 + t.node_id, timeout_s=0.2 + t.timing.jitter_s), bytes((value,)), "data")


@parametrised
def _all_beats(t: NodeTester, what: str, expected: int, value: Callable[[bytes], int]) -> None:
    """All heartbeats that were heard have this value."""
    t.equal({value(frame.data) for frame in t.heard(0x700 + t.node_id)}, {expected}, what)


CHECKS.rows(
    _HEARTBEAT,
    ("heartbeat.period", "The heartbeat period is that of 1017h", _period(100)),
    ("heartbeat.period.other", "A new value of 1017h changes the period", 0x1017, writes(0x1017, 0, 100, 2),
     waits(0.25), _period(250)),
    ("heartbeat.off", "1017h = 0 ends the heartbeat", parametrised(_beats)(50), puts(0x1017, 0, 0, 2),
     lambda t: t.equal(len(t.heard_after(0x700 + t.node_id, 0.3)), 0, "number of heartbeats")),
    ("heartbeat.frame", "A heartbeat has one byte", parametrised(_beats)(50), _all_beats("length", 1, len)),
    ("heartbeat.toggle", "Bit 7 of a heartbeat is 0", parametrised(_beats)(50),
     _all_beats("bit 7", 0, lambda data: data[0] >> 7)),
    *((f"heartbeat.{ENTERED[command].lower()}", f"The heartbeat in {ENTERED[command]} is {value:02X}h",
       0x1017, writes(0x1017, 0, 50, 2), sends_nmt(command), _beats_with(value))
      for command, value in ((_PRE, 0x7F), (_START, 0x05), (_STOP, 0x04))),
)  # fmt: skip


# ---------------------------------------------------------------- heartbeat consumer


def _beat(t: NodeTester, count: int = 3, period_s: float = 0.04, node_id: int = MASTER) -> None:
    for _ in range(count):
        t.beat(node_id)
        t.wait(period_s)


def lose_heartbeat(t: NodeTester) -> None:
    """Makes the node lose the tester's heartbeat; fails unless it sends EMCY 8130h."""
    t.be_supervised()
    _beat(t)
    codes = t.emergencies_after(0.3)
    t.true(0x8130 in codes, f"EMCY codes {[f'{code:04X}h' for code in codes]}", "8130h within 100 ms")


CHECKS.rows(
    _CONSUMER,
    ("consumer.idle", "The consumer waits for the first heartbeat", NodeTester.be_supervised,
     no_emergency(0.4)),
    ("consumer.regular", "Heartbeats in time cause no error", lambda t: t.be_supervised(200),
     no_emergency(0.0, lambda t: _beat(t, 8, 0.05))),
    ("consumer.off", "1016h with time 0 supervises nothing", NodeTester.be_supervised, _beat,
     puts(0x1016, 1, MASTER << 16, 4), no_emergency(0.4)),
    ("consumer.loss", "A lost heartbeat leads to EMCY 8130h within the consumer time", lose_heartbeat),
    ("consumer.recovery", "The error ends when heartbeats return", lose_heartbeat,
     lambda t: t.equal(t.emergencies_after(0.0, lambda: _beat(t))[-1:], [0], "last EMCY code")),
)  # fmt: skip


@check("consumer.loss.time", "The EMCY is sent when the consumer time has expired", _CONSUMER)
def _(t: NodeTester) -> None:
    t.be_supervised(200)
    _beat(t, 3)
    begun_s = t.now
    t.beat()
    frame = t.true(t.hears(0x080 + t.node_id, 0.4 + t.timing.jitter_s), "no EMCY", "EMCY 8130h after 200 ms")
    t.near(frame.time_s - begun_s, 0.2, "time to the EMCY")


@check("consumer.other-node", "Heartbeats of another node do not count", _CONSUMER, NodeTester.be_supervised)
def _(t: NodeTester) -> None:
    _beat(t)
    codes = t.emergencies_after(0.0, lambda: _beat(t, 8, 0.05, MASTER - 1))
    t.true(0x8130 in codes, f"EMCY codes {codes}", "8130h")


CHECKS.rows(
    "CiA 301, object 1029h",
    *((f"error-behaviour.{value}", f"1029h:01 = {value}: a lost heartbeat leads to {ENTERED[command]}",
       (0x1029, 1), writes(0x1029, 1, value, 1), _enters(_START), lose_heartbeat, _is_in(command),
       sends_nmt(_PRE), _beat) for value, command in enumerate((_PRE, _START, _STOP))),
)  # fmt: skip

# ---------------------------------------------------------------- node guarding


def _limit_life(t: NodeTester) -> None:
    """Sets a node life time of 200 ms."""
    t.write(0x100C, 0, 100, 2)
    t.write(0x100D, 0, 2, 1)


def _guard(t: NodeTester) -> bytes:
    answer = t.reply(0x700 + t.node_id, lambda: t.send_special(0x700 + t.node_id, remote=True))
    return t.true(answer, "no answer to the remote frame", "the NMT state")


def _keep_guarding(t: NodeTester) -> None:
    for _ in range(6):
        _guard(t)
        t.wait(0.08)


def _answers_with_state(t: NodeTester) -> None:
    answer = _guard(t)
    t.equal((len(answer), answer[0] & 0x7F), (1, 0x7F), "length and state")


def _toggle_bits(t: NodeTester) -> None:
    bits = [_guard(t)[0] >> 7 for _ in range(4)]
    t.true(bits in ([0, 1, 0, 1], [1, 0, 1, 0]), f"toggle bits {bits}", "alternating")


def _lost_guarding(t: NodeTester) -> None:
    begun_s = t.now
    _guard(t)
    frame = t.hears(0x080 + t.node_id, 0.5 + t.timing.jitter_s)
    lost = frame if frame is not None and frame.data[:2] == b"\x30\x81" else None
    t.near(t.true(lost, "no EMCY 8130h", "EMCY 8130h after 200 ms").time_s - begun_s, 0.2, "time to the EMCY")


CHECKS.rows(
    _GUARDING,
    *((f"guarding.{name}", text, 0x100C, 0x100D, *steps) for name, text, *steps in (
        ("answer", "A remote frame is answered with the NMT state",
         _answers_with_state),
        ("state", "The answer in OPERATIONAL contains the state 05h", sends_nmt(_START),
         lambda t: t.equal(_guard(t)[0] & 0x7F, 0x05, "state")),
        ("toggle", "The toggle bit changes with every answer", _toggle_bits),
        ("toggle.first", "The first toggle bit after a reset is 0", _guard, NodeTester.reset,
         lambda t: t.equal(_guard(t)[0] >> 7, 0, "toggle bit")),
        ("idle", "Life guarding waits for the first remote frame", _limit_life, no_emergency(0.5)),
        ("regular", "Remote frames in time cause no error", _limit_life, no_emergency(0.0, _keep_guarding)),
        ("loss", "No remote frame within the node life time leads to EMCY 8130h", _limit_life,
         _lost_guarding),
    )),
)  # fmt: skip
