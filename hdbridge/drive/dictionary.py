"""The drive's object dictionary according to its EDS: objects, types and values."""

from pathlib import Path
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from hdbridge.axis import AxisConfig
from hdbridge.drive.objects import IntegerType
from hdbridge.files.edsfile import read_eds, shared_eds

INTEGER_TYPES: Final = {
    getattr(datatypes, f"{'INTEGER' if each.signed else 'UNSIGNED'}{each.bits}"): each for each in IntegerType
}
"""Integer types by their number in the EDS (CiA 301, table 44)."""
_TYPES: Final = {datatypes.BOOLEAN: IntegerType.UINT8, **INTEGER_TYPES}


def load_eds(path: Path | str, node_id: int) -> ObjectDictionary:
    """Returns the object dictionary of an EDS file; raises `InputError` if it cannot be read."""
    return read_eds(path, node_id).dictionary


def dictionary_of(axis: AxisConfig) -> ObjectDictionary:
    """Returns the read-only, shared dictionary of the axis's drive."""
    return shared_eds(axis.eds_path, axis.drive.node_id).dictionary


def find(od: ObjectDictionary, index: int, sub: int) -> ODVariable | None:
    """Returns an object that the EDS lists, or None.

    canopen's own look-up would derive missing array members from the first member.
    """
    entry = od.get(index)
    if isinstance(entry, ODVariable):
        return entry if sub == 0 else None
    return entry.subindices.get(sub) if entry is not None else None


def integer_type(variable: ODVariable) -> IntegerType | None:
    """Returns the integer type of an object; None if it is not an integer."""
    return _TYPES.get(variable.data_type or 0)


def held(variable: ODVariable) -> int | None:
    """Returns the object's value in the EDS: its value in a DCF, else its default, else None."""
    value = variable.value if variable.value is not None else variable.default
    return value if isinstance(value, int) else None


def permitted(variable: ODVariable, kind: IntegerType) -> tuple[int, int]:
    """Returns the least and the greatest value of an object, by its type and its limits in the EDS."""
    low = kind.minimum if variable.min is None else max(kind.minimum, variable.min)
    high = kind.maximum if variable.max is None else min(kind.maximum, variable.max)
    return low, high
