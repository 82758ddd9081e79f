"""Checks of PDOs and SYNC: communication and mapping parameters, transmission types, timers, reception."""

from collections.abc import Callable
from itertools import pairwise
from statistics import median
from typing import Final

from hdbridge.conformance.tester import (
    ABSENT,
    NMT_PRE_OPERATIONAL,
    NMT_START,
    PDO_INVALID,
    RANGE,
    NodeTester,
    Table,
    expedited,
    pack,
)

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
_SPARE_ID: Final = 0x57D
"""Identifier to which tests move PDOs and SYNC: the default of RPDO4 of node 125, not used by other nodes."""


def _word(index: int, sub: int, bits: int) -> bytes:
    return pack(index << 16 | sub << 8 | bits, 4)


def _syncs(t: NodeTester, can_id: int, count: int, counter: int | None = None) -> list[int]:
    """Sends SYNC ``count`` times; returns the number of frames in response to each."""
    answers = []
    for place in range(count):
        since = t.mark()
        t.sync(None if counter is None else counter + place)
        t.wait(0.01)
        answers.append(len(t.heard(can_id, since)))
    return answers


def _start(t: NodeTester) -> None:
    t.nmt(NMT_START)
    t.wait(0.01)


# ---------------------------------------------------------------- communication parameters


def _default(first: int, number: int, base: int) -> None:
    name = f"{'tpdo' if first == _TPDO else 'rpdo'}.{number}"

    @check(
        f"{name}.identifier",
        f"{first + number - 1:04X}h:01 is {base:03X}h + node id by default",
        _COMMUNICATION,
    )
    def _(t: NodeTester) -> None:
        index = first + number - 1
        t.need(t.has_pdo(index), f"no PDO at {index:04X}h")
        t.reset()
        t.equal(f"{t.read(index, 1) & 0x7FF:03X}h", f"{base + t.node_id:03X}h", "identifier")

    @check(
        f"{name}.parameters",
        f"{first + number - 1:04X}h has sub-indices 1 and 2, and a mapping",
        _COMMUNICATION,
    )
    def _(t: NodeTester) -> None:
        index = first + number - 1
        t.need(t.has_pdo(index), f"no PDO at {index:04X}h")
        t.true(t.read(index, 0) >= 2, f"highest sub-index {t.read(index, 0)}", "2 or more")
        t.equal(len(t.upload(index, 2)), 1, "bytes of the transmission type")
        t.equal(len(t.upload(index + 0x200, 0)), 1, "bytes of the number of mapped objects")


for _number in (1, 2, 3, 4):
    _default(_RPDO, _number, 0x100 + 0x100 * _number)
    _default(_TPDO, _number, 0x080 + 0x100 * _number)


@check("tpdo.reserved", "Sub-index 4 of 1800h does not exist, or reads as 0", _COMMUNICATION)
def _(t: NodeTester) -> None:
    t.need(t.has_pdo(_TPDO), "no TPDO")
    t.true(not t.has(_TPDO, 4) or t.read(_TPDO, 4) == 0, "a value", "abort 06090011h")


def _transmission_type(first: int, value: int, *, allowed: bool) -> None:
    name = "tpdo" if first == _TPDO else "rpdo"
    verb = "is accepted" if allowed else "is reserved and refused"

    @check(f"{name}.type.{value}", f"Transmission type {value} of {first:04X}h {verb}", _COMMUNICATION)
    def _(t: NodeTester) -> None:
        t.need(t.has_pdo(first), f"no PDO at {first:04X}h")
        t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
        if allowed:
            t.write(first, 2, value, 1)
            t.equal(t.read(first, 2), value, "transmission type")
        else:
            t.refuses_value(first, 2, bytes((value,)), RANGE)


for _first in (_TPDO, _RPDO):
    for _value, _allowed in ((1, True), (240, True), (254, True), (255, True), (241, False), (251, False)):
        _transmission_type(_first, _value, allowed=_allowed)


def _fixed_while_valid(name: str, first: int, text: str, sub: int, change: Callable[[int], bytes]) -> None:
    @check(f"{name}.fixed", text, _COMMUNICATION)
    def _(t: NodeTester) -> None:
        kind = ((*t.scratch(),),) if first == _RPDO else (_REGISTER,)
        t.map_pdo(first, kind, 255)
        t.require(first, sub)
        t.refuses(expedited(first, sub, change(t.read(first, sub))), "change while the PDO exists")


_fixed_while_valid(
    "tpdo.identifier", _TPDO, "The identifier of a TPDO that exists cannot be changed", 1,
    lambda now: pack(now & ~0x7FF | _SPARE_ID, 4),
)  # fmt: skip
_fixed_while_valid(
    "rpdo.identifier", _RPDO, "The identifier of an RPDO that exists cannot be changed", 1,
    lambda now: pack(now & ~0x7FF | _SPARE_ID, 4),
)  # fmt: skip
_fixed_while_valid(
    "tpdo.inhibit", _TPDO, "The inhibit time of a TPDO that exists cannot be changed", 3,
    lambda now: pack(now + 10, 2),
)  # fmt: skip


# ---------------------------------------------------------------- mapping


def _fixed_mapping(first: int) -> None:
    name = "tpdo" if first == _TPDO else "rpdo"

    def prepare(t: NodeTester) -> tuple[int, int, int]:
        kind = t.scratch()
        t.map_pdo(first, (kind,), 255)
        return kind

    @check(
        f"{name}.mapping.valid",
        f"The mapping of {first + 0x200:04X}h is fixed while the PDO exists",
        _MAPPING,
    )
    def _(t: NodeTester) -> None:
        prepare(t)
        t.refuses(expedited(first + 0x200, 0, b"\0"), "number of mapped objects")

    @check(
        f"{name}.mapping.count",
        f"An entry of {first + 0x200:04X}h is fixed while sub-index 0 is not 0",
        _MAPPING,
    )
    def _(t: NodeTester) -> None:
        kind = prepare(t)
        t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
        t.refuses(expedited(first + 0x200, 1, _word(*kind)), "mapping entry")

    def refused(suffix: str, text: str, word: Callable[[NodeTester], bytes], codes: tuple[int, ...]) -> None:
        @check(f"{name}.mapping.{suffix}", text.format(f"{first + 0x200:04X}h"), _MAPPING)
        def _(t: NodeTester) -> None:
            wanted = word(t)
            prepare(t)
            t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
            t.write(first + 0x200, 0, 0, 1)
            _refuses_entry(t, first + 0x200, wanted, codes)

    refused(
        "missing",
        "{}: an object that does not exist cannot be mapped",
        lambda _: _word(0x1F7F, 0, 8),
        _NOT_MAPPABLE,
    )
    refused(
        "not-mappable",
        "{}: an object without PDO mapping cannot be mapped",
        lambda _: _word(0x1018, 1, 32),
        _NOT_MAPPABLE,
    )
    refused(
        "length",
        "{}: a wrong length of a mapped object is refused",
        _wrong_length,
        (*_NOT_MAPPABLE, 0x06070010, *RANGE),
    )
    if first == _RPDO:
        refused(
            "read-only",
            "{}: a read-only object cannot be received",
            lambda _: _word(*_REGISTER),
            _NOT_MAPPABLE,
        )

    @check(
        f"{name}.mapping.too-many-bytes", f"{first + 0x200:04X}h: more than eight bytes are refused", _MAPPING
    )
    def _(t: NodeTester) -> None:
        index, sub, bits = prepare(t)
        t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
        t.write(first + 0x200, 0, 0, 1)
        count = 64 // bits + 1
        t.need(t.has(first + 0x200, count), f"only {count - 1} objects can be mapped")
        for place in range(1, count + 1):
            answer = t.answer(expedited(first + 0x200, place, _word(index, sub, bits)))
            if answer[0] == 0x80:
                return  # refused when the entry was written
        t.aborts(expedited(first + 0x200, 0, bytes((count,))), _TOO_LONG, "number of mapped objects")

    @check(
        f"{name}.mapping.too-many-objects",
        f"{first + 0x200:04X}h: sub-index 0 beyond its entries is refused",
        _MAPPING,
    )
    def _(t: NodeTester) -> None:
        prepare(t)
        t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
        t.aborts(expedited(first + 0x200, 0, b"\x41"), _TOO_LONG, "65 mapped objects")


def _wrong_length(t: NodeTester) -> bytes:
    index, sub, bits = t.scratch()
    return _word(index, sub, bits - 8 if bits > 8 else 16)


def _refuses_entry(t: NodeTester, mapping: int, word: bytes, codes: tuple[int, ...]) -> None:
    """Fails unless the node refuses a mapping entry, either at once or when sub-index 0 activates it."""
    answer = t.answer(expedited(mapping, 1, word))
    if answer[0] == 0x80:
        code = int.from_bytes(answer[4:], "little")
        t.true(code in codes, f"abort {code:08X}h", f"abort {' or '.join(f'{each:08X}h' for each in codes)}")
        return
    t.aborts(expedited(mapping, 0, b"\x01"), codes, "activation of the entry")


_fixed_mapping(_TPDO)
_fixed_mapping(_RPDO)


@check("tpdo.mapping.data", "A TPDO carries the value of its object", _PDO)
def _(t: NodeTester) -> None:
    kind = t.scratch()
    can_id = _sent(t, (kind,), 1)
    since = t.mark()
    t.sync()
    frame = t.hears(can_id, since=since)
    t.equal(None if frame is None else frame.data, t.upload(*kind[:2]), "data")


@check("tpdo.mapping.order", "A TPDO carries its objects in the order of the mapping", _PDO)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    can_id = _sent(t, (_REGISTER, (index, sub, bits), _REGISTER), 1)
    since = t.mark()
    t.sync()
    frame = t.hears(can_id, since=since)
    register = t.upload(0x1001)
    t.equal(None if frame is None else frame.data, register + t.upload(index, sub) + register, "data")


# ---------------------------------------------------------------- transmission of TPDOs


def _sent(
    t: NodeTester,
    objects: tuple[tuple[int, int, int], ...],
    transmission: int,
    can_id: int | None = None,
    timers: dict[int, int] | None = None,
) -> int:
    """Maps objects to TPDO 1 and starts the node; returns the identifier."""
    used = t.map_pdo(_TPDO, objects, transmission, can_id, timers)
    _start(t)
    return used


def _every(number: int) -> None:
    @check(f"tpdo.sync.{number}", f"Transmission type {number}: a TPDO at every {number}. SYNC", _PDO)
    def _(t: NodeTester) -> None:
        can_id = _sent(t, (_REGISTER,), number)
        answers = _syncs(t, can_id, 3 * number)
        t.equal(sum(answers), 3, f"TPDOs at {3 * number} SYNCs")
        t.equal(max(answers), 1, "TPDOs at one SYNC")
        gaps = [place for place, count in enumerate(answers) if count]
        t.equal([b - a for a, b in pairwise(gaps)], [number, number], "SYNCs between TPDOs")


_every(1)
_every(2)
_every(5)


@check("tpdo.sync.none", "A synchronous TPDO is not sent without SYNC", _PDO)
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 1)
    since = t.mark()
    t.wait(0.2)
    t.equal(len(t.heard(can_id, since)), 0, "number of TPDOs")


@check("tpdo.sync.0", "Transmission type 0: a TPDO at the SYNC after a change, and only then", _PDO)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    can_id = _sent(t, ((index, sub, bits),), 0)
    _syncs(t, can_id, 2)
    t.equal(_syncs(t, can_id, 2), [0, 0], "TPDOs without a change")
    since = t.mark()
    t.write(index, sub, t.other_value(index, sub, bits), bits // 8)
    t.wait(0.02)
    t.equal(len(t.heard(can_id, since)), 0, "TPDOs between the change and SYNC")
    t.equal(_syncs(t, can_id, 2), [1, 0], "TPDOs after a change")


@check("tpdo.disabled", "A TPDO with bit 31 set is not sent", _PDO)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(_TPDO, (_REGISTER,), 1)
    t.put(_TPDO, 1, t.read(_TPDO, 1) | PDO_INVALID, 4)
    _start(t)
    t.equal(_syncs(t, can_id, 3), [0, 0, 0], "TPDOs")


@check("tpdo.identifier.other", "A TPDO is sent with the identifier that was written", _PDO)
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 1, _SPARE_ID)
    t.equal(_syncs(t, can_id, 2), [1, 1], "TPDOs with the new identifier")


def _event(kind: int) -> None:
    @check(f"tpdo.event.{kind}", f"Transmission type {kind}: a change is sent at once", _PDO)
    def _(t: NodeTester) -> None:
        index, sub, bits = t.scratch()
        can_id = _sent(t, ((index, sub, bits),), kind, timers=_off(t, 5))
        t.wait(0.05)
        since = t.mark()
        value = t.other_value(index, sub, bits)
        t.write(index, sub, value, bits // 8)
        frame = t.hears(can_id, 0.1, since)
        t.equal(None if frame is None else frame.data, t.upload(index, sub), "data after the change")

    @check(f"tpdo.event.{kind}.quiet", f"Transmission type {kind}: nothing is sent without an event", _PDO)
    def _(t: NodeTester) -> None:
        index, sub, bits = t.scratch()
        can_id = _sent(t, ((index, sub, bits),), kind, timers=_off(t, 5))
        t.wait(0.1)
        since = t.mark()
        for _ in range(3):
            t.sync()
            t.wait(0.05)
        t.equal(len(t.heard(can_id, since)), 0, "number of TPDOs")


def _off(t: NodeTester, sub: int) -> dict[int, int]:
    return {sub: 0} if t.has(_TPDO, sub) else {}


_event(254)
_event(255)


@check("tpdo.event-timer", "The event timer repeats a TPDO", _PDO, (_TPDO, 5))
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 255, timers={5: 50})
    since = t.mark()
    t.wait(0.4)
    times = [frame.time_s for frame in t.heard(can_id, since)]
    t.true(len(times) >= 4, f"{len(times)} TPDOs in 400 ms", "8")
    intervals = [after - before for before, after in pairwise(times)]
    t.near(median(intervals), 0.05, "period")


@check("tpdo.event-timer.off", "Event timer 0 repeats nothing", _PDO, (_TPDO, 5))
def _(t: NodeTester) -> None:
    can_id = _sent(t, (_REGISTER,), 255, timers={5: 0})
    t.wait(0.05)
    since = t.mark()
    t.wait(0.3)
    t.equal(len(t.heard(can_id, since)), 0, "number of TPDOs")


@check("tpdo.inhibit", "Changes come no faster than the inhibit time", _PDO)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    t.require(_TPDO, 3)
    can_id = _sent(t, ((index, sub, bits),), 255, timers={3: 1000, **_off(t, 5)})
    t.wait(0.2)
    since = t.mark()
    before = t.upload(index, sub)
    for _ in range(8):
        t.put(index, sub, t.other_value(index, sub, bits), bits // 8)
        t.wait(0.02)
        t.download(index, sub, before)
        t.wait(0.02)
    times = [frame.time_s for frame in t.heard(can_id, since)]
    shortest = min((after - start for start, after in pairwise(times)), default=0.0)
    t.true(len(times) >= 2, f"{len(times)} TPDOs in 320 ms", "3 or 4")
    t.true(shortest > 0.1 - t.timing.jitter_s, f"{1000 * shortest:.1f} ms between TPDOs", "100 ms or more")


@check("tpdo.inhibit.last", "The last change within the inhibit time is sent when it ends", _PDO)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    t.require(_TPDO, 3)
    can_id = _sent(t, ((index, sub, bits),), 255, timers={3: 1000, **_off(t, 5)})
    t.wait(0.2)
    since = t.mark()
    before = t.upload(index, sub)
    t.put(index, sub, t.other_value(index, sub, bits), bits // 8)
    t.wait(0.02)
    t.download(index, sub, before)
    t.wait(0.2)
    frames = t.heard(can_id, since)
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
        ahead: tuple[tuple[int, int, int], ...] = (),
        start: bool = True,
    ) -> None:
        self._t = t
        self.index, self.sub, bits = t.scratch()
        self.size = bits // 8
        self.value = t.other_value(self.index, self.sub, bits)
        t.write(self.index, self.sub, int.from_bytes(t.upload(self.index, self.sub), "little"), self.size)
        self.before = self.read()
        self.can_id = t.map_pdo(_RPDO, (*ahead, (self.index, self.sub, bits)), transmission, can_id)
        if start:
            _start(t)

    def read(self) -> int:
        return self._t.read(self.index, self.sub)

    def data(self, value: int | None = None) -> bytes:
        return pack(self.value if value is None else value, self.size)

    def send(self, data: bytes | None = None) -> None:
        self._t.send(self.can_id, self.data() if data is None else data)

    def holds(self, value: int, when: str, found: int | None = None) -> None:
        """Fails unless ``found`` equals ``value``; by default ``found`` is read once the node had time to
        process a frame.
        """
        if found is None:
            self._t.wait(0.02)
            found = self.read()
        self._t.equal(found, value, f"{self.index:04X}h:{self.sub:02X} {when}")

    def after(self, data: bytes) -> int:
        """Sends an RPDO of wrong length and returns the object's value; then ends the error with a correct
        RPDO.
        """
        self.send(data)
        self._t.wait(0.02)
        found = self.read()
        self.send(self.data(self.before))
        return found


@check("rpdo.event", "An RPDO of type 255 is taken at once", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    rpdo.send()
    rpdo.holds(rpdo.value, "after the RPDO")


@check("rpdo.sync.before", "A synchronous RPDO has no effect before SYNC", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send()
    rpdo.holds(rpdo.before, "before SYNC")


@check("rpdo.sync.after", "A synchronous RPDO takes effect at SYNC", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send()
    t.sync()
    rpdo.holds(rpdo.value, "after SYNC")


@check("rpdo.sync.last", "Of two synchronous RPDOs the last one counts", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send(rpdo.data(rpdo.value + 5))
    rpdo.send()
    t.sync()
    rpdo.holds(rpdo.value, "after SYNC")


@check("rpdo.sync.once", "A synchronous RPDO takes effect once", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send()
    t.sync()
    t.wait(0.02)
    t.put(rpdo.index, rpdo.sub, rpdo.before, rpdo.size)
    t.sync()
    rpdo.holds(rpdo.before, "after a second SYNC without an RPDO")


@check("rpdo.pre-operational", "An RPDO in PRE-OPERATIONAL has no effect", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255, start=False)
    rpdo.send()
    rpdo.holds(rpdo.before, "after the RPDO")


@check("rpdo.stale", "An RPDO from before PRE-OPERATIONAL has no effect when the node starts again", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 1)
    rpdo.send()
    t.nmt(NMT_PRE_OPERATIONAL)
    _start(t)
    t.sync()
    rpdo.holds(rpdo.before, "after NMT start and SYNC")


@check("rpdo.disabled", "An RPDO with bit 31 set has no effect", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    t.put(_RPDO, 1, t.read(_RPDO, 1) | PDO_INVALID, 4)
    rpdo.send()
    rpdo.holds(rpdo.before, "after the RPDO")


@check("rpdo.identifier.other", "An RPDO is received with the identifier that was written", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255, can_id=_SPARE_ID)
    rpdo.send()
    rpdo.holds(rpdo.value, "after the RPDO")


@check("rpdo.short", "An RPDO that is too short has no effect", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    t.need(rpdo.size > 1, "the object has one byte")
    rpdo.holds(rpdo.before, "after the RPDO", rpdo.after(rpdo.data()[:-1]))


@check("rpdo.short.emergency", "An RPDO that is too short is EMCY 8210h", "CiA 301, 7.2.7")
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    since = t.mark()
    rpdo.send(rpdo.data()[:-1])
    t.wait(0.05)
    codes = t.emergencies(since)
    rpdo.send()
    t.true(0x8210 in codes, f"EMCY codes {[f'{code:04X}h' for code in codes]}", "8210h")


@check("rpdo.long", "Of an RPDO that is too long the first bytes are taken", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    rpdo.holds(rpdo.value, "after the RPDO", rpdo.after(rpdo.data() + b"\xff"))


@check("rpdo.extended", "A frame with a 29-bit identifier is not an RPDO", _PDO)
def _(t: NodeTester) -> None:
    rpdo = _Reception(t, 255)
    t.send_special(rpdo.can_id, rpdo.data())
    rpdo.holds(rpdo.before, "after the frame")


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
    t.write(_RPDO, 1, t.read(_RPDO, 1) | PDO_INVALID, 4)
    t.write(_RPDO + 0x200, 0, 0, 1)
    before = t.read(_RPDO + 0x200, 1)
    answer = t.answer(expedited(_RPDO + 0x200, 1, _word(*_DUMMY)))
    if answer[0] == 0x80:
        return False
    t.put(_RPDO + 0x200, 1, before, 4)
    return True


# ---------------------------------------------------------------- SYNC


@check("sync.identifier", "1005h is 80h by default", _SYNC, 0x1005)
def _(t: NodeTester) -> None:
    t.reset()
    t.equal(t.read(0x1005) & 0x7FF, 0x80, "identifier")


@check("sync.identifier.other", "SYNC is received with the identifier in 1005h", _SYNC, 0x1005)
def _(t: NodeTester) -> None:
    can_id = t.map_pdo(_TPDO, (_REGISTER,), 1)
    t.write(0x1005, 0, _SPARE_ID, 4)
    _start(t)
    since = t.mark()
    t.send(_SPARE_ID)
    t.wait(0.02)
    t.equal(len(t.heard(can_id, since)), 1, "TPDOs at the new SYNC")
    t.equal(_syncs(t, can_id, 2), [0, 0], "TPDOs at the old SYNC")


@check("sync.identifier.zero", "1005h: identifier 0, which is NMT, is refused", _SYNC, 0x1005)
def _(t: NodeTester) -> None:
    t.refuses_value(0x1005, 0, bytes(4), RANGE)


@check("sync.counter", "SYNC with a counter triggers TPDOs", _COUNTER, 0x1019)
def _(t: NodeTester) -> None:
    t.write(0x1019, 0, 10, 1)
    can_id = _sent(t, (_REGISTER,), 1)
    t.equal(_syncs(t, can_id, 3, 1), [1, 1, 1], "TPDOs")


@check("sync.counter.start", "SYNC start value: the first TPDO comes at this counter", _COUNTER)
def _(t: NodeTester) -> None:
    t.require(0x1019)
    t.require(_TPDO, 6)
    t.write(0x1019, 0, 10, 1)
    can_id = _sent(t, (_REGISTER,), 2, timers={6: 3})
    t.equal(_syncs(t, can_id, 8, 1), [0, 0, 1, 0, 1, 0, 1, 0], "TPDOs at counters 1 to 8")


def _overflow(value: int, *, allowed: bool) -> None:
    verb = "accepted" if allowed else "refused"

    @check(f"sync.overflow.{value}", f"Overflow value {value} in 1019h is {verb}", _COUNTER, 0x1019)
    def _(t: NodeTester) -> None:
        if allowed:
            t.write(0x1019, 0, value, 1)
        else:
            t.refuses_value(0x1019, 0, bytes((value,)), RANGE)


_overflow(240, allowed=True)
_overflow(1, allowed=False)
_overflow(241, allowed=False)
