"""The object dictionary of the simulated drive: what its EDS declares, and the values that live behind it.

An entry is a stored value, or is bound to a function that reads the drive at this moment. Writing checks
access, length and range as CiA 301 demands, and then asks the entry's guard, which may refuse. PDO mappings
are compiled from entries once (``pdo.py``), so nothing here runs in the cyclic path but stored values and
bound functions.
"""

from __future__ import annotations

import configparser
import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from hdbridge.errors import InputError

INTEGERS: Final = {
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
}
"""CANopen data types that the drive knows, as ``struct`` format characters."""

MAX_STRING: Final = 64
"""Longest string, in bytes, that can be written to a writable string object."""


class Abort(IntEnum):
    """SDO abort codes (CiA 301)."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    RANGE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    STATE = 0x08000022


class SdoAbortError(Exception):
    """An access that the drive refuses, with the abort code it answers."""

    def __init__(self, code: Abort, what: str = "") -> None:
        super().__init__(what or f"{code.name} ({code:08X}h)")
        self.code = code


class Entry:
    """One (index, sub-index).

    ``value`` is what is stored; ``bind`` makes reads call a function instead; ``guard`` is asked with a new
    value before it is stored and refuses by raising ``SdoAbortError``; ``follower`` is told after it was
    stored.
    """

    __slots__ = (
        "bound",
        "codec",
        "default",
        "follower",
        "guard",
        "high",
        "index",
        "low",
        "mappable",
        "name",
        "readable",
        "sub",
        "value",
        "writable",
    )

    def __init__(self, variable: ODVariable) -> None:
        self.index: Final[int] = variable.index
        self.sub: Final[int] = variable.subindex
        self.name: Final[str] = variable.name
        code = INTEGERS.get(variable.data_type or 0)
        if code is None and variable.data_type != datatypes.VISIBLE_STRING:
            raise InputError(
                f"object {self.index:04X}h:{self.sub:02X} is of data type {variable.data_type}; expected "
                "an integer of up to 32 bits or a VISIBLE_STRING; correct the EDS"
            )
        self.codec: Final = struct.Struct("<" + code) if code else None
        self.readable: Final = "r" in variable.access_type or variable.access_type == "const"
        self.writable: Final = "w" in variable.access_type
        self.mappable: Final = bool(variable.pdo_mappable) and code is not None
        self.low: Final[int | None] = variable.min
        self.high: Final[int | None] = variable.max
        empty: int | str = 0 if code else ""
        self.default: int | bytes = _stored(empty if variable.default is None else variable.default)
        self.value: Any = self.default  # of what the codec says
        self.bound: Callable[[], int] | None = None
        self.guard: Callable[[int], None] | None = None
        self.follower: Callable[[int], None] | None = None

    def __repr__(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"

    @property
    def bits(self) -> int:
        """Length in bits, as a PDO mapping entry states it."""
        return 8 * self.codec.size if self.codec else 0

    def bind(self, read: Callable[[], int]) -> None:
        """Make reads, by SDO and by PDO, call ``read``."""
        self.bound = read

    def reader(self) -> Callable[[], int]:
        """What a TPDO calls to get the value."""
        return self.bound if self.bound is not None else self.number

    def number(self) -> int:
        """The present value of an integer entry."""
        value: int = self.value if self.bound is None else self.bound()
        return value

    def read(self) -> bytes:
        """The present value as an SDO server sends it."""
        if not self.readable:
            raise SdoAbortError(Abort.WRITE_ONLY)
        if self.codec is None:
            assert isinstance(self.value, bytes)
            return self.value
        return self.codec.pack(self.number())

    def check_length(self, size: int) -> None:
        """Refuse a read-only entry and a length that does not fit."""
        if not self.writable:
            raise SdoAbortError(Abort.READ_ONLY)
        longest = self.codec.size if self.codec else MAX_STRING
        if size > longest:
            raise SdoAbortError(Abort.TOO_LONG)
        if self.codec and size < longest:
            raise SdoAbortError(Abort.TOO_SHORT)

    def write(self, data: bytes) -> None:
        """Check and store what an SDO client wrote."""
        self.check_length(len(data))
        if self.codec is None:
            self.value = bytes(data)
        else:
            self.put(self.codec.unpack(data)[0])

    def put(self, value: int) -> None:
        """Check and store a number, whoever wrote it."""
        if self.high is not None and value > self.high:
            raise SdoAbortError(Abort.TOO_HIGH)
        if self.low is not None and value < self.low:
            raise SdoAbortError(Abort.TOO_LOW)
        if self.guard is not None:
            self.guard(value)
        self.value = value
        if self.follower is not None:
            self.follower(value)

    def writer(self) -> Callable[[int], None]:
        """What an RPDO calls with a received value; one out of range is refused by ``SdoAbortError``."""
        plain = self.low is None and self.high is None and self.guard is None and self.follower is None
        return self._store if plain else self.put

    def _store(self, value: int) -> None:
        self.value = value


class Dictionary:
    """All entries of one node, by (index, sub-index)."""

    def __init__(self, eds_path: Path, node_id: int) -> None:
        try:
            declared = _read_eds(eds_path, eds_path.stat().st_mtime_ns, node_id)
        except (OSError, ValueError, LookupError, configparser.Error) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"{eds_path}: cannot be read as an EDS ({reason}); expected a CiA 306 file; name another"
            ) from error
        self._entries: dict[tuple[int, int], Entry] = {}
        for item in declared.values():
            for variable in [item] if isinstance(item, ODVariable) else item.values():
                self._entries[variable.index, variable.subindex] = Entry(variable)
        self._indices = {index for index, _ in self._entries}

    def __getitem__(self, key: tuple[int, int]) -> Entry:
        entry = self._entries.get(key)
        if entry is None:
            code = Abort.NO_SUBINDEX if key[0] in self._indices else Abort.NO_OBJECT
            raise SdoAbortError(code, f"there is no object {key[0]:04X}h:{key[1]:02X}")
        return entry

    def __contains__(self, key: tuple[int, int]) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def remove(self, index: int, sub: int) -> None:
        """Be a drive that does not have this object."""
        del self._entries[index, sub]
        self._indices = {index for index, _ in self._entries}

    def value(self, index: int, sub: int = 0) -> int:
        """The present number behind an integer entry."""
        return self[index, sub].number()

    def restore(self, first: int = 0x0000, last: int = 0xFFFF) -> None:
        """Put the defaults back into all stored values of these indices; no guard is asked."""
        for entry in self:
            if first <= entry.index <= last:
                entry.value = entry.default


@lru_cache(maxsize=8)
def _read_eds(path: Path, _modified_ns: int, node_id: int) -> canopen.ObjectDictionary:
    """Parse an EDS once: it takes longer than everything else in starting a bench. Not to be changed."""
    if "[DeviceInfo]" not in path.read_text(encoding="latin-1"):
        raise ValueError("no section DeviceInfo")
    return canopen.import_od(str(path), node_id)


def _stored(value: int | str) -> int | bytes:
    return value.encode() if isinstance(value, str) else value
