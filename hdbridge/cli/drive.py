"""Commands for one drive without a model: `reset`, `home`, `sdo`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import note, print_object, say, write_json
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.drive.values import Object, Value


@on_axis
def reset(session: Session, json_file: opt.Json = None) -> None:
    """Reset a fault of the drive once its cause is gone; power stays off.

    Boots the drive, prints the error code and the last emergency, and resets the fault. Nothing moves. Exit
    status 4 if the fault returns at once. With a daemon, use `hdbridge ctl reset`.
    """
    from hdbridge.drive.states import State

    axis = session.axis
    with session.drive() as drive:
        drive.boot()
        faulty = drive.state() is State.FAULT
        fault = drive.fault_reset() if faulty else None
        state = drive.state()
    write_json(
        json_file, {"schema": "hdbridge.reset/1", "axis": axis.name, "fault": fault, "state": state.value}
    )
    done = f"the fault is reset ({fault})" if faulty else "there is no fault to reset"
    say(f"{done}: the drive is in '{state.value}'")


@taking(Session, opt.Homing)
def home(session: Session, homing: opt.Homing, json_file: opt.Json = None) -> None:
    """Home the drive by one of its own methods (CiA 402, mode HM); print the position of the axis.

    Ctrl-C stops it (exit status 130). A model belongs to the zero of its calibration. An absolute encoder
    needs no homing.
    """
    from hdbridge.drive.modes import Homing

    axis = session.axis
    Homing(**vars(homing)).checked(axis)  # refused before anything is connected
    with session.drive() as drive:
        drive.boot()
        note(f"booted node {axis.drive.node_id} over {drive.link.name}")
        at = drive.home(**vars(homing))
    load_by_motor_deg = at.motor_deg / axis.gear.ratio
    write_json(
        json_file,
        {
            "schema": "hdbridge.home/1",
            "axis": axis.name,
            "method": homing.method,
            "motor_position_deg": at.motor_deg,
            "load_position_by_motor_deg": load_by_motor_deg,
            "load_position_deg": at.load_deg,
        },
    )
    say(
        f"homed by method {homing.method}: the load is at {load_by_motor_deg:.4f} deg by the motor encoder, "
        f"{at.load_deg:.4f} deg by its own; power is off"
    )


@on_axis
def get(session: Session, object_: opt.Object, json_file: opt.Json = None) -> None:
    """Read an object of the drive. The drive is neither booted nor enabled."""
    from hdbridge.drive.values import find_object

    with session.drive() as drive:
        drive.listen()
        wanted = find_object(object_, drive.sdo.od)
        if not wanted.readable:
            raise InputError(f"{wanted}: is write-only in the EDS")
        value = wanted.decode(drive.sdo.read_bytes(wanted.index, wanted.sub))
    write_json(json_file, _document(wanted, value))
    print_object(str(wanted), value, wanted.type_name)


@on_axis
def put(session: Session, object_: opt.Object, value: opt.Value, json_file: opt.Json = None) -> None:
    """Write an object of the drive, and read it back. The drive is neither booted nor enabled.

    A value outside the object's type or range is refused. Careful: 6040h moves an axis. The value lasts
    until the drive is switched off or booted by `hdbridge`.
    """
    from hdbridge.drive.dictionary import load_eds
    from hdbridge.drive.values import find_object

    axis = session.axis
    wanted = find_object(object_, load_eds(axis.eds_path, axis.drive.node_id))
    if not wanted.writable:
        raise InputError(f"{wanted}: is read-only in the EDS; nothing was written")
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


COMMANDS: Final = {"reset": reset, "home": home, "sdo": {"get": get, "set": put}}
