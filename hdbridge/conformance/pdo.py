"""Checks of PDOs and SYNC: communication and mapping parameters, transmission types, timers, reception."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Any, Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.steps import has_bits, parametrised, refuses, writes
from hdbridge.conformance.tester import (
    ABSENT,
    PDO_INVALID,
    RANGE,
    NodeTester,
    Table,
    abort_code,
    abort_codes,
    expedited,
    pack,
)
from hdbridge.drive.link import Frame

CHECKS: Final = Table()
check: Final = CHECKS.check
_PDO: Final = "CiA 301, 7.2.2 and objects 1400h to 1BFFh"
_COMMUNICATION: Final = "CiA 301, objects 1400h and 1800h"
_MAPPING: Final = "CiA 301, objects 1600h and 1A00h"
_SYNC: Final = "CiA 301, 7.2.5 and object 1005h"
_COUNTER: Final = "CiA 301, 7.2.5 and object 1019h"
_TPDO: Final = 0x1800
_RPDO: Final = 0x1400
_DUMMY: Final = (0x0005, 0, 8)
_REGISTER: Final = (0x1001, 0, 8)
_NOT_MAPPABLE: Final = (0x06040041, 0x06040042, 0x06010002, 0x06010000, *ABSENT)
_TOO_LONG: Final = (0x06040042, *RANGE)
_WRONG_LENGTH: Final = (*_NOT_MAPPABLE, 0x06070010, *RANGE)
_Object = tuple[int, int, int]
"""Index, sub-index and bits of an object."""
_OfObject = Callable[[NodeTester, _Object], None]
_SPARE_ID: Final = 0x57D
"""Identifier to which tests move PDOs and SYNC: the default of RPDO4 of node 125, not used by other nodes."""


def _kind(first: int) -> str:
    return "tpdo" if first == _TPDO else "rpdo"


def _word(index: int, sub: int, bits: int) -> bytes:
    return pack(index << 16 | sub << 8 | bits, 4)


def _syncs(t: NodeTester, can_id: int, count: int, counter: int | None = None) -> list[int]:
    """Sends SYNC ``count`` times; returns the number of frames in response to each."""
    counters = [None if counter is None else counter + place for place in range(count)]
    return [len(t.heard_after(can_id, 0.01, partial(t.sync, each))) for each in counters]


def _start(t: NodeTester) -> None:
    t.nmt(NmtCommand.START)
    t.wait(0.01)


# ---------------------------------------------------------------- communication parameters


def _default(kind: str, index: int, base: int) -> None:
    @check(f"{kind}.identifier", f"{index:04X}h:01 is {base:03X}h + node id by default", _COMMUNICATION)
    def _(t: NodeTester) -> None:
        t.need_pdo(index)
        t.reset()
        t.equal(f"{t.read(index, 1) & 0x7FF:03X}h", f"{base + t.node_id:03X}h", "identifier")

    @check(f"{kind}.parameters", f"{index:04X}h has sub-indices 1 and 2, and a mapping", _COMMUNICATION)
    def _(t: NodeTester) -> None:
        t.need_pdo(index)
        t.true(t.read(index, 0) >= 2, f"highest sub-index {t.read(index, 0)}", "2 or more")
        t.equal(len(t.upload(index, 2)), 1, "bytes of the transmission type")
        t.equal(len(t.upload(index + 0x200, 0)), 1, "bytes of the number of mapped objects")


for _place in range(4):
    _default(f"rpdo.{_place + 1}", _RPDO + _place, 0x200 + 0x100 * _place)
    _default(f"tpdo.{_place + 1}", _TPDO + _place, 0x180 + 0x100 * _place)


@check("tpdo.reserved", "Sub-index 4 of 1800h does not exist, or reads as 0", _COMMUNICATION)
def _(t: NodeTester) -> None:
    t.need(t.has_pdo(_TPDO), "no TPDO")
    t.true(not t.has(_TPDO, 4) or t.read(_TPDO, 4) == 0, "a value", "abort 06090011h")


def _transmission_type(first: int, value: int, *, allowed: bool) -> None:
    verb = "is accepted" if allowed else "is reserved and refused"

    @check(
        f"{_kind(first)}.type.{value}", f"Transmission type {value} of {first:04X}h {verb}", _COMMUNICATION
    )
    def _(t: NodeTester) -> None:
        t.need_pdo(first)
        t.switch_pdo_off(first)
        if allowed:
            t.write(first, 2, value, 1)
            t.equal(t.read(first, 2), value, "transmission type")
        else:
            t.refuses_value(first, 2, bytes((value,)), RANGE)


for _first in (_TPDO, _RPDO):
    for _value in (1, 240, 254, 255):
        _transmission_type(_first, _value, allowed=True)
    for _value in (241, 251):
        _transmission_type(_first, _value, allowed=False)


@parametrised
def _is_fixed(t: NodeTester, first: int, sub: int, change: Callable[[int], bytes]) -> None:
    """An entry of a PDO that exists cannot be changed."""
    t.map_pdo(first, (t.scratch() if first == _RPDO else _REGISTER,), 255)
    t.require(first, sub)
    t.refuses(expedited(first, sub, change(t.read(first, sub))), "change while the PDO exists")


CHECKS.rows(
    _COMMUNICATION,
    ("tpdo.identifier.fixed", "The identifier of a TPDO that exists cannot be changed",
     _is_fixed(_TPDO, 1, lambda now: pack(now & ~0x7FF | _SPARE_ID, 4))),
    ("rpdo.identifier.fixed", "The identifier of an RPDO that exists cannot be changed",
     _is_fixed(_RPDO, 1, lambda now: pack(now & ~0x7FF | _SPARE_ID, 4))),
    ("tpdo.inhibit.fixed", "The inhibit time of a TPDO that exists cannot be changed",
     _is_fixed(_TPDO, 3, lambda now: pack(now + 10, 2))),
)  # fmt: skip


# ---------------------------------------------------------------- mapping


def _mapping(first: int) -> None:
    mapping = first + 0x200
    name = f"{mapping:04X}h"

    def of_mapping(suffix: str, text: str, *, opened: bool = True) -> Callable[[_OfObject], None]:
        """Decorates the function of a check that receives the object mapped to the PDO.

        ``opened``: the PDO is switched off.
        """

        def add(function: _OfObject) -> None:
            @check(f"{_kind(first)}.mapping.{suffix}", text, _MAPPING)
            def _(t: NodeTester) -> None:
                mapped = t.scratch()
                t.map_pdo(first, (mapped,), 255)
                if opened:
                    t.switch_pdo_off(first)
                function(t, mapped)

        return add

    @of_mapping("valid", f"The mapping of {name} is fixed while the PDO exists", opened=False)
    def _(t: NodeTester, _: _Object) -> None:
        t.refuses(expedited(mapping, 0, b"\0"), "number of mapped objects")

    @of_mapping("count", f"An entry of {name} is fixed while sub-index 0 is not 0")
    def _(t: NodeTester, mapped: _Object) -> None:
        t.refuses(expedited(mapping, 1, _word(*mapped)), "mapping entry")

    def refused(
        suffix: str, text: str, entry: _Object | None, codes: tuple[int, ...] = _NOT_MAPPABLE
    ) -> None:
        """Adds a check with a mapping entry; None is the mapped object with a wrong length."""

        @of_mapping(suffix, f"{name}: {text}")
        def _(t: NodeTester, mapped: _Object) -> None:
            t.write(mapping, 0, 0, 1)
            index, sub, bits = mapped
            word = _word(*(entry or (index, sub, bits - 8 if bits > 8 else 16)))
            if code := abort_code(t.answer(expedited(mapping, 1, word))):
                t.true(code in codes, f"abort {code:08X}h", abort_codes(codes))
            else:  # the node may refuse the entry when sub-index 0 activates it
                t.aborts(expedited(mapping, 0, b"\x01"), codes, "activation of the entry")

    refused("missing", "an object that does not exist cannot be mapped", (0x1F7F, 0, 8))
    refused("not-mappable", "an object without PDO mapping cannot be mapped", (0x1018, 1, 32))
    refused("length", "a wrong length of a mapped object is refused", None, _WRONG_LENGTH)
    if first == _RPDO:
        refused("read-only", "a read-only object cannot be received", _REGISTER)

    @of_mapping("too-many-bytes", f"{name}: more than eight bytes are refused")
    def _(t: NodeTester, mapped: _Object) -> None:
        t.write(mapping, 0, 0, 1)
        count = 64 // mapped[2] + 1
        t.need(t.has(mapping, count), f"only {count - 1} objects can be mapped")
        for place in range(1, count + 1):
            if abort_code(t.answer(expedited(mapping, place, _word(*mapped)))):
                return  # refused when the entry was written
        t.aborts(expedited(mapping, 0, bytes((count,))), _TOO_LONG, "number of mapped objects")

    @of_mapping("too-many-objects", f"{name}: sub-index 0 beyond its entries is refused")
    def _(t: NodeTester, _: _Object) -> None:
        t.aborts(expedited(mapping, 0, b"\x41"), _TOO_LONG, "65 mapped objects")


_mapping(_TPDO)
_mapping(_RPDO)


def _carried(t: NodeTester, *objects: _Object) -> bytes | None:
    """Returns the data of a TPDO with these objects at the next SYNC, or None."""
    return t.reply(_sent(t, objects, 1), t.sync)


@check("tpdo.mapping.data", "A TPDO carries the value of its object", _PDO)
def _(t: NodeTester) -> None:
    mapped = t.scratch()
    t.equal(_carried(t, mapped), t.upload(*mapped[:2]), "data")


@check("tpdo.mapping.order", "A TPDO carries its objects in the order of the mapping", _PDO)
def _(t: NodeTester) -> None:
    mapped = t.scratch()
    found, register = _carried(t, _REGISTER, mapped, _REGISTER), t.upload(0x1001)
    t.equal(found, register + t.upload(*mapped[:2]) + register, "data")


# ---------------------------------------------------------------- transmission of TPDOs


def _sent(
    t: NodeTester,
    objects: tuple[_Object, ...],
    transmission: int,
    can_id: int | None = None,
    timers: dict[int, int] | None = None,
) -> int:
    """Maps objects to TPDO 1 and starts the node; returns the identifier."""
    used = t.map_pdo(_TPDO, objects, transmission, can_id, timers)
    _start(t)
    return used


@parametrised
def _sends_every(t: NodeTester, number: int) -> None:
    """The node sends a TPDO once in ``number`` SYNCs."""
    can_id = _sent(t, (_REGISTER,), number)
    answers = _syncs(t, can_id, 3 * number)
    t.equal(sum(answers), 3, f"TPDOs at {3 * number} SYNCs")
    t.equal(max(answers), 1, "TPDOs at one SYNC")
    gaps = [place for place, count in enumerate(answers) if count]
    t.equal([b - a for a, b in pairwise(gaps)], [number, number], "SYNCs between TPDOs")


CHECKS.rows(
    _PDO,
    *((f"tpdo.sync.{number}", f"Transmission type {number}: a TPDO every {period}", _sends_every(number))
      for number, period in ((1, "SYNC"), (2, "second SYNC"), (5, "fifth SYNC"))),
)  # fmt: skip


@check("tpdo.sync.0", "Transmission type 0: a TPDO at the SYNC after a change, and only then", _PDO)
def _(t: NodeTester) -> None:
    mapped = t.scratch()
    can_id = _sent(t, (mapped,), 0)
    _syncs(t, can_id, 2)
    t.equal(_syncs(t, can_id, 2), [0, 0], "TPDOs without a change")
    early = t.heard_after(can_id, 0.02, lambda: t.change(*mapped))
    t.equal(len(early), 0, "TPDOs between the change and SYNC")
    t.equal(_syncs(t, can_id, 2), [1, 0], "TPDOs after a change")


@check("tpdo.disabled", "A TPDO with bit 31 set is not sent", _PDO)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(_TPDO, (_REGISTER,), 1)
    t.put(_TPDO, 1, t.read(_TPDO, 1) | PDO_INVALID, 4)
    _start(t)
    t.equal(_syncs(t, can_id, 3), [0, 0, 0], "TPDOs")


CHECKS.rows(
    _PDO,
    ("tpdo.sync.none", "A synchronous TPDO is not sent without SYNC",
     lambda t: t.equal(len(t.heard_after(_sent(t, (_REGISTER,), 1), 0.2)), 0, "number of TPDOs")),
    ("tpdo.identifier.other", "A TPDO is sent with the identifier that was written",
     lambda t: t.equal(_syncs(t, _sent(t, (_REGISTER,), 1, _SPARE_ID), 2), [1, 1],
                       "TPDOs with the new identifier")),
)  # fmt: skip


def _event(kind: int) -> None:
    @check(f"tpdo.event.{kind}", f"Transmission type {kind}: a change is sent at once", _PDO)
    def _(t: NodeTester) -> None:
        mapped = t.scratch()
        can_id = _sent(t, (mapped,), kind, timers=_off(t, 5))
        t.wait(0.05)
        data = t.reply(can_id, lambda: t.change(*mapped), 0.1)
        t.equal(data, t.upload(*mapped[:2]), "data after the change")

    @check(f"tpdo.event.{kind}.quiet", f"Transmission type {kind}: nothing is sent without an event", _PDO)
    def _(t: NodeTester) -> None:
        can_id = _sent(t, (t.scratch(),), kind, timers=_off(t, 5))
        t.wait(0.1)
        found = [t.heard_after(can_id, 0.05, t.sync) for _ in range(3)]
        t.equal(sum(map(len, found)), 0, "number of TPDOs")


def _off(t: NodeTester, sub: int) -> dict[int, int]:
    return {sub: 0} if t.has(_TPDO, sub) else {}


_event(254)
_event(255)


@check("tpdo.event-timer", "The event timer repeats a TPDO", _PDO, (_TPDO, 5))
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 255, timers={5: 50})
    times = [frame.time_s for frame in t.heard_after(can_id, 0.4)]
    t.true(len(times) >= 4, f"{len(times)} TPDOs in 400 ms", "8")
    t.near(median(after - before for before, after in pairwise(times)), 0.05, "period")


@check("tpdo.event-timer.off", "Event timer 0 repeats nothing", _PDO, (_TPDO, 5))
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 255, timers={5: 0})
    t.wait(0.05)
    t.equal(len(t.heard_after(can_id, 0.3)), 0, "number of TPDOs")


def _inhibited(t: NodeTester, count: int, pause_s: float) -> tuple[list[Frame], bytes]:
    """Changes an object of a TPDO with an inhibit time of 100 ms to and fro, ``count`` times.

    Returns the TPDOs until ``pause_s`` after the last change, and the final value.
    """
    mapped = index, sub, bits = t.scratch()
    t.require(_TPDO, 3)
    can_id = _sent(t, (mapped,), 255, timers={3: 1000, **_off(t, 5)})
    t.wait(0.2)
    since = t.mark()
    before = t.upload(index, sub)
    for _ in range(count):
        t.put(index, sub, t.other_value(index, sub), bits // 8)
        t.wait(0.02)
        t.download(index, sub, before)
        t.wait(pause_s)
    return t.heard(can_id, since), before


@check("tpdo.inhibit", "Successive changes are sent at least the inhibit time apart", _PDO)
def _(t: NodeTester) -> None:
    times = [frame.time_s for frame in _inhibited(t, 8, 0.02)[0]]
    shortest = min((after - start for start, after in pairwise(times)), default=0.0)
    t.true(len(times) >= 2, f"{len(times)} TPDOs in 320 ms", "3 or 4")
    t.true(shortest > 0.1 - t.timing.jitter_s, f"{1000 * shortest:.1f} ms between TPDOs", "100 ms or more")


@check("tpdo.inhibit.last", "The last change within the inhibit time is sent when it ends", _PDO)
def _(t: NodeTester) -> None:
    frames, before = _inhibited(t, 1, 0.2)
    t.equal(frames[-1].data if frames else None, before, "data of the last TPDO")


# ---------------------------------------------------------------- reception


class _Reception:
    """Scratch object mapped to RPDO 1 after the objects ``ahead``.

    ``before`` is its original value, ``value`` a different one to be sent.
    """

    def __init__(
        self,
        t: NodeTester,
        transmission: int,
        *,
        can_id: int | None = None,
        ahead: tuple[_Object, ...] = (),
        start: bool = True,
    ) -> None:
        self.t = t
        self.index, self.sub, bits = t.scratch()
        self.size = bits // 8
        self.value, self.before = t.other_value(self.index, self.sub), t.read(self.index, self.sub)
        t.write(self.index, self.sub, self.before, self.size)
        self.can_id = t.map_pdo(_RPDO, (*ahead, (self.index, self.sub, bits)), transmission, can_id)
        if start:
            _start(t)

    def data(self, value: int | None = None) -> bytes:
        return pack(self.value if value is None else value, self.size)

    def send(self, data: bytes | None = None) -> None:
        self.t.send(self.can_id, self.data() if data is None else data)

    def read(self) -> int:
        """Returns the object's value once the node had time to process a frame."""
        self.t.wait(0.02)
        return self.t.read(self.index, self.sub)

    def holds(self, value: int, when: str, found: int | None = None) -> None:
        """Fails unless ``found`` equals ``value``; by default ``found`` is read."""
        found = self.read() if found is None else found
        self.t.equal(found, value, f"{self.index:04X}h:{self.sub:02X} {when}")

    def after(self, data: bytes) -> int:
        """Sends an RPDO of wrong length and returns the object's value; then ends the error with a correct
        RPDO.
        """
        self.send(data)
        found = self.read()
        self.send(self.data(self.before))
        return found


@parametrised
def _received(
    t: NodeTester,
    /,
    when: str = "after the RPDO",
    act: Callable[[_Reception], None] = _Reception.send,
    transmission: int = 255,
    *,
    taken: bool = False,
    **options: Any,
) -> None:
    """After ``act``, the object has the value sent if ``taken``, else its original value."""
    rpdo = _Reception(t, transmission, **options)
    act(rpdo)
    rpdo.holds(rpdo.value if taken else rpdo.before, when)


def _send_and_sync(rpdo: _Reception) -> None:
    rpdo.send()
    rpdo.t.sync()


def _send_two_and_sync(rpdo: _Reception) -> None:
    rpdo.send(rpdo.data(rpdo.value + 5))
    _send_and_sync(rpdo)


def _send_and_restart(rpdo: _Reception) -> None:
    rpdo.send()
    rpdo.t.nmt(NmtCommand.PRE_OPERATIONAL)
    _start(rpdo.t)
    rpdo.t.sync()


def _send_when_off(rpdo: _Reception) -> None:
    rpdo.t.put(_RPDO, 1, rpdo.t.read(_RPDO, 1) | PDO_INVALID, 4)
    rpdo.send()


CHECKS.rows(
    _PDO,
    ("rpdo.event", "An RPDO of type 255 takes effect at once", _received(taken=True)),
    ("rpdo.sync.before", "A synchronous RPDO has no effect before SYNC",
     _received("before SYNC", transmission=1)),
    ("rpdo.sync.after", "A synchronous RPDO takes effect at SYNC",
     _received("after SYNC", _send_and_sync, 1, taken=True)),
    ("rpdo.sync.last", "The last of two synchronous RPDOs takes effect",
     _received("after SYNC", _send_two_and_sync, 1, taken=True)),
    ("rpdo.pre-operational", "An RPDO in PRE-OPERATIONAL has no effect", _received(start=False)),
    ("rpdo.stale", "An RPDO received before PRE-OPERATIONAL has no effect when the node starts again",
     _received("after NMT start and SYNC", _send_and_restart, 1)),
    ("rpdo.disabled", "An RPDO with bit 31 set has no effect", _received(act=_send_when_off)),
    ("rpdo.identifier.other", "An RPDO is received with the identifier that was written",
     _received(taken=True, can_id=_SPARE_ID)),
    ("rpdo.extended", "A frame with a 29-bit identifier is not an RPDO",
     _received("after the frame", lambda rpdo: rpdo.t.send_special(rpdo.can_id, rpdo.data()))),
)  # fmt: skip


@check("rpdo.sync.once", "A synchronous RPDO takes effect only once", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send()
    t.sync()
    t.wait(0.02)
    t.put(rpdo.index, rpdo.sub, rpdo.before, rpdo.size)
    t.sync()
    rpdo.holds(rpdo.before, "after a second SYNC without an RPDO")


@check("rpdo.short", "An RPDO that is too short has no effect", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    t.need(rpdo.size > 1, "the object has one byte")
    rpdo.holds(rpdo.before, "after the RPDO", rpdo.after(rpdo.data()[:-1]))


@check("rpdo.short.emergency", "An RPDO that is too short leads to EMCY 8210h", "CiA 301, 7.2.7")
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    codes = t.emergencies_after(0.05, lambda: rpdo.send(rpdo.data()[:-1]))
    rpdo.send()
    t.true(0x8210 in codes, f"EMCY codes {[f'{code:04X}h' for code in codes]}", "8210h")


@check("rpdo.long", "The first bytes of an RPDO that is too long take effect", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    rpdo.holds(rpdo.value, "after the RPDO", rpdo.after(rpdo.data() + b"\xff"))


@check("rpdo.order", "An RPDO fills its objects in the order of the mapping", _PDO)
def _(t: NodeTester) -> None:
    _, _, bits = t.scratch()
    t.need(bits <= 32, "the object has more than four bytes")
    t.need(_maps_dummy(t), "dummy objects cannot be mapped")
    rpdo = _Reception(t, 255, ahead=(_DUMMY,))
    rpdo.send(b"\xaa" + rpdo.data())
    rpdo.holds(rpdo.value, "behind a dummy byte")


def _maps_dummy(t: NodeTester) -> bool:
    t.need(t.has_pdo(_RPDO), "no RPDO")
    t.switch_pdo_off(_RPDO)
    t.write(_RPDO + 0x200, 0, 0, 1)
    before = t.read(_RPDO + 0x200, 1)
    if abort_code(t.answer(expedited(_RPDO + 0x200, 1, _word(*_DUMMY)))):
        return False
    t.put(_RPDO + 0x200, 1, before, 4)
    return True


# ---------------------------------------------------------------- SYNC


@check("sync.identifier.other", "SYNC is received with the identifier in 1005h", _SYNC, 0x1005)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(_TPDO, (_REGISTER,), 1)
    t.write(0x1005, 0, _SPARE_ID, 4)
    _start(t)
    found = t.heard_after(can_id, 0.02, lambda: t.send(_SPARE_ID))
    t.equal(len(found), 1, "TPDOs at the new SYNC")
    t.equal(_syncs(t, can_id, 2), [0, 0], "TPDOs at the old SYNC")


@parametrised
def _counted(
    t: NodeTester, transmission: int, expected: list[int], timers: dict[int, int] | None = None
) -> None:
    """Numbers of TPDOs at the SYNCs of a counter from 1 on, which overflows at 10."""
    t.write(0x1019, 0, 10, 1)
    can_id = _sent(t, (_REGISTER,), transmission, timers=timers)
    t.equal(_syncs(t, can_id, len(expected), 1), expected, "TPDOs at the counters from 1 on")


CHECKS.rows(
    _SYNC,
    ("sync.identifier", "1005h is 80h by default", 0x1005, NodeTester.reset,
     has_bits(0x1005, 0x7FF, 0x80, "identifier")),
    ("sync.identifier.zero", "1005h: identifier 0, which is NMT, is refused", 0x1005,
     refuses(0x1005, 0, bytes(4), RANGE)),
)  # fmt: skip
CHECKS.rows(
    _COUNTER,
    ("sync.counter", "SYNC with a counter triggers TPDOs", 0x1019, _counted(1, [1, 1, 1])),
    ("sync.counter.start", "SYNC start value: the first TPDO is sent at this counter value", 0x1019,
     (_TPDO, 6), _counted(2, [0, 0, 1, 0, 1, 0, 1, 0], {6: 3})),
    ("sync.overflow.240", "Overflow value 240 in 1019h is accepted", 0x1019, writes(0x1019, 0, 240, 1)),
    ("sync.overflow.1", "Overflow value 1 in 1019h is refused", 0x1019, refuses(0x1019, 0, b"\1", RANGE)),
    ("sync.overflow.241", "Overflow value 241 in 1019h is refused", 0x1019,
     refuses(0x1019, 0, bytes((241,)), RANGE)),
)  # fmt: skip
