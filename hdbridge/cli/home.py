"""``hdbridge home``: homing by the drive."""

from hdbridge.cli.options import (
    AccelerationOption,
    HomingMethodOption,
    HomingTimeoutOption,
    JsonOption,
    OffsetOption,
    SwitchVelocityOption,
    ZeroVelocityOption,
    note,
    say,
    write_json,
)
from hdbridge.cli.session import Session, on_axis


@on_axis
def command(
    session: Session,
    method: HomingMethodOption,
    switch_velocity_deg_s: SwitchVelocityOption = None,
    zero_velocity_deg_s: ZeroVelocityOption = None,
    acceleration_deg_s2: AccelerationOption = None,
    offset_deg: OffsetOption = 0.0,
    timeout_s: HomingTimeoutOption = 60.0,
    json_file: JsonOption = None,
) -> None:
    """Home the drive by one of its own methods (CiA 402, mode HM); print the position of the axis.

    Ctrl-C stops it (exit status 130). A model belongs to the zero of its calibration. An absolute encoder
    needs no homing.
    """
    from hdbridge.drive.modes import Homing

    axis = session.axis
    wanted = (method, switch_velocity_deg_s, zero_velocity_deg_s, acceleration_deg_s2, offset_deg, timeout_s)
    Homing.checked(axis, *wanted)  # refused before anything is connected
    with session.drive() as drive:
        drive.boot()
        note(f"booted node {axis.drive.node_id} over {drive.link.name}")
        at = drive.home(*wanted)
    load_by_motor_deg = at.motor_deg / axis.gear.ratio
    write_json(
        json_file,
        {
            "schema": "hdbridge.home/1",
            "axis": axis.name,
            "method": method,
            "motor_position_deg": at.motor_deg,
            "load_position_by_motor_deg": load_by_motor_deg,
            "load_position_deg": at.load_deg,
        },
    )
    say(
        f"homed by method {method}: the load is at {load_by_motor_deg:.4f} deg by the motor encoder, "
        f"{at.load_deg:.4f} deg by its own; power is off"
    )
