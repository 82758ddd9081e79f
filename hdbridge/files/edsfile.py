"""Reads EDS and DCF files (CiA 306) as vendors ship them, as object dictionaries of the package canopen.

canopen's own reader accepts only well-formed files in UTF-8. This reader accepts any encoding, letter case
and spelling of numbers, and compact descriptions. An unreadable value is reported with line, section and key.
It raises `InputError` if the object cannot be described without the value; otherwise it is listed in
`Eds.unread`.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple, Never

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from hdbridge.errors import InputError
from hdbridge.files.atomic import open_regular

MAX_BYTES: Final = 16 << 20
_MOST_OBJECTS: Final = 100_000
_SHOWN: Final = 40
_DOS_END: Final = "\x1a"
_NUMBER: Final = re.compile(r"([+-]?)(0[xX][0-9a-fA-F]{1,32}|[0-9]{1,40})")
_NODE_ID: Final = re.compile(r"\+?\$NODEID\+?")
_OBJECT: Final = re.compile(r"([0-9A-F]{4})(?:SUB([0-9A-F]{1,2}))?")
_TRUTH: Final = {"TRUE": 1, "YES": 1, "FALSE": 0, "NO": 0, "": 0}
_ACCESS: Final = ("ro", "wo", "rw", "rwr", "rww", "const")
_DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR, _ARRAY, _RECORD = 2, 5, 6, 7, 8, 9
_OBJECT_TYPES: Final = (0, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR, _ARRAY, _RECORD)
_LAST_STANDARD_TYPE: Final = 0x1B
_INTEGERS: Final = frozenset(datatypes.INTEGER_TYPES) | {datatypes.BOOLEAN}
_BITS: Final = {
    datatypes.INTEGER8: 8, datatypes.INTEGER16: 16, datatypes.INTEGER24: 24, datatypes.INTEGER32: 32,
    datatypes.INTEGER40: 40, datatypes.INTEGER48: 48, datatypes.INTEGER56: 56, datatypes.INTEGER64: 64,
}  # fmt: skip
"""Number of bits of each signed type. A file may state the values of these types in two's complement."""
_TEXTS: Final = (datatypes.VISIBLE_STRING, datatypes.UNICODE_STRING)
_BYTES: Final = (datatypes.OCTET_STRING, datatypes.DOMAIN)
_DEVICE: Final = {
    "VendorNumber": "vendor_number", "ProductNumber": "product_number", "RevisionNumber": "revision_number",
    "NrOfRXPDO": "nr_of_RXPDO", "NrOfTXPDO": "nr_of_TXPDO",
}  # fmt: skip
"""Numbers of [DeviceInfo], with the attributes of canopen's ``device_information``."""
_LARGEST_COMPACT: Final = 254
_PDOS: Final = 512
_COMPACT_PDO: Final = (
    ("COB-ID", 0x0007), ("Transmission type", 0x0005), ("Inhibit time", 0x0006), ("Reserved", 0x0005),
    ("Event timer", 0x0006), ("SYNC start value", 0x0005),
)  # fmt: skip
"""Sub-indices 1 to 6 of a PDO's communication parameter: bits 0 to 5 of CompactPDO."""
_COMPACT_ENTRIES: Final = 64


class Eds(NamedTuple):
    """Content of an EDS or DCF file."""

    dictionary: ObjectDictionary
    unread: tuple[str, ...]
    """Unreadable values, which count as missing; each text states line, section and key."""


def read_eds(path: Path | str, node_id: int) -> Eds:
    """Reads an EDS or DCF file for a node; raises a one-line `InputError` if it cannot be read."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; expected an EDS file")
        with open_regular(path) as file:
            data = file.read()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; expected the drive's EDS file"
        ) from error
    return _Reader(path, decode(data), node_id).read()


def variables(od: ObjectDictionary) -> Iterator[ODVariable]:
    """Yields every entry of an object dictionary, including the members of arrays and records."""
    for item in od.values():
        yield from [item] if isinstance(item, ODVariable) else item.subindices.values()


def shared_eds(path: Path | str, node_id: int) -> Eds:
    """Returns the result of `read_eds`, cached until the file changes; the result must not be modified."""
    path = Path(path)
    try:
        modified_ns = path.stat().st_mtime_ns
    except OSError:
        modified_ns = 0  # `read_eds` reports it
    return _read_as_of(modified_ns, path, node_id)


@lru_cache(maxsize=8)
def _read_as_of(_: int, path: Path, node_id: int) -> Eds:
    return read_eds(path, node_id)


def decode(data: bytes) -> str:
    """Decodes the bytes of a file in UTF-8, UTF-16 (with or without byte-order mark) or Windows-1252."""
    for mark, encoding in (
        (b"\xef\xbb\xbf", "utf-8"),
        (b"\xff\xfe", "utf-16-le"),
        (b"\xfe\xff", "utf-16-be"),
    ):
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors="replace")
    head = data[:400]
    if len(head) > 1 and head[1::2].count(0) > len(head) // 4:
        return data.decode("utf-16-le", errors="replace")
    if len(head) > 1 and head[::2].count(0) > len(head) // 4:
        return data.decode("utf-16-be", errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("windows-1252", errors="replace")


class _Key(NamedTuple):
    value: str
    line: int


class _Section:
    """A section of the file: its name as written, its line number, and its keys in capitals."""

    def __init__(self, name: str, line: int) -> None:
        self.name, self.line = name, line
        self.keys: dict[str, _Key] = {}

    def get(self, key: str) -> str:
        """Returns the value of a key; empty if the key is missing."""
        found = self.keys.get(key.upper())
        return found.value if found is not None else ""


class _Reader:
    """Builds the object dictionary of one file."""

    def __init__(self, path: Path, text: str, node_id: int) -> None:
        self._path, self._node_id = path, node_id
        self._unread: list[str] = []
        self._sections: dict[str, _Section] = {}
        self._split(text)

    def read(self) -> Eds:
        objects = self._objects()
        if not objects and "DEVICEINFO" not in self._sections:
            raise InputError(
                f"{self._path}: cannot be read as an EDS: it has neither a section [DeviceInfo] nor an "
                "object; expected the drive's EDS file"
            )
        dictionary = ObjectDictionary()  # type: ignore[no-untyped-call]
        for key, attribute in _DEVICE.items():
            setattr(dictionary.device_information, attribute, self._device_number(key))
        for index in sorted(objects):
            self._add_object(dictionary, index, objects[index])
        return Eds(dictionary, tuple(self._unread))

    # -- lines --------------------------------------------------------------------------------------------

    def _split(self, text: str) -> None:
        """Splits the text into sections and keys. Of two equal keys the first applies, as in Windows."""
        section = None
        end = text.find(_DOS_END)
        for number, raw in enumerate(re.split(r"\r\n|\n|\r", text[:end] if end >= 0 else text), start=1):
            line = raw.replace("\x00", "").strip("\ufeff \t\v\f")
            if not line or line[0] in ";#":
                continue
            if line[0] == "[":
                name = line[1:].partition("]")[0].strip()
                section = self._sections.setdefault(name.upper(), _Section(name, number))
            elif section is not None:
                key, equals, value = line.partition("=")
                if equals:
                    value = re.split(r"\s;|^;", value, maxsplit=1)[0]
                    section.keys.setdefault(key.strip().upper(), _Key(value.strip(), number))
                elif _OBJECT.fullmatch(section.name.upper()):
                    self._refuse(section, number, "", line, "a key, '=' and a value")

    def _refuse(self, section: _Section, line: int, key: str, found: str, expected: str) -> Never:
        raise InputError(
            self._place(section, line, key)
            + f"found {_shown(found) if found else 'nothing'}; expected {expected}"
        )

    def _place(self, section: _Section, line: int, key: str) -> str:
        return f"{self._path}:{line}: [{_printable(section.name)}]{' ' + key if key else ''}: "

    # -- values -------------------------------------------------------------------------------------------

    def _number(self, section: _Section, key: str, default: int | None = None) -> int:
        """Returns a number that an object requires; ``default`` if the key is missing or empty."""
        text, line = section.keys.get(key.upper(), _Key("", section.line))
        value = _integer(text)
        if value is None and text == "" and default is not None:
            return default
        if value is None:
            self._refuse(section, line, key, text, "a number, such as 0x0007")
        return value

    def _value(self, section: _Section, key: str, data_type: int) -> Any:
        """Returns a value of this type; None if it is missing or unreadable."""
        text = section.get(key)
        if text == "" or data_type in _TEXTS:
            return text or None
        try:
            if data_type in _BYTES:
                return bytes.fromhex(text)
            if data_type in datatypes.FLOAT_TYPES:
                return float(text)
        except ValueError:
            return None
        plain = text.replace(" ", "").upper()
        if "$NODEID" in plain:
            offset = _integer(_NODE_ID.sub("", plain) or "0")
            if offset is not None:
                return offset + self._node_id if offset >= 0 else None
        else:
            value = _TRUTH.get(plain) if data_type == datatypes.BOOLEAN else None
            value = _integer(plain) if value is None else value
            if value is not None:
                bits = _BITS.get(data_type)
                return value - (1 << bits) if bits and 1 << bits - 1 <= value < 1 << bits else value
        if data_type in _INTEGERS:
            self._note(section, key, text, "a number")
        return None

    def _limits(self, section: _Section, data_type: int) -> tuple[int | None, int | None]:
        """Returns lower and upper limit of an integer; None without a limit."""
        low, high = (
            self._value(section, key, data_type)
            if data_type in _INTEGERS and "$NODEID" not in section.get(key).upper()
            else None
            for key in ("LowLimit", "HighLimit")
        )
        # Limits without a range, such as 0 and 0, mean that there are no limits.
        return (low, high) if low is None or high is None or low < high else (None, None)

    def _note(self, section: _Section, key: str, text: str, expected: str) -> None:
        place = self._place(section, section.keys[key.upper()].line, key)
        self._unread.append(f"{place}{_shown(text)} is not {expected} and counts as not given")

    # -- objects ------------------------------------------------------------------------------------------

    def _objects(self) -> dict[int, dict[int | None, _Section]]:
        """Returns the sections of each object by sub-index; the key None denotes the object itself."""
        objects: dict[int, dict[int | None, _Section]] = {}
        for name, section in self._sections.items():
            match = _OBJECT.fullmatch(name)
            if match is not None and int(match[1], 16) >= 0x1000:
                sub = None if match[2] is None else int(match[2], 16)
                objects.setdefault(int(match[1], 16), {})[sub] = section
        self._add_compact_pdos(objects)
        if sum(map(len, objects.values())) > _MOST_OBJECTS:
            raise InputError(
                f"{self._path}: describes more than {_MOST_OBJECTS} objects; expected an EDS file"
            )
        return objects

    def _device_number(self, key: str) -> int | None:
        device = self._sections.get("DEVICEINFO")
        text = device.get(key) if device is not None else ""
        value = _integer(text)
        if device is not None and value is None and text:
            self._note(device, key, text, "a number")
        return value

    def _add_object(
        self, dictionary: ObjectDictionary, index: int, parts: Mapping[int | None, _Section]
    ) -> None:
        members = {sub: section for sub, section in parts.items() if sub is not None}
        section = parts.get(None)
        if section is None:  # the section of the object may be missing: its sub-objects describe it fully
            section = _Section(f"{index:04X}", next(iter(members.values())).line)
        kind = self._number(section, "ObjectType", _RECORD if members else _VAR)
        if kind not in _OBJECT_TYPES:
            line = section.keys["OBJECTTYPE"].line
            self._refuse(section, line, "ObjectType", section.get("ObjectType"), "2, 5, 6, 7, 8 or 9")
        if kind in (0, _DEFTYPE, _DEFSTRUCT):
            return
        compact = self._number(section, "CompactSubObj", 0)
        if kind in (_VAR, _DOMAIN) and not (members or compact):
            dictionary.add_object(self._variable(section, kind, f"{index:04X}", index))
            return
        if compact:
            members = {**dict(self._spelt_out(index, section, compact)), **members}
        name = section.get("ParameterName") or f"{index:04X}"
        made = (ODArray if kind == _ARRAY else ODRecord)(name, index)
        dictionary.add_object(made)
        for sub in sorted(members):
            made.add_member(self._variable(members[sub], _VAR, f"{index:04X}sub{sub:X}", index, sub))

    def _variable(self, section: _Section, kind: int, name: str, index: int, sub: int = 0) -> ODVariable:
        """Returns an entry; ``name`` is used if the file states none."""
        kind = self._number(section, "ObjectType", kind)
        data_type = self._number(section, "DataType", datatypes.DOMAIN if kind == _DOMAIN else None)
        if data_type > _LAST_STANDARD_TYPE:
            data_type = self._own_type(data_type)
        access = section.get("AccessType").lower() or "rw"
        if access not in _ACCESS:
            line = section.keys["ACCESSTYPE"].line
            self._refuse(section, line, "AccessType", section.get("AccessType"), ", ".join(_ACCESS))
        variable = ODVariable(section.get("ParameterName") or name, index, sub)
        variable.data_type, variable.access_type = data_type, access
        variable.pdo_mappable = self._truth(section, "PDOMapping")
        variable.min, variable.max = self._limits(section, data_type)
        variable.default = self._value(section, "DefaultValue", data_type)
        variable.value = self._value(section, "ParameterValue", data_type)
        relative = "$NODEID" in section.get("DefaultValue").upper()
        variable.relative = relative and variable.default is not None
        return variable

    def _truth(self, section: _Section, key: str) -> bool:
        text = section.get(key)
        value = _TRUTH.get(text.upper())
        value = _integer(text) if value is None else value
        if value is None:
            self._refuse(section, section.keys[key.upper()].line, key, text, "0 or 1")
        return value != 0

    def _own_type(self, number: int) -> int:
        """Returns the base type of a custom type, as CANFestival writes it; DOMAIN (bytes) if unknown."""
        section = self._sections.get(f"{number:X}SUB1")
        value = _integer(section.get("DefaultValue")) if section is not None else None
        return value if value is not None and 0 < value <= _LAST_STANDARD_TYPE else datatypes.DOMAIN

    def _spelt_out(self, index: int, section: _Section, count: int) -> Iterator[tuple[int, _Section]]:
        """Yields the sub-objects that CompactSubObj describes collectively, by sub-index."""
        if not 0 < count <= _LARGEST_COMPACT:
            line = section.keys["COMPACTSUBOBJ"].line
            found = section.get("CompactSubObj")
            self._refuse(section, line, "CompactSubObj", found, f"a number from 0 to {_LARGEST_COMPACT}")
        names = self._sections.get(f"{index:04X}NAME", section)
        values = self._sections.get(f"{index:04X}VALUE", section)
        yield 0, _made("Number of entries", section, DataType=5, AccessType="ro", DefaultValue=count)
        for sub in range(1, count + 1):
            member = _Section(section.name, section.line)
            member.keys = {key: each for key, each in section.keys.items() if key != "OBJECTTYPE"}
            name = names.get(str(sub)) or f"{section.get('ParameterName')}{sub}"
            member.keys["PARAMETERNAME"] = _Key(name, section.line)
            if own := values.keys.get(str(sub)):
                member.keys["DEFAULTVALUE"] = own
            yield sub, member

    def _add_compact_pdos(self, objects: dict[int, dict[int | None, _Section]]) -> None:
        """Adds the PDOs that CompactPDO describes: all PDOs of the device without sections of their own."""
        mask = self._device_number("CompactPDO") or 0
        if not mask & 0x3F:
            return
        device = self._sections["DEVICEINFO"]
        for key, base, first in (("NrOfRXPDO", 0x1400, 0x200), ("NrOfTXPDO", 0x1800, 0x180)):
            left = min(self._device_number(key) or 0, _PDOS)
            left -= sum(base + n in objects or base + 0x200 + n in objects for n in range(_PDOS))
            for number in range(_PDOS):
                if base + number not in objects and base + 0x200 + number not in objects:
                    if left <= 0:
                        break
                    left -= 1
                cob_id = f"$NODEID+{first + number * 0x100}" if number < 4 else str(1 << 31)
                objects.setdefault(base + number, dict(_compact_parameter(device, mask, cob_id)))
                objects.setdefault(base + 0x200 + number, dict(_compact_mapping(device)))


def _compact_parameter(device: _Section, mask: int, cob_id: str) -> Iterator[tuple[int, _Section]]:
    subs = [sub for sub in range(1, 7) if mask >> sub - 1 & 1]
    yield 0, _made("Highest sub-index", device, DataType=5, AccessType="const", DefaultValue=subs[-1])
    for sub in subs:
        name, data_type = _COMPACT_PDO[sub - 1]
        default = {"DefaultValue": cob_id} if sub == 1 else {}
        yield sub, _made(name, device, DataType=data_type, AccessType="rw", **default)


def _compact_mapping(device: _Section) -> Iterator[tuple[int, _Section]]:
    yield 0, _made("Number of mapped objects", device, DataType=5, AccessType="rw", DefaultValue=0)
    for sub in range(1, _COMPACT_ENTRIES + 1):
        yield sub, _made(f"Mapped object {sub}", device, DataType=7, AccessType="rw", DefaultValue=0)


def _made(name: str, of: _Section, **keys: int | str) -> _Section:
    """Creates a section that the file describes only implicitly, within the section ``of``."""
    section = _Section(of.name, of.line)
    section.keys = {
        key.upper(): _Key(str(value), of.line) for key, value in (("ParameterName", name), *keys.items())
    }
    return section


def _integer(text: str) -> int | None:
    """Parses a decimal (leading zeros allowed) or hexadecimal integer; returns None for any other text."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        return None
    value = int(match[2], 16 if match[2][:2] in ("0x", "0X") else 10)
    return -value if match[1] == "-" else value


def _shown(text: str) -> str:
    text = _printable(text)
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def _printable(text: Iterable[str]) -> str:
    return "".join(each if each.isprintable() else "?" for each in text)
