"""Conversion of object values between bytes and text, by the type given in the EDS."""

import math
import re
import struct

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from hdbridge.drive.dictionary import INTEGER_TYPES, permitted
from hdbridge.drive.objects import STANDARD, IntegerType
from hdbridge.errors import InputError
from hdbridge.files.edsfile import variables
from hdbridge.files.expectation import nearest

Value = int | float | bool | str
_REALS = {datatypes.REAL32: ("<f", "real32"), datatypes.REAL64: ("<d", "real64")}
_TEXTS = {datatypes.VISIBLE_STRING: "text", datatypes.UNICODE_STRING: "unicode text"}


class Object:
    """Entry of a node's object dictionary: name, type, access and limits."""

    def __init__(self, variable: ODVariable, name: str) -> None:
        self.index, self.sub, self.name = variable.index, variable.subindex, name
        self.data_type = variable.data_type or 0
        """Number of the type in the EDS."""
        self.integer = INTEGER_TYPES.get(self.data_type)
        self.readable, self.writable = variable.readable, variable.writable
        self.permitted = permitted(variable, self.integer) if self.integer is not None else (0, 0)
        """Least and greatest value of an integer."""

    @property
    def type_name(self) -> str:
        """Name of the type, for example int32."""
        if self.integer is not None:
            return self.integer.value
        if self.data_type == datatypes.BOOLEAN:
            return "boolean"
        if self.data_type in _REALS:
            return _REALS[self.data_type][1]
        return _TEXTS.get(self.data_type, "bytes")

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X}" + (f" '{self.name}'" if self.name else "")

    def decode(self, data: bytes) -> Value:
        """Decodes a value, of unknown types as hexadecimal text; `InputError` for a wrong length."""
        try:
            if self.integer is not None:
                return self.integer.decode(_fitting(data, self.integer.bits // 8))
            if self.data_type == datatypes.BOOLEAN:
                return bool(_fitting(data, 1)[0])
            if self.data_type in _REALS:
                form = _REALS[self.data_type][0]
                return float(struct.unpack(form, _fitting(data, struct.calcsize(form)))[0])
        except ValueError as problem:
            raise InputError(
                f"{self}: answered {problem}, which is not of the type {self.type_name}; check that "
                f"drive.eds is the EDS "
                "of this drive"
            ) from None
        if self.data_type == datatypes.UNICODE_STRING:
            return data.decode("utf-16-le", errors="replace").rstrip("\x00")
        if self.data_type == datatypes.VISIBLE_STRING:
            return data.decode("ascii", errors="replace").rstrip("\x00")
        return data.hex(" ")

    def encode(self, text: str) -> bytes:
        """Encodes a value written as text; `InputError` if it has a different type or is out of range."""
        if self.integer is not None:
            return self.integer.encode(self._integer(text, self.integer))
        if self.data_type == datatypes.BOOLEAN:
            if text.lower() not in {"0", "1", "false", "true"}:
                raise self._wrong(text, "0 or 1")
            return bytes([text.lower() in {"1", "true"}])
        if self.data_type in _REALS:
            try:
                value = float(text)
                if not math.isfinite(value):
                    raise ValueError
                return struct.pack(_REALS[self.data_type][0], value)
            except (ValueError, OverflowError):
                raise self._wrong(text, f"a finite number ({self.type_name})") from None
        if self.data_type in _TEXTS:
            encoding = "ascii" if self.data_type == datatypes.VISIBLE_STRING else "utf-16-le"
            try:
                return text.encode(encoding)
            except UnicodeEncodeError:
                raise self._wrong(text, "ASCII characters") from None
        try:
            return bytes.fromhex(text)
        except ValueError:
            raise self._wrong(text, "bytes in hexadecimal, such as '01 a0'") from None

    def _integer(self, text: str, kind: IntegerType) -> int:
        low, high = self.permitted
        try:
            value = int(text, 16) if re.fullmatch(r"0[xX][0-9a-fA-F]+", text) else int(text)
        except ValueError:
            raise self._wrong(text, f"an integer from {low} to {high} ({kind.value}), or 0x...") from None
        if not low <= value <= high:
            raise self._wrong(text, f"an integer from {low} to {high} ({kind.value})")
        return value

    def _wrong(self, found: str, expected: str) -> InputError:
        return InputError(f"{self}: found {found!r}; expected {expected}: nothing was written")


def find_object(text: str, od: ObjectDictionary) -> Object:
    """Returns an object by its number (6064h, 0x1018:4, 60C2h:01) or its name in the EDS.

    A sub-index is hexadecimal, as in manuals. Raises `InputError` for an unknown object.
    """
    number = re.fullmatch(r"(?:0[xX])?([0-9a-fA-F]{4})[hH]?(?:[:.](?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?", text)
    known = {_name(each): each for each in variables(od)}
    if number is None:
        close = nearest(text, list(known))
        variable = next((each for name, each in known.items() if name.lower() == text.lower()), None)
        if variable is None:
            raise InputError(
                f"{text!r}: no object of the EDS has this name; expected its number, such as 6064h or "
                "1018h:04" + (f", or did you mean '{close}'?" if close else "")
            )
        return Object(variable, _name(variable))
    index, sub = int(number[1], 16), int(number[2] or "0", 16)
    variable = next((each for each in known.values() if (each.index, each.subindex) == (index, sub)), None)
    if variable is not None:
        return Object(variable, _name(variable))
    standard = STANDARD.get((index, sub))
    if standard is not None:
        variable = ODVariable(standard.name, index, sub)
        variable.data_type = next(each for each, kind in INTEGER_TYPES.items() if kind is standard.type)
        return Object(variable, standard.name)
    subs = sorted(each.subindex for each in known.values() if each.index == index)
    has = f"; it has the sub-indices {', '.join(f'{each:02X}' for each in subs)}" if subs else ""
    raise InputError(f"{index:04X}h:{sub:02X}: neither the EDS nor the profile has this object{has}")


def _name(variable: ODVariable) -> str:
    return str(variable.qualname)


def _fitting(data: bytes, size: int) -> bytes:
    """Truncates an expedited answer to ``size`` bytes; extra bytes may only repeat the sign."""
    if len(data) < size or any(each not in {0, 0xFF} for each in data[size:]):
        raise ValueError(f"{len(data)} bytes ({data.hex(' ')})")
    return data[:size]
