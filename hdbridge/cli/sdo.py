"""``hdbridge sdo``: reads or writes one object of a drive, by the type in its EDS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hdbridge.cli.options import (
    JsonOption,
    ObjectArgument,
    ValueArgument,
    print_object,
    write_json,
)
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.drive.values import Object, Value


@on_axis
def get(
    session: Session,
    object_: ObjectArgument,
    json_file: JsonOption = None,
) -> None:
    """Read an object of the drive. The drive is neither booted nor enabled."""
    from hdbridge.drive.values import find_object

    with session.drive() as drive:
        drive.listen()
        wanted = find_object(object_, drive.sdo.od)
        if not wanted.readable:
            raise InputError(f"{wanted}: is write-only by the EDS")
        value = wanted.decode(drive.sdo.read_bytes(wanted.index, wanted.sub))
    write_json(json_file, _document(wanted, value))
    print_object(str(wanted), value, wanted.type_name)


@on_axis
def put(
    session: Session,
    object_: ObjectArgument,
    value: ValueArgument,
    json_file: JsonOption = None,
) -> None:
    """Write an object of the drive, and read it back. The drive is neither booted nor enabled.

    A value outside the object's type or range is refused. Careful: 6040h moves an axis. The value lasts
    until the drive is switched off or booted by `hdbridge`.
    """
    from hdbridge.drive.dictionary import load_eds
    from hdbridge.drive.values import find_object

    axis = session.axis
    wanted = find_object(object_, load_eds(axis.eds_path, axis.drive.node_id))
    if not wanted.writable:
        raise InputError(f"{wanted}: can only be read, by the EDS; nothing was written")
    data = wanted.encode(value)
    with session.drive() as drive:
        drive.listen()
        drive.sdo.write_bytes(wanted.index, wanted.sub, data)
        now = wanted.decode(drive.sdo.read_bytes(wanted.index, wanted.sub) if wanted.readable else data)
    write_json(json_file, _document(wanted, now))
    print_object(str(wanted), now, wanted.type_name)


def _document(wanted: Object, value: Value) -> dict[str, object]:
    return {
        "schema": "hdbridge.sdo/1",
        "index": wanted.index,
        "subindex": wanted.sub,
        "name": wanted.name,
        "type": wanted.type_name,
        "value": value,
    }


COMMANDS: Final = {"get": get, "set": put}
