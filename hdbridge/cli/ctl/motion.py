"""Power and motion of a daemon's axes. A command that moves holds the lease while it runs."""

from typing import Annotated

import typer

from hdbridge.cli.ctl.common import (
    AtOption,
    AxesArgument,
    AxisArgument,
    OneAxisArgument,
    TakeOption,
    connected,
    moving,
    stopped_by_signals,
    stopping,
    tell,
)
from hdbridge.cli.options import (
    AccelerationOption,
    AnglesArgument,
    HomingMethodOption,
    HomingTimeoutOption,
    JsonOption,
    OffsetOption,
    SwitchVelocityOption,
    VelocityOption,
    ZeroVelocityOption,
    note_clamped,
)
from hdbridge.errors import InputError


def enable(
    axis: OneAxisArgument = None, at: AtOption = None, force: TakeOption = False, json_file: JsonOption = None
) -> None:
    """Switch power on at standstill; boots and verifies the drive first if necessary."""
    with moving(at, axis, force=force) as moved:
        tell(moved.enable(), json_file)


def disable(
    axis: OneAxisArgument = None, at: AtOption = None, force: TakeOption = False, json_file: JsonOption = None
) -> None:
    """Brake to rest, then switch power off. A suspended load needs a brake."""
    with moving(at, axis, force=force) as moved:
        tell(moved.disable(), json_file)


def reset(
    axis: OneAxisArgument = None, at: AtOption = None, force: TakeOption = False, json_file: JsonOption = None
) -> None:
    """Release a latched stop when its cause is gone; the axis stays disabled."""
    with moving(at, axis, force=force) as moved:
        tell(moved.reset(), json_file)


def home(
    method: HomingMethodOption,
    axis: OneAxisArgument = None,
    switch_velocity_deg_s: SwitchVelocityOption = None,
    zero_velocity_deg_s: ZeroVelocityOption = None,
    acceleration_deg_s2: AccelerationOption = None,
    offset_deg: OffsetOption = 0.0,
    timeout_s: HomingTimeoutOption = 60.0,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Home by one of the drive's own methods; the axis is disabled before and after."""
    with moving(at, axis, force=force) as moved:
        done = moved.home(
            method,
            switch_velocity_deg_s=switch_velocity_deg_s,
            zero_velocity_deg_s=zero_velocity_deg_s,
            acceleration_deg_s2=acceleration_deg_s2,
            offset_deg=offset_deg,
            timeout_s=timeout_s,
        )
        tell(done, json_file)


def stop(axes: AxesArgument = None, at: AtOption = None) -> None:
    """Brake axes to rest within their limits; they stay enabled. Needs no right to move."""
    with stopping(at) as client:
        states = [client.axis(each).stop() for each in axes] if axes else client.stop().axes
    for each in states:
        tell(each, None)


def quick_stop(axes: AxesArgument = None, at: AtOption = None) -> None:
    """Stop axes as fast as their drives can, latched until a reset. Needs no right to move."""
    with stopping(at) as client:
        states = [client.axis(each).quick_stop() for each in axes] if axes else client.quick_stop().axes
    for each in states:
        tell(each, None)


def move(
    axis: AxisArgument,
    angles_deg: AnglesArgument,
    relative: Annotated[
        bool, typer.Option("--relative", help="Each angle is relative to the previous target.")
    ] = False,
    velocity_deg_s: VelocityOption = None,
    acceleration_deg_s2: AccelerationOption = None,
    wait: Annotated[
        bool, typer.Option("--wait/--no-wait", help="Wait until the axis rests there; else return at once.")
    ] = True,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Move the load to one angle or to several, and hold the last.

    The axis has to be enabled. Ctrl-C stops it; it stays enabled.
    """
    if not wait and len(angles_deg) > 1:
        raise InputError("--no-wait goes to one angle: give one, or use 'hdbridge ctl queue'")
    with moving(at, axis, force=force) as moved:
        state = moved.state()
        note_clamped(state.limits, velocity_deg_s=velocity_deg_s, acceleration_deg_s2=acceleration_deg_s2)
        before_deg = state.load_target_deg or 0.0
        for given_deg in angles_deg:
            before_deg = before_deg + given_deg if relative else given_deg
            state = moved.move(
                before_deg,
                velocity_deg_s=velocity_deg_s,
                acceleration_deg_s2=acceleration_deg_s2,
                wait=wait,
            )
            tell(state, json_file if given_deg is angles_deg[-1] else None)


def jog(
    axis: AxisArgument,
    velocity_deg_s: Annotated[
        float, typer.Argument(metavar="SPEED", help="Speed of the load, deg/s, with sign.")
    ],
    duration_s: Annotated[
        float, typer.Option("--for", min=0.05, max=86_400.0, help="Time, s; Ctrl-C ends it earlier.")
    ] = 1.0,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Turn an axis at a speed for a time, then brake to rest; also if this command is killed."""
    with moving(at, axis, force=force) as moved:
        note_clamped(moved.state().limits, velocity_deg_s=velocity_deg_s)
        moved.jog(velocity_deg_s, duration_s)
        tell(moved.rest(), json_file)


def queue(
    axis: AxisArgument,
    angles_deg: Annotated[
        list[float] | None, typer.Argument(metavar="ANGLE...", help="Load angles in degrees.")
    ] = None,
    velocity_deg_s: VelocityOption = None,
    acceleration_deg_s2: AccelerationOption = None,
    dwell_s: Annotated[float, typer.Option("--dwell", min=0.0, max=86_400.0, help="Rest at each, s.")] = 0.0,
    clear: Annotated[
        bool,
        typer.Option("--clear", help="Remove the way points not yet begun; add none."),
    ] = False,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Append way points, and wait until the last one is reached. Ctrl-C stops the axis."""
    from hdbridge.client.messages import QueueItem

    if clear == bool(angles_deg):
        raise InputError("expected either angles or --clear")
    if clear:
        with connected(at) as client, client.lease(force=force):
            tell(client.axis(axis).clear_queue(), json_file)
        return
    limits = {"velocity_deg_s": velocity_deg_s, "acceleration_deg_s2": acceleration_deg_s2}
    points = [QueueItem.given(target_deg=each, dwell_s=dwell_s, **limits) for each in angles_deg or ()]
    with connected(at) as client, client.lease(force=force), stopped_by_signals(client, axis):
        note_clamped(client.axis(axis).state().limits, **limits)
        tell(client.axis(axis).queue(points), json_file)
