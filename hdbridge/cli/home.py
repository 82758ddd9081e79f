"""``hdbridge home``: homing by the drive."""

from __future__ import annotations

from typing import Annotated

import typer

from hdbridge.cli.options import JsonOption, note, say, write_json
from hdbridge.cli.session import Session, on_axis

TOWARDS_SWITCH = 0.1
"""Share of the axis's velocity limit."""
TOWARDS_ZERO = 0.02


@on_axis
def command(
    session: Session,
    method: Annotated[
        int,
        typer.Option("--method", min=-128, max=127, help="Homing method, 6098h: see the drive's manual."),
    ],
    switch_velocity_deg_s: Annotated[
        float | None,
        typer.Option(
            "--switch-velocity",
            min=1e-6,
            help="Speed towards the switch, deg/s of the load; else a tenth of the axis's limit.",
        ),
    ] = None,
    zero_velocity_deg_s: Annotated[
        float | None,
        typer.Option(
            "--zero-velocity",
            min=1e-6,
            help="Speed towards the zero, deg/s of the load; else a fiftieth of the axis's limit.",
        ),
    ] = None,
    acceleration_deg_s2: Annotated[
        float | None,
        typer.Option(
            "--acceleration", min=1e-6, help="Acceleration of the load, deg/s2; else the axis's limit."
        ),
    ] = None,
    offset_deg: Annotated[
        float, typer.Option("--offset", help="Load angle of the home position (607Ch).")
    ] = 0.0,
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=0.1, max=3600.0, help="Longest time, s.")
    ] = 60.0,
    json_file: JsonOption = None,
) -> None:
    """Home the drive by one of its own methods (CiA 402, mode HM); print the position of the axis.

    The drive plans the motion. Ctrl-C stops it (exit status 130). A model belongs to the zero of its
    calibration. An absolute encoder needs no homing.
    """
    from hdbridge.drive.modes import Homing

    axis = session.axis
    highest_deg_s = axis.limits.velocity_deg_s
    towards_switch_deg_s = switch_velocity_deg_s or TOWARDS_SWITCH * highest_deg_s
    towards_zero_deg_s = zero_velocity_deg_s or TOWARDS_ZERO * highest_deg_s
    wanted = (method, towards_switch_deg_s, towards_zero_deg_s, acceleration_deg_s2, offset_deg, timeout_s)
    Homing.checked(axis, *wanted)  # refused before anything is connected
    with (
        session.drive() as drive,
    ):
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
