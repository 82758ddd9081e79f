"""PDO codec: mapped objects, and conversion between frame data and integers. No I/O.

The layout is compiled once into a `struct`, because it is used in every control cycle. A frame of the wrong
length is rejected as a whole. Only integers within the range of their type are packed, so NaN, infinity and
an out-of-range target never reach the bus.
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

from hdbridge.drive.objects import Address, IntegerType
from hdbridge.errors import DriveError, InputError

_CODES = {8: "b", 16: "h", 24: "3s", 32: "i", 64: "q"}
"""`struct` format by the width of a signed integer; `struct` has no 24-bit format."""
MAX_BYTES = 8
_FIRST_OBJECT = 0x1000


class PdoLengthError(DriveError):
    """A PDO's length differs from the length of its mapping; the PDO counts as lost."""


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """One mapped object."""

    index: int
    sub: int
    type: IntegerType

    @classmethod
    def of(cls, address: Address) -> Self:
        """Returns the entry that maps a known object."""
        return cls(address.index, address.sub, address.type)

    @property
    def is_gap(self) -> bool:
        """True for padding, a data type mapped in place of an object."""
        return self.index < _FIRST_OBJECT

    @property
    def mapping(self) -> int:
        """Value of a mapping parameter (1600h or 1A00h): index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.type.bits

    def __str__(self) -> str:
        """For example ``6064h:00 int32``."""
        return f"{self.index:04X}h:{self.sub:02X} {self.type.value}"


class PdoCodec:
    """Packs and unpacks one PDO.

    ``entries`` are the mapped objects in order. Raises `InputError` unless they have 1 to 8 bytes in total
    and no object occurs twice.
    """

    def __init__(self, entries: Iterable[PdoEntry]) -> None:
        self.entries: tuple[PdoEntry, ...] = tuple(entries)
        self._struct = struct.Struct("<" + "".join(map(_format, self.entries)))
        self._unpack = self._struct.unpack
        self.length: int = self._struct.size
        """Exact length of the PDO; bytes."""
        self.positions: dict[tuple[int, int], int] = {
            (entry.index, entry.sub): place for place, entry in enumerate(self.entries)
        }
        """Position of each object's value in the unpacked tuple, by (index, sub-index)."""
        # struct has no 24-bit integer: such entries are packed as three bytes and converted separately.
        self._odd = tuple(place for place, entry in enumerate(self.entries) if entry.type.bits == 24)
        names = ", ".join(map(str, self.entries))
        if not 1 <= self.length <= MAX_BYTES:
            raise InputError(
                f"a PDO carries 1 to {MAX_BYTES} bytes, but {names or 'nothing'} needs {self.length}"
            )
        objects = [entry for entry in self.entries if not entry.is_gap]
        if len({(entry.index, entry.sub) for entry in objects}) != len(objects):
            raise InputError(f"a PDO maps an object once, but got {names}")

    def unpack(self, data: bytes | bytearray) -> tuple[int, ...]:
        """Returns the mapped values in order; raises `PdoLengthError` for any other length."""
        try:
            values = self._unpack(data)
        except struct.error as error:
            raise PdoLengthError(
                f"a PDO of {', '.join(map(str, self.entries))} has {self.length} bytes, not {len(data)}; "
                "boot the drive again so that its mapping is what the master set"
            ) from error
        if not self._odd:
            return values
        decoded = list(values)
        for place in self._odd:
            decoded[place] = self.entries[place].type.decode(values[place])
        return tuple(decoded)

    def pack(self, values: Sequence[int]) -> bytes:
        """Returns the frame's data; raises `InputError` if a value does not fit its integer type."""
        if not self._odd:
            try:
                # struct itself refuses non-integers (NaN is a float) and out-of-range values.
                return self._struct.pack(*values)
            except struct.error as error:
                raise self._refusal(values) from error
        encoded: list[int | bytes] = list(values)
        for place in self._odd:
            kind = self.entries[place].type
            if not isinstance(values[place], int) or not kind.minimum <= values[place] <= kind.maximum:
                raise self._refusal(values)
            encoded[place] = kind.encode(values[place])
        try:
            return self._struct.pack(*encoded)
        except struct.error as error:
            raise self._refusal(values) from error

    def _refusal(self, values: Sequence[int]) -> InputError:
        if len(values) != len(self.entries):
            return InputError(
                f"a PDO of {len(self.entries)} objects needs as many values, but got {len(values)}"
            )
        for entry, value in zip(self.entries, values, strict=True):
            if not isinstance(value, int) or not entry.type.minimum <= value <= entry.type.maximum:
                break
        return InputError(
            f"object {entry}: {value!r} is not an integer in "
            f"[{entry.type.minimum}, {entry.type.maximum}]; nothing was sent"
        )


def _format(entry: PdoEntry) -> str:
    code = _CODES[entry.type.bits]
    return code if entry.type.signed or entry.type.bits == 24 else code.upper()
