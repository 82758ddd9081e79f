"""Checks of network management: NMT, boot-up, heartbeat, node guarding."""

from collections.abc import Callable
from itertools import pairwise
from statistics import median
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import ENTERED, Decorator, NodeTester, Table, upload_request

CHECKS: Final = Table()
check: Final = CHECKS.check
_NMT: Final = "CiA 301, 7.2.8"
_BOOT: Final = "CiA 301, 7.3.2"
_HEARTBEAT: Final = "CiA 301, 7.2.8 and object 1017h"
_CONSUMER: Final = "CiA 301, 7.2.8 and object 1016h"
_GUARDING: Final = "CiA 301, 7.2.8 and objects 100Ch, 100Dh"
_MASTER: Final = 126
"""Node id of the tester's heartbeat."""

# ---------------------------------------------------------------- boot-up


def _boots(command: int) -> None:
    name = "node" if command == NmtCommand.RESET_NODE else "communication"

    @check(f"nmt.reset-{name}", f"NMT reset {name} is followed by a boot-up message", _BOOT)
    def _(t: NodeTester) -> None:
        t.reset(command)

    @check(f"nmt.reset-{name}.pre-operational", f"After reset {name} the node is PRE-OPERATIONAL", _BOOT)
    def _(t: NodeTester) -> None:
        t.reset(command)
        t.watch_state()
        t.equal(t.state(), ENTERED[_PRE], "NMT state")

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


@check("nmt.boot-up.frame", "The boot-up message is 700h + node id with one byte, 00h", _BOOT)
def _(t: NodeTester) -> None:
    t.equal(t.reset().data, b"\0", "data of the boot-up message")


@check("nmt.boot-up.once", "A reset is followed by one boot-up message", _BOOT)
def _(t: NodeTester) -> None:
    beats = t.heard_after(0x700 + t.node_id, 0.1, t.reset)
    t.equal(sum(frame.data == b"\0" for frame in beats), 1, "number of boot-up messages")


@check("nmt.reset-communication.parameters", "Reset communication restores 1000h to 1FFFh", _BOOT, 0x1017)
def _(t: NodeTester) -> None:
    t.reset()
    before = t.read(0x1017)
    t.put(0x1017, 0, before + 500, 2)
    t.reset()
    t.equal(t.read(0x1017), before, "1017h")


@check("nmt.reset-communication.application", "Reset communication leaves application objects alone", _BOOT)
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


def _transition(name: str, first: NmtCommand, command: NmtCommand) -> None:
    text = f"NMT command {command} leads from {ENTERED[first]} to {ENTERED[command]}"

    @check(f"nmt.{name}", text, _NMT)
    def _(t: NodeTester) -> None:
        t.enter(first)
        t.enter(command)


_PRE: Final = NmtCommand.PRE_OPERATIONAL
_START: Final = NmtCommand.START
_STOP: Final = NmtCommand.STOP
_transition("start", _PRE, _START)
_transition("stop", _PRE, _STOP)
_transition("start-from-stopped", _STOP, _START)
_transition("stop-from-operational", _START, _STOP)
_transition("enter-pre-operational", _START, _PRE)
_transition("enter-pre-operational-from-stopped", _STOP, _PRE)


@check("nmt.repeated", "A repeated NMT start changes nothing", _NMT)
def _(t: NodeTester) -> None:
    t.enter(_START)
    t.enter(_START)


@check("nmt.reset-from-stopped", "Reset communication is obeyed in STOPPED", _NMT)
def _(t: NodeTester) -> None:
    t.enter(_STOP)
    t.reset()


@check("nmt.broadcast", "A command to node 0 is obeyed", _NMT, first=NodeTester.watch_state)
def _(t: NodeTester) -> None:
    t.nmt(_START, 0)
    t.equal(t.state(), ENTERED[_START], "NMT state")


def _ignored(name: str, what: str, send: Callable[[NodeTester], None]) -> None:
    @check(f"nmt.ignores.{name}", f"The node ignores {what}", _NMT, first=NodeTester.watch_state)
    def _(t: NodeTester) -> None:
        send(t)
        t.equal(t.state(), ENTERED[_PRE], "NMT state")


_ignored("other-node", "a command to another node", lambda t: t.nmt(_START, t.node_id % 127 + 1))
_ignored("reserved", "a reserved command", lambda t: t.nmt(3))
_ignored("short", "a command of one byte", lambda t: t.send(0x000, bytes((_START,))))
_ignored(
    "extended",
    "a command with a 29-bit identifier",
    lambda t: t.send_special(0, bytes((_START, t.node_id))),
)


def _sdo(command: NmtCommand, *, answers: bool) -> None:
    text, state = "are answered" if answers else "are not answered", ENTERED[command]

    @check(f"nmt.sdo.{state.lower()}", f"SDO requests {text} in {state}", _BOOT)
    def _(t: NodeTester) -> None:
        t.enter(command)
        answer = t.ask(upload_request(0x1000))
        t.equal("an answer" if answer else "no answer", "an answer" if answers else "no answer")


_sdo(_PRE, answers=True)
_sdo(_START, answers=True)
_sdo(_STOP, answers=False)


def _no_pdo(command: NmtCommand) -> None:
    @check(f"nmt.pdo.{ENTERED[command].lower()}", f"No PDO is sent in {ENTERED[command]}", _BOOT)
    def _(t: NodeTester) -> None:
        can_id = t.map_pdo(0x1800, ((0x1001, 0, 8),), 1)
        t.enter(command)
        found = [t.heard_after(can_id, 0.02, t.sync) for _ in range(3)]
        t.equal(sum(map(len, found)), 0, "number of TPDOs")


_no_pdo(_PRE)
_no_pdo(_STOP)

# ---------------------------------------------------------------- heartbeat


def _beats(t: NodeTester, period_ms: int, count: int = 5) -> list[float]:
    t.require(0x1017)
    t.write(0x1017, 0, period_ms, 2)
    duration_s = 1e-3 * period_ms * (count + 1) + t.timing.jitter_s
    times = [frame.time_s for frame in t.heard_after(0x700 + t.node_id, duration_s)]
    t.true(len(times) >= count - 1, f"{len(times)} heartbeats in {count + 1} periods", f"about {count}")
    return times


def _period(t: NodeTester, period_ms: int) -> None:
    times = _beats(t, period_ms)
    intervals = [after - before for before, after in pairwise(times)]
    t.near(median(intervals), 1e-3 * period_ms, "period of the heartbeat")


@check("heartbeat.period", "Heartbeats come with the period of 1017h", _HEARTBEAT)
def _(t: NodeTester) -> None:
    _period(t, 100)


@check("heartbeat.period.other", "A new value of 1017h changes the period", _HEARTBEAT, 0x1017)
def _(t: NodeTester) -> None:
    t.write(0x1017, 0, 100, 2)
    t.wait(0.25)
    _period(t, 250)


@check("heartbeat.off", "1017h = 0 ends the heartbeat", _HEARTBEAT)
def _(t: NodeTester) -> None:
    _beats(t, 50)
    t.put(0x1017, 0, 0, 2)
    t.equal(len(t.heard_after(0x700 + t.node_id, 0.3)), 0, "number of heartbeats")


@check("heartbeat.frame", "A heartbeat has one byte", _HEARTBEAT)
def _(t: NodeTester) -> None:
    _beats(t, 50)
    lengths = {len(frame.data) for frame in t.heard(0x700 + t.node_id)}
    t.equal(lengths, {1}, "length")


@check("heartbeat.toggle", "Bit 7 of a heartbeat is 0", _HEARTBEAT)
def _(t: NodeTester) -> None:
    _beats(t, 50)
    bits = {frame.data[0] >> 7 for frame in t.heard(0x700 + t.node_id) if frame.data}
    t.equal(bits, {0}, "bit 7")


def _heartbeat_state(command: NmtCommand, value: int) -> None:
    state = ENTERED[command]

    @check(f"heartbeat.{state.lower()}", f"The heartbeat in {state} is {value:02X}h", _HEARTBEAT, 0x1017)
    def _(t: NodeTester) -> None:
        t.write(0x1017, 0, 50, 2)
        t.nmt(command)
        data = t.reply(0x700 + t.node_id, timeout_s=0.2 + t.timing.jitter_s)
        t.equal(data, bytes((value,)), "data")


_heartbeat_state(_PRE, 0x7F)
_heartbeat_state(_START, 0x05)
_heartbeat_state(_STOP, 0x04)

# ---------------------------------------------------------------- heartbeat consumer


def _watch(t: NodeTester, time_ms: int = 100) -> None:
    t.require(0x1016, 1)
    t.write(0x1016, 1, _MASTER << 16 | time_ms, 4)


def _beat(t: NodeTester, count: int = 3, period_s: float = 0.04, node_id: int = _MASTER) -> None:
    for _ in range(count):
        t.send(0x700 + node_id, b"\x05")
        t.wait(period_s)


@check("consumer.idle", "The consumer waits for the first heartbeat", _CONSUMER, first=_watch)
def _(t: NodeTester) -> None:
    t.equal(t.emergencies_after(0.4), [], "EMCY codes")


@check("consumer.regular", "Heartbeats in time cause no error", _CONSUMER)
def _(t: NodeTester) -> None:
    _watch(t, 200)
    t.equal(t.emergencies_after(0.0, lambda: _beat(t, 8, 0.05)), [], "EMCY codes")


@check("consumer.loss", "A lost heartbeat is EMCY 8130h within the consumer time", _CONSUMER)
def _(t: NodeTester) -> None:
    lose_heartbeat(t)


@check("consumer.loss.time", "The EMCY comes when the consumer time is over", _CONSUMER)
def _(t: NodeTester) -> None:
    _watch(t, 200)
    _beat(t, 3)
    begun_s = t.now
    t.send(0x700 + _MASTER, b"\x05")
    frame = t.true(t.hears(0x080 + t.node_id, 0.4 + t.timing.jitter_s), "no EMCY", "EMCY 8130h after 200 ms")
    t.near(frame.time_s - begun_s, 0.2, "time to the EMCY")


@check("consumer.off", "1016h with time 0 supervises nothing", _CONSUMER, first=_watch)
def _(t: NodeTester) -> None:
    _beat(t)
    t.put(0x1016, 1, _MASTER << 16, 4)
    t.equal(t.emergencies_after(0.4), [], "EMCY codes")


@check("consumer.other-node", "Heartbeats of another node do not count", _CONSUMER, first=_watch)
def _(t: NodeTester) -> None:
    _beat(t)
    codes = t.emergencies_after(0.0, lambda: _beat(t, 8, 0.05, _MASTER - 1))
    t.true(0x8130 in codes, f"EMCY codes {codes}", "8130h")


@check("consumer.recovery", "A heartbeat that returns ends the error", _CONSUMER)
def _(t: NodeTester) -> None:
    lose_heartbeat(t)
    t.equal(t.emergencies_after(0.0, lambda: _beat(t))[-1:], [0], "last EMCY code")


def lose_heartbeat(t: NodeTester) -> None:
    """Makes the node lose the tester's heartbeat; fails unless it sends EMCY 8130h."""
    _watch(t)
    _beat(t)
    codes = t.emergencies_after(0.3)
    t.true(0x8130 in codes, f"EMCY codes {[f'{code:04X}h' for code in codes]}", "8130h within 100 ms")


def _behaviour(value: int, command: NmtCommand) -> None:
    state, clause = ENTERED[command], "CiA 301, object 1029h"

    @check(f"error-behaviour.{value}", f"1029h:01 = {value}: after a lost heartbeat {state}", clause)
    def _(t: NodeTester) -> None:
        t.require(0x1029, 1)
        t.write(0x1029, 1, value, 1)
        t.enter(_START)
        lose_heartbeat(t)
        t.equal(t.state(), state, "NMT state")
        t.nmt(_PRE)
        _beat(t)


_behaviour(0, _PRE)
_behaviour(1, _START)
_behaviour(2, _STOP)

# ---------------------------------------------------------------- node guarding


def _guarding(name: str, text: str, first: Callable[[NodeTester], None] | None = None) -> Decorator:
    return check(f"guarding.{name}", text, _GUARDING, 0x100C, 0x100D, first=first)


def _limit_life(t: NodeTester) -> None:
    """Sets a node life time of 200 ms."""
    t.write(0x100C, 0, 100, 2)
    t.write(0x100D, 0, 2, 1)


def _guard(t: NodeTester) -> bytes:
    answer = t.reply(0x700 + t.node_id, lambda: t.send_special(0x700 + t.node_id, remote=True))
    return t.true(answer, "no answer to the remote frame", "the NMT state")


@_guarding("answer", "A remote frame is answered with the NMT state")
def _(t: NodeTester) -> None:
    answer = _guard(t)
    t.equal((len(answer), answer[0] & 0x7F), (1, 0x7F), "length and state")


@_guarding("state", "The answer in OPERATIONAL has the state 05h")
def _(t: NodeTester) -> None:
    t.nmt(_START)
    t.equal(_guard(t)[0] & 0x7F, 0x05, "state")


@_guarding("toggle", "The toggle bit changes with every answer")
def _(t: NodeTester) -> None:
    bits = [_guard(t)[0] >> 7 for _ in range(4)]
    t.true(bits in ([0, 1, 0, 1], [1, 0, 1, 0]), f"toggle bits {bits}", "alternating")


@_guarding("toggle.first", "The first toggle bit after a reset is 0")
def _(t: NodeTester) -> None:
    _guard(t)
    t.reset()
    t.equal(_guard(t)[0] >> 7, 0, "toggle bit")


@_guarding("idle", "Life guarding waits for the first remote frame", _limit_life)
def _(t: NodeTester) -> None:
    t.equal(t.emergencies_after(0.5), [], "EMCY codes")


@_guarding("regular", "Remote frames in time cause no error", _limit_life)
def _(t: NodeTester) -> None:
    for _ in range(6):
        _guard(t)
        t.wait(0.08)
    t.equal(t.emergencies(), [], "EMCY codes")


@_guarding("loss", "No remote frame for the node life time is EMCY 8130h", _limit_life)
def _(t: NodeTester) -> None:
    begun_s = t.now
    _guard(t)
    frame = t.hears(0x080 + t.node_id, 0.5 + t.timing.jitter_s)
    lost = frame if frame is not None and frame.data[:2] == b"\x30\x81" else None
    t.near(t.true(lost, "no EMCY 8130h", "EMCY 8130h after 200 ms").time_s - begun_s, 0.2, "time to the EMCY")
