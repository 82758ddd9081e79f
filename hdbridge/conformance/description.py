"""Checks of the EDS against the node: objects, types, access, limits, defaults, PDO mapping."""

from collections.abc import Callable, Iterable, Iterator
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.tester import (
    ABSENT,
    RANGE,
    READ_ONLY,
    WRITE_ONLY,
    AbortedError,
    NodeTester,
    Table,
    abort,
    abort_code,
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


def _check(name: str, text: str, expected: str) -> Callable[[Callable[[NodeTester], Iterable[str]]], None]:
    """Decorates a function that returns the deviations of a node from its EDS."""

    def add(function: Callable[[NodeTester], Iterable[str]]) -> None:
        @check(f"eds.{name}", text, _EDS)
        def _(t: NodeTester) -> None:
            if wrong := list(function(t)):
                more = f" and {len(wrong) - _SHOWN} more" if len(wrong) > _SHOWN else ""
                t.fail(", ".join(wrong[:_SHOWN]) + more, expected)

    return add


def _outcome(code: int) -> str:
    return f"abort {code:08X}h" if code else "accepted"


def _parameters(t: NodeTester, attribute: str = "index") -> Iterator[ODVariable]:
    """Yields the node's integer parameters with this attribute that can be written without side effects."""
    for each in _entries(t):
        if each.access_type != "rw" or each.data_type not in _INTEGERS or each.index in _COMMANDS:
            continue
        is_pdo = _PDO_PARAMETERS[0] <= each.index <= _PDO_PARAMETERS[1]
        if not is_pdo and getattr(each, attribute) is not None and t.has(each.index, each.subindex):
            yield each


def _codes(t: NodeTester) -> Iterator[tuple[ODVariable, int]]:
    """Yields every object with the abort code of its upload, 0 if it is not refused."""
    for each in _entries(t):
        answer = t.answer(upload_request(each.index, each.subindex))
        if answer[0] == 0x41:
            t.ask(abort(each.index, each.subindex), 0.0)
        yield each, abort_code(answer)


@_check("objects", "Every object of the EDS exists", "every object of the EDS")
def _(t: NodeTester) -> Iterator[str]:
    return (_name(each) for each, code in _codes(t) if code in ABSENT)


def _readable(t: NodeTester) -> Iterator[tuple[ODVariable, bytes]]:
    for each in _entries(t):
        if each.access_type != "wo":
            try:
                yield each, t.upload(each.index, each.subindex)
            except AbortedError:
                continue


_EVERY_READABLE: Final = "an upload of every ro, rw and const object"


@_check("readable", "Every object that the EDS calls readable can be uploaded", _EVERY_READABLE)
def _(t: NodeTester) -> Iterator[str]:
    for each, code in _codes(t):
        if each.access_type != "wo" and code in WRITE_ONLY:
            yield f"{_name(each)}: abort {code:08X}h"


@_check("size", "Uploaded integers have the size of their type in the EDS", "the size of the type")
def _(t: NodeTester) -> Iterator[str]:
    for each, data in _readable(t):
        if each.data_type in _INTEGERS and len(data) != len(each) // 8:
            yield f"{_name(each)}: {len(data)} bytes, not {len(each) // 8}"


@_check("read-only", "Objects that the EDS calls ro or const refuse a download", "abort 06010002h")
def _(t: NodeTester) -> Iterator[str]:
    for each, data in _readable(t):
        if each.access_type in ("ro", "const") and each.data_type in _INTEGERS and 0 < len(data) <= 4:
            code = abort_code(t.answer(expedited(each.index, each.subindex, data)))
            if code not in READ_ONLY:
                yield f"{_name(each)}: {_outcome(code)}"


@_check(
    "writable", "Parameters that the EDS calls rw accept their own value", "the present value is accepted"
)
def _(t: NodeTester) -> Iterator[str]:
    for each in _parameters(t):
        data = t.upload(each.index, each.subindex)
        if len(data) <= 4 and (code := abort_code(t.answer(expedited(each.index, each.subindex, data)))):
            yield f"{_name(each)}: abort {code:08X}h"


def _limit(name: str, attribute: str, step: int) -> None:
    text = f"A value beyond the {name} limit of the EDS is refused and not stored"

    @_check(name, text, "abort 06090030h to 06090032h")
    def _(t: NodeTester) -> Iterator[str]:
        tried = 0
        for each in _parameters(t, attribute):
            beyond, size = getattr(each, attribute) + step, len(each) // 8
            low = -(1 << len(each) - 1) if is_signed(each) else 0
            if size > 4 or not low <= beyond < low + (1 << len(each)):
                continue
            tried += 1
            before = t.upload(each.index, each.subindex)
            code = abort_code(t.answer(expedited(each.index, each.subindex, pack(beyond, size))))
            if code not in RANGE:
                yield f"{_name(each)} = {beyond}: {_outcome(code)}"
                t.answer(expedited(each.index, each.subindex, before))
            elif t.upload(each.index, each.subindex) != before:
                yield f"{_name(each)} = {beyond}: stored"
        t.need(tried, f"the EDS has no {name} limits that a value could exceed")


_limit("lower", "min", -1)
_limit("upper", "max", 1)


@_check(
    "defaults", "After a reset the communication parameters have the defaults of the EDS",
    "the defaults of the EDS (saved parameters may differ)",
)  # fmt: skip
def _(t: NodeTester) -> Iterator[str]:
    entries = [
        each
        for each in _entries(t)
        if each.index <= 0x1FFF and each.index not in _COMMANDS and each.access_type in ("rw", "const")
    ]
    t.reset(NmtCommand.RESET_NODE)
    for each in entries:
        if _has_default(each) and t.has(each.index, each.subindex):
            found = t.read(each.index, each.subindex, signed=is_signed(each))
            if found != each.default:
                yield f"{_name(each)} = {found:X}h, not {each.default:X}h"


def _has_default(each: ODVariable) -> bool:
    return each.data_type in _INTEGERS and each.default is not None


@_check("constants", "Objects that the EDS calls const have its value", "the values of the EDS")
def _(t: NodeTester) -> Iterator[str]:
    for each, data in _readable(t):
        found = int.from_bytes(data, "little", signed=is_signed(each))
        if each.access_type == "const" and _has_default(each) and found != each.default:
            yield f"{_name(each)} = {found}, not {each.default}"


@_check("entries", "Sub-index 0 of arrays and records is that of the EDS", "the values of the EDS")
def _(t: NodeTester) -> Iterator[str]:
    for each in _entries(t):
        if each.subindex == 0 and each.access_type == "const" and _has_default(each) and t.has(each.index):
            found = t.upload(each.index)
            if len(found) == 1 and found[0] != each.default:
                yield f"{_name(each)} = {found[0]}, not {each.default}"


def _mapped(name: str, text: str, first: int, wanted: Callable[[ODVariable], bool], *, accepts: bool) -> None:
    @_check(name, text, "mapped" if accepts else "refused")
    def _(t: NodeTester) -> Iterator[str]:
        entries = [
            each
            for each in _entries(t)
            if wanted(each) and each.data_type in _INTEGERS and t.has(each.index, each.subindex)
        ]
        t.need(entries and t.has_pdo(first), "no such objects, or no PDO")
        mapping = first + 0x200
        t.switch_pdo_off(first)
        t.write(mapping, 0, 0, 1)
        before = t.upload(mapping, 1)
        for each in entries:
            word = each.index << 16 | each.subindex << 8 | len(each)
            code = abort_code(t.answer(expedited(mapping, 1, pack(word, 4))))
            if not code:
                code = abort_code(t.answer(expedited(mapping, 0, b"\x01")))
                t.answer(expedited(mapping, 0, b"\0"))
            if bool(code) is accepts:
                yield f"{_name(each)}: {_outcome(code)}"
        t.download(mapping, 1, before)


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
    lambda each: not each.pdo_mappable and each.index >= 0x2000, accepts=False,
)  # fmt: skip


@_check("undeclared", "Optional objects that the EDS does not name do not exist", "abort 06020000h")
def _(t: NodeTester) -> Iterator[str]:
    optional = (*range(0x1000, 0x1030), *range(0x1200, 0x1204), *range(0x6040, 0x6100), 0x6502, 0x6503)
    return (f"{index:04X}h" for index in optional if index not in t.eds and t.has(index))


def _count(kind: str, first: int, attribute: str) -> None:
    @check(f"eds.pdos.{kind}", f"The EDS lists the number of {kind}s that it states", _EDS)
    def _(t: NodeTester) -> None:
        expected = getattr(t.eds.device_information, f"nr_of_{attribute}")
        t.need(expected is not None, f"the EDS does not state the number of {kind}s")
        found = sum(t.has(index, 1) for index in range(first, first + 0x200) if index in t.eds)
        t.equal(found, expected, f"number of {kind}s")


_count("RPDO", 0x1400, "RXPDO")
_count("TPDO", 0x1800, "TXPDO")
