"""Encoding of samples as Protocol Buffers messages, one batch at a time.

Foxglove, PlotJuggler and all MCAP tools decode protobuf by the schema in the file. If all fields of a message
are present and of fixed width, its bytes have a fixed layout: tag, value, tag, value. A batch is therefore a
numpy array of that layout, filled column by column, without encoding each message.

One table of fields (`AXIS_FIELDS`, `MACHINE_FIELDS`) defines both schema and layout.
"""

from collections.abc import Iterable, Mapping
from enum import Enum
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from numpy.typing import NDArray

from hdbridge.cia301 import NmtState
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import AXIS_SAMPLE, NO_FAULT, SampleArray
from hdbridge.daemon.memory.layout import SAMPLE_HEAD
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault
from hdbridge.errors import InputError
from hdbridge.motion.modes import MotionMode

PACKAGE: Final = "hdbridge"
_FIXED: Final = {
    "f8": (FieldDescriptorProto.TYPE_DOUBLE, 1),
    "f4": (FieldDescriptorProto.TYPE_FLOAT, 5),
    "i8": (FieldDescriptorProto.TYPE_SFIXED64, 1),
    "u8": (FieldDescriptorProto.TYPE_FIXED64, 1),
    "u4": (FieldDescriptorProto.TYPE_FIXED32, 5),
}
"""Protobuf type and wire type of each numpy type."""
_VARINT: Final = 0
_MORE: Final = 0x80


class Field(NamedTuple):
    """Field of a message; its number is its position in the table, from 1."""

    name: str
    kind: str
    """Numpy type, or ``enum`` for a byte."""
    values: Mapping[int, str] | None = None
    """Names of an enum's values."""


def _names(values: Iterable[Enum]) -> dict[int, str]:
    return {place: each.name for place, each in enumerate(values)}


_ENUMS: Final[Mapping[str, Mapping[int, str]]] = {
    "state": {int(each): each.name for each in AxisState},
    "mode": {int(each): each.name for each in MotionMode},
    "power": _names(State),
    "fault": _names(Fault) | {NO_FAULT: "NONE"},
    "outer_nmt": {int(each): each.name for each in NmtState},
    "outer_mode": {0: "NONE", 1: "PP", 6: "HM", 7: "IP", 8: "CSP"},
}
_WIDE: Final = {"u2": "u4"}
"""Wider types in place of types that protobuf lacks."""
_AXIS_NAMES: Final = AXIS_SAMPLE.names or ()
AXIS_FIELDS: Final = (
    Field("cycle", "i8"),
    *(
        Field(name, "enum", _ENUMS[name])
        if name in _ENUMS
        else Field(name, _WIDE.get(AXIS_SAMPLE[name].str[1:], AXIS_SAMPLE[name].str[1:]))
        for name in _AXIS_NAMES
    ),
)
MACHINE_FIELDS: Final = tuple(Field(name, kind) for name, kind in SAMPLE_HEAD)


class Message:
    """Message type: its schema, encoding and decoding of batches."""

    def __init__(self, name: str, fields: tuple[Field, ...]) -> None:
        self.name = f"{PACKAGE}.{name}"
        self._short = name
        self._fields = fields
        layout: list[tuple[str, Any]] = []
        tags: dict[str, bytes] = {}
        for number, each in enumerate(fields, 1):
            wire = _VARINT if each.kind == "enum" else _FIXED[each.kind][1]
            tags[f"tag {number}"] = tag = _varint(number << 3 | wire)
            layout.append((f"tag {number}", f"V{len(tag)}"))
            # An enum is always two bytes, so that the layout does not depend on its value.
            layout.append((each.name, ("u1", (2,)) if each.kind == "enum" else f"<{each.kind}"))
        self.layout = np.dtype(layout)
        self._template = np.zeros((), self.layout)
        for place, tag in tags.items():
            self._template[place] = np.void(tag)

    @cached_property
    def schema(self) -> bytes:
        """Serialised FileDescriptorSet, as MCAP requires for protobuf."""
        files = FileDescriptorSet()
        file = files.file.add(name=f"{PACKAGE}/{self._short}.proto", package=PACKAGE, syntax="proto3")
        message: DescriptorProto = file.message_type.add(name=self._short)
        for number, each in enumerate(self._fields, 1):
            field = message.field.add(
                name=each.name, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL
            )
            if each.values is None:
                field.type = _FIXED[each.kind][0]
                continue
            kind = message.enum_type.add(name=each.name.title())
            for value, name in each.values.items():
                kind.value.add(name=f"{each.name.upper()}_{name}", number=value)
            field.type = FieldDescriptorProto.TYPE_ENUM
            field.type_name = f".{self.name}.{kind.name}"
        return files.SerializeToString()

    def encode(self, columns: Mapping[str, Any], count: int) -> list[bytes]:
        """Returns ``count`` encoded messages; ``columns`` has an array for each field."""
        rows = np.full(count, self._template, self.layout)
        for each in self._fields:
            values = columns[each.name]
            if each.kind == "enum":
                rows[each.name][:, 0] = values & ~np.uint8(_MORE) | np.uint8(_MORE)
                rows[each.name][:, 1] = values >> 7
            else:
                rows[each.name] = values
        data, size = rows.tobytes(), self.layout.itemsize
        return [data[at : at + size] for at in range(0, count * size, size)]

    def decode(self, messages: list[bytes]) -> dict[str, NDArray[Any]]:
        """Returns a column per field. Raises InputError if a message does not have this layout."""
        if {len(each) for each in messages} <= {self.layout.itemsize}:
            rows = np.frombuffer(b"".join(messages), self.layout)
            tags = (self.layout.names or ())[::2]
            if all(np.all(rows[each] == self._template[each]) for each in tags):
                return {
                    each.name: (rows[each.name][:, 0] & 0x7F) | (rows[each.name][:, 1] << 7)
                    if each.kind == "enum"
                    else rows[each.name]
                    for each in self._fields
                }
        raise InputError(f"its {self._short} messages come from another release of hdbridge")


def _varint(value: int) -> bytes:
    result = b""
    while value >= _MORE:
        result += bytes([value & 0x7F | _MORE])
        value >>= 7
    return result + bytes([value])


AXIS: Final = Message("AxisSample", AXIS_FIELDS)
MACHINE: Final = Message("MachineSample", MACHINE_FIELDS)


def axis_messages(samples: SampleArray, place: int) -> list[bytes]:
    """Returns one message per sample for the axis at ``place``."""
    axis: Any = samples["axes"][:, place]
    return AXIS.encode(
        {"cycle": samples["cycle"], **{name: axis[name] for name in _AXIS_NAMES}}, len(samples)
    )


def machine_messages(samples: SampleArray) -> list[bytes]:
    """Returns one message per sample for the machine."""
    return MACHINE.encode({each.name: samples[each.name] for each in MACHINE_FIELDS}, len(samples))
