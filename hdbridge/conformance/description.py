"""Checks of the EDS against the node: objects, types, access, limits, defaults, PDO mapping."""

from collections.abc import Callable, Iterator
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from hdbridge.conformance.tester import (
    ABSENT,
    NMT_RESET_NODE,
    PDO_INVALID,
    RANGE,
    READ_ONLY,
    WRITE_ONLY,
    AbortedError,
    NodeTester,
    Table,
    abort,
    expedited,
    is_signed,
    pack,
    upload_request,
)

CHECKS: Final = Table()
check: Final = CHECKS.check
_EDS: Final = "CiA 306"
_SHOWN: Final = 5
_COMMANDS: Final = frozenset({0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x607A, 0x60C1})
"""Objects whose values are not parameters, or whose download has side effects."""
_PDO_PARAMETERS: Final = (0x1400, 0x1BFF)
_INTEGERS: Final = datatypes.INTEGER_TYPES


def _name(each: ODVariable) -> str:
    return f"{each.index:04X}h:{each.subindex:02X}"


def _entries(t: NodeTester) -> list[ODVariable]:
    t.eds  # noqa: B018 - ends the check as not applicable without an EDS
    return [each for each in t.variables() if each.index >= 0x1000]


def _report(wrong: list[str], expected: str) -> None:
    if wrong:
        more = f" and {len(wrong) - _SHOWN} more" if len(wrong) > _SHOWN else ""
        NodeTester.fail(", ".join(wrong[:_SHOWN]) + more, expected)


def _code(answer: bytes) -> int:
    return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0


def _outcome(code: int) -> str:
    return f"abort {code:08X}h" if code else "accepted"


def _parameters(t: NodeTester) -> Iterator[ODVariable]:
    """Yields the integer parameters that may be written without side effects."""
    for each in _entries(t):
        is_pdo = _PDO_PARAMETERS[0] <= each.index <= _PDO_PARAMETERS[1]
        if (
            each.access_type == "rw"
            and each.data_type in _INTEGERS
            and each.index not in _COMMANDS
            and not is_pdo
        ):
            yield each


@check("eds.objects", "Every object of the EDS exists", _EDS)
def _(t: NodeTester) -> None:
    wrong = []
    for each in _entries(t):
        answer = t.answer(upload_request(each.index, each.subindex))
        if _code(answer) in ABSENT:
            wrong.append(_name(each))
        elif answer[0] == 0x41:
            t.ask(abort(each.index, each.subindex), 0.0)
    _report(wrong, "every object of the EDS")


def _readable(t: NodeTester) -> Iterator[tuple[ODVariable, bytes]]:
    for each in _entries(t):
        if each.access_type != "wo":
            try:
                yield each, t.upload(each.index, each.subindex)
            except AbortedError:
                continue


@check("eds.readable", "Every object that the EDS calls readable can be uploaded", _EDS)
def _(t: NodeTester) -> None:
    wrong = []
    for each in _entries(t):
        if each.access_type == "wo":
            continue
        answer = t.answer(upload_request(each.index, each.subindex))
        code = _code(answer)
        if code in WRITE_ONLY:
            wrong.append(f"{_name(each)}: abort {code:08X}h")
        elif answer[0] == 0x41:
            t.ask(abort(each.index, each.subindex), 0.0)
    _report(wrong, "an upload of every ro, rw and const object")


@check("eds.size", "Uploaded integers have the size of their type in the EDS", _EDS)
def _(t: NodeTester) -> None:
    wrong = [
        f"{_name(each)}: {len(data)} bytes, not {len(each) // 8}"
        for each, data in _readable(t)
        if each.data_type in _INTEGERS and len(data) != len(each) // 8
    ]
    _report(wrong, "the size of the type")


@check("eds.read-only", "Objects that the EDS calls ro or const refuse a download", _EDS)
def _(t: NodeTester) -> None:
    wrong = []
    for each, data in _readable(t):
        if each.access_type in ("ro", "const") and each.data_type in _INTEGERS and 0 < len(data) <= 4:
            code = _code(t.answer(expedited(each.index, each.subindex, data)))
            if code not in READ_ONLY:
                wrong.append(f"{_name(each)}: {_outcome(code)}")
    _report(wrong, "abort 06010002h")


@check("eds.writable", "Parameters that the EDS calls rw take back their value", _EDS)
def _(t: NodeTester) -> None:
    wrong = []
    for each in _parameters(t):
        if not t.has(each.index, each.subindex):
            continue
        data = t.upload(each.index, each.subindex)
        if len(data) <= 4 and (code := _code(t.answer(expedited(each.index, each.subindex, data)))):
            wrong.append(f"{_name(each)}: abort {code:08X}h")
    _report(wrong, "the present value is accepted")


def _limit(name: str, attribute: str, step: int) -> None:
    @check(f"eds.{name}", f"A value beyond the {name} limit of the EDS is refused and not stored", _EDS)
    def _(t: NodeTester) -> None:
        wrong, tried = [], 0
        for each in _parameters(t):
            limit = getattr(each, attribute)
            if limit is None or len(each) > 32 or not t.has(each.index, each.subindex):
                continue
            beyond, size = limit + step, len(each) // 8
            low = -(1 << len(each) - 1) if is_signed(each) else 0
            if not low <= beyond < low + (1 << len(each)):
                continue
            tried += 1
            before = t.upload(each.index, each.subindex)
            code = _code(t.answer(expedited(each.index, each.subindex, pack(beyond, size))))
            if code not in RANGE:
                wrong.append(f"{_name(each)} = {beyond}: {_outcome(code)}")
                t.answer(expedited(each.index, each.subindex, before))
            elif t.upload(each.index, each.subindex) != before:
                wrong.append(f"{_name(each)} = {beyond}: stored")
        t.need(tried, f"the EDS has no {name} limits that a value could exceed")
        _report(wrong, "abort 06090030h to 06090032h")


_limit("lower", "min", -1)
_limit("upper", "max", 1)


@check("eds.defaults", "After a reset the communication parameters have the defaults of the EDS", _EDS)
def _(t: NodeTester) -> None:
    entries = _entries(t)
    t.reset(NMT_RESET_NODE)
    wrong = []
    for each in entries:
        if each.index in _COMMANDS or each.index > 0x1FFF or each.access_type not in ("rw", "const"):
            continue
        if each.default is None or each.data_type not in _INTEGERS or not t.has(each.index, each.subindex):
            continue
        found = t.read(each.index, each.subindex, signed=is_signed(each))
        if found != each.default:
            wrong.append(f"{_name(each)} = {found:X}h, not {each.default:X}h")
    _report(wrong, "the defaults of the EDS (parameters that were saved differ)")


@check("eds.constants", "Objects that the EDS calls const have its value", _EDS)
def _(t: NodeTester) -> None:
    wrong = [
        f"{_name(each)} = {int.from_bytes(data, 'little', signed=is_signed(each))}, not {each.default}"
        for each, data in _readable(t)
        if each.access_type == "const"
        and each.data_type in _INTEGERS
        and each.default is not None
        and int.from_bytes(data, "little", signed=is_signed(each)) != each.default
    ]
    _report(wrong, "the values of the EDS")


@check("eds.entries", "Sub-index 0 of arrays and records is that of the EDS", _EDS)
def _(t: NodeTester) -> None:
    wrong = []
    for each in _entries(t):
        if (
            each.subindex == 0
            and each.access_type == "const"
            and each.default is not None
            and t.has(each.index)
        ):
            found = t.upload(each.index)
            if len(found) == 1 and each.data_type in _INTEGERS and found[0] != each.default:
                wrong.append(f"{_name(each)} = {found[0]}, not {each.default}")
    _report(wrong, "the values of the EDS")


def _mapped(name: str, text: str, first: int, wanted: Callable[[ODVariable], bool], *, accepts: bool) -> None:
    @check(f"eds.{name}", text, _EDS)
    def _(t: NodeTester) -> None:
        entries = [
            each for each in _entries(t) if wanted(each) and each.data_type in _INTEGERS and len(each) <= 64
        ]
        entries = [each for each in entries if t.has(each.index, each.subindex)]
        t.need(entries and t.has_pdo(first), "no such objects, or no PDO")
        mapping = first + 0x200
        t.write(first, 1, t.read(first, 1) | PDO_INVALID, 4)
        t.write(mapping, 0, 0, 1)
        before, wrong = t.upload(mapping, 1), []
        for each in entries:
            word = each.index << 16 | each.subindex << 8 | len(each)
            code = _code(t.answer(expedited(mapping, 1, pack(word, 4))))
            if not code:
                code = _code(t.answer(expedited(mapping, 0, b"\x01")))
                t.answer(expedited(mapping, 0, b"\0"))
            if bool(code) is accepts:
                wrong.append(f"{_name(each)}: {_outcome(code)}")
        t.download(mapping, 1, before)
        _report(wrong, "mapped" if accepts else "refused")


def _in_application(each: ODVariable) -> bool:
    return each.index >= 0x2000


_mapped(
    "mapping.transmit", "Objects that the EDS calls mappable and readable can be mapped to a TPDO", 0x1800,
    lambda each: each.pdo_mappable and each.access_type not in ("wo", "rww"), accepts=True,
)  # fmt: skip
_mapped(
    "mapping.receive", "Objects that the EDS calls mappable and writable can be mapped to an RPDO", 0x1400,
    lambda each: each.pdo_mappable and each.access_type in ("wo", "rw", "rww"), accepts=True,
)  # fmt: skip
_mapped(
    "mapping.none", "Objects that the EDS does not call mappable cannot be mapped", 0x1800,
    lambda each: not each.pdo_mappable and _in_application(each), accepts=False,
)  # fmt: skip


@check("eds.undeclared", "Optional objects that the EDS does not name do not exist", _EDS)
def _(t: NodeTester) -> None:
    optional = (*range(0x1000, 0x1030), *range(0x1200, 0x1204), *range(0x6040, 0x6100), 0x6502, 0x6503)
    wrong = [f"{index:04X}h" for index in optional if index not in t.eds and t.has(index)]
    _report(wrong, "abort 06020000h")


def _count(kind: str, first: int, attribute: str) -> None:
    @check(f"eds.pdos.{kind}", f"The EDS names as many {kind}s as it says", _EDS)
    def _(t: NodeTester) -> None:
        expected = getattr(t.eds.device_information, f"nr_of_{attribute}")
        t.need(expected is not None, f"the EDS does not say how many {kind}s there are")
        found = sum(t.has(index, 1) for index in range(first, first + 0x200) if index in t.eds)
        t.equal(found, expected, f"number of {kind}s")


_count("RPDO", 0x1400, "RXPDO")
_count("TPDO", 0x1800, "TXPDO")
