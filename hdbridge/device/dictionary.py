"""The object dictionary of the simulated drive: the objects that its EDS declares, and their values.

An entry holds a stored value, or is bound to a function that returns the drive's current value. A write is
checked for access, length and range as required by CiA 301, and then by the entry's guard, which may refuse
it. PDO mappings are compiled from entries once (``pdo.py``), so the cyclic path only reads stored values and
calls bound functions.
"""

import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from hdbridge.errors import InputError
from hdbridge.files.edsfile import shared_eds, variables
from hdbridge.files.profile import bundled_folder

BUNDLED: Final = bundled_folder("eds") / "hdbridge-402.eds"
"""EDS of the objects used by the firmware."""
NUMBERS: Final = {
    datatypes.BOOLEAN: "B",
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.INTEGER64: "q",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
    datatypes.UNSIGNED64: "Q",
    datatypes.REAL32: "f",
    datatypes.REAL64: "d",
}
"""Data types of numbers, with their ``struct`` format characters; objects of other types hold bytes."""
_VENDORS: Final = (0x2000, 0x5FFF)
_PDOS: Final = (0x1400, 0x1BFF)
"""Indices of the PDO parameters. A PDO that is not in the EDS does not exist."""

MAX_STRING: Final = 64
"""Longest string, in bytes, that can be written to a writable string object."""


class Abort(IntEnum):
    """SDO abort codes (CiA 301)."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
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
    NOT_STORED = 0x08000020
    STATE = 0x08000022


class SdoAbortError(Exception):
    """An access that the drive refuses, with the abort code of its answer."""

    def __init__(self, code: Abort, what: str = "") -> None:
        super().__init__(what or f"{code.name} ({code:08X}h)")
        self.code = code


def refusing(wrong: Callable[[int], object], code: Abort = Abort.RANGE) -> Callable[[int], None]:
    """Returns a guard that refuses the values for which ``wrong`` is true."""

    def check(value: int) -> None:
        if wrong(value):
            raise SdoAbortError(code)

    return check


def only(*allowed: int) -> Callable[[int], None]:
    """Returns a guard that refuses all values except ``allowed``."""
    return refusing(lambda value: value not in allowed)


class Entry:
    """Object at one index and sub-index.

    ``value`` is the stored value. After ``bind``, reads call a function instead. ``guard`` checks a new value
    before it is stored, and refuses by raising ``SdoAbortError``; ``follower`` is called after it was stored.
    A ``hidden`` entry is used by the firmware but invisible on the bus. The firmware uses only entries that
    are ``is_known``. The default of an ``is_relative`` entry contains the node id.
    """

    def __init__(self, variable: ODVariable, own: ODVariable | None = None) -> None:
        """``own`` is the object in the bundled EDS, which gives the default if ``variable`` has none."""
        self.index: Final[int] = variable.index
        self.sub: Final[int] = variable.subindex
        self.name: Final[str] = variable.name
        code = NUMBERS.get(variable.data_type or 0)
        self.codec: Final = struct.Struct("<" + code) if code else None
        self.is_known: Final = own is not None
        self.hidden = False
        self.readable: Final[bool] = variable.readable
        self.writable: Final[bool] = variable.writable
        self.mappable: Final = bool(variable.pdo_mappable) and code is not None
        self.low: Final[int | None] = variable.min
        self.high: Final[int | None] = variable.max
        other_type = own is None or own.data_type != variable.data_type
        self._bits = self.bits if other_type and code not in {*"fd"} else 0
        given = variable if variable.default is not None or own is None else own
        default = given.default
        self.is_relative: Final = bool(given.relative)
        empty: int | str = 0 if code else ""
        self.default: Any = empty if default is None else default
        if isinstance(self.default, str):
            self.default = self.default.encode()
        elif self._bits and isinstance(self.default, int):
            self.default = self._wrapped(self.default)
        self.value: Any = self.default  # value of the codec's type
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
        """Makes reads by SDO and PDO call ``read``."""
        self.bound = (lambda: self._wrapped(read())) if self._bits else read

    def _wrapped(self, value: int) -> int:
        """Converts a value of any integer type to the type that the EDS declares (modulo its range)."""
        assert self.codec is not None
        size = self.codec.size
        wrapped: int = self.codec.unpack((value % (1 << 8 * size)).to_bytes(size, "little"))[0]
        return wrapped

    def reader(self) -> Callable[[], int]:
        """Returns the function that a TPDO calls to read the value."""
        return self.bound if self.bound is not None else self.number

    def number(self) -> int:
        """Returns the current value of an integer entry."""
        value: int = self.value if self.bound is None else self.bound()
        return value

    def read(self) -> bytes:
        """Returns the current value as an SDO server sends it."""
        if not self.readable:
            raise SdoAbortError(Abort.WRITE_ONLY)
        if self.codec is None:
            assert isinstance(self.value, bytes)
            return self.value
        return self.codec.pack(self.number())

    def check_length(self, size: int) -> None:
        """Refuses a write if the entry is read-only or the length does not fit the data type."""
        if not self.writable:
            raise SdoAbortError(Abort.READ_ONLY)
        longest = self.codec.size if self.codec else MAX_STRING
        if size > longest:
            raise SdoAbortError(Abort.TOO_LONG)
        if self.codec and size < longest:
            raise SdoAbortError(Abort.TOO_SHORT)

    def write(self, data: bytes) -> None:
        """Checks and stores the bytes that an SDO client wrote."""
        self.check_length(len(data))
        if self.codec is None:
            self.value = bytes(data)
        else:
            self.put(self.codec.unpack(data)[0])

    def put(self, value: int) -> None:
        """Checks and stores a number, written by SDO or PDO."""
        if self.high is not None and value > self.high:
            raise SdoAbortError(Abort.TOO_HIGH)
        if self.low is not None and value < self.low:
            raise SdoAbortError(Abort.TOO_LOW)
        if self.guard is not None:
            self.guard(value)
        self.value = value
        if self.follower is not None:
            self.follower(value)

    def accepts(self, value: object) -> bool:
        """Returns True for a number of the entry's type within its limits, without calling the guard."""
        if self.codec is None or not isinstance(value, int | float):
            return False
        try:
            self.codec.pack(value)
        except struct.error:
            return False
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def writer(self) -> Callable[[int], None]:
        """Returns the function that an RPDO calls with a received value; it raises ``SdoAbortError``."""
        plain = self.low is None and self.high is None and self.guard is None and self.follower is None
        return self._store if plain else self.put

    def _store(self, value: int) -> None:
        self.value = value


class Dictionary:
    """All entries of one node, by (index, sub-index).

    The firmware works with every object of the bundled EDS, except those whose indices the vendor uses for
    other objects in ``eds_path``. Objects that ``eds_path`` does not list are hidden: they are not accessible
    by SDO or PDO, and keep the bundled default.
    """

    def __init__(self, eds_path: Path, node_id: int) -> None:
        self._path = eds_path
        self._entries: dict[tuple[int, int], Entry] = {}
        own = _variables(shared_eds(BUNDLED, node_id).dictionary)
        declared = shared_eds(eds_path, node_id).dictionary
        variables = _variables(declared)
        for key, variable in variables.items():
            self._add(variable, own.get(key))
        device = declared.device_information
        for sub, number in enumerate(
            (device.vendor_number, device.product_number, device.revision_number), 1
        ):
            named = variables.get((0x1018, sub))
            if named is not None and named.default is None and number is not None:
                self._entries[0x1018, sub].default = number  # stated only in [DeviceInfo]
        for key, variable in own.items():
            if key not in self._entries and not _PDOS[0] <= variable.index <= _PDOS[1]:
                self._add(variable, variable).hidden = True
        self._note_indices()

    def _add(self, variable: ODVariable, own: ODVariable | None) -> Entry:
        if own is not None and _VENDORS[0] <= variable.index <= _VENDORS[1]:
            own = own if own.data_type == variable.data_type else None  # else the same index by chance
        entry = Entry(variable, own)
        if own is not None and (entry.codec is None) != (own.data_type not in NUMBERS):
            raise InputError(
                f"{self._path}: {entry} has data type {variable.data_type:04X}h, but the simulated drive "
                f"uses {own.data_type:04X}h; a drive with this EDS cannot be simulated"
            )
        self._entries[entry.index, entry.sub] = entry
        return entry

    def _note_indices(self) -> None:
        self._indices = {entry.index for entry in self}

    def __getitem__(self, key: tuple[int, int]) -> Entry:
        """Returns an entry for the firmware, even if it is hidden."""
        return self._entries[key]

    def open(self, index: int, sub: int) -> Entry:
        """Returns an entry for the bus; refuses missing and hidden entries."""
        entry = self._entries.get((index, sub))
        if entry is None or entry.hidden:
            code = Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT
            raise SdoAbortError(code, f"there is no object {index:04X}h:{sub:02X}")
        return entry

    def __contains__(self, key: tuple[int, int]) -> bool:
        entry = self._entries.get(key)
        return entry is not None and not entry.hidden

    def __iter__(self) -> Iterator[Entry]:
        return (entry for entry in self._entries.values() if not entry.hidden)

    def remove(self, index: int, sub: int) -> None:
        """Hides an object, as on a drive that lacks it."""
        self._entries[index, sub].hidden = True
        self._note_indices()

    def value(self, index: int, sub: int = 0) -> int:
        """Returns the current value of an integer entry."""
        return self._entries[index, sub].number()

    def renumber(self, before: int, after: int) -> None:
        """Adapts the defaults that contain the node id to a new node id."""
        for entry in self._entries.values():
            if entry.is_relative:
                entry.default += after - before

    def restore(self, first: int = 0x0000, last: int = 0xFFFF) -> None:
        """Restores the defaults of these indices, without calling the guards."""
        for entry in self._entries.values():
            if first <= entry.index <= last:
                entry.value = entry.default


def _variables(od: ObjectDictionary) -> dict[tuple[int, int], ODVariable]:
    return {(each.index, each.subindex): each for each in variables(od)}
