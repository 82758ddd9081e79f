"""``hdbridge reset``: resets a fault of the drive."""

from __future__ import annotations

import typer

from hdbridge.cli.options import (
    ChannelOption,
    ForceOption,
    InterfaceOption,
    JsonOption,
    ProfileArgument,
    SeedOption,
    SimulateOption,
    TruthOption,
    connected,
    console,
    load_axis,
    write_json,
)
from hdbridge.files.profile import Profile


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("reset")(reset)


def reset(
    profile: ProfileArgument,
    simulate: SimulateOption = False,
    truth: TruthOption = None,
    seed: SeedOption = 0,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    force: ForceOption = False,
    json_file: JsonOption = None,
) -> None:
    """Reset a fault of the drive when its cause is gone; power stays off.

    Boots the drive, prints the error code and the last emergency, and resets the fault. It moves nothing. A
    fault that comes back at once is an error (exit status 4): its cause is still there. A drive that a daemon
    holds is reset with `hdbridge ctl reset`.
    """
    from hdbridge.drive.drive import Drive
    from hdbridge.drive.states import State

    files = Profile.find(profile)
    axis = load_axis(files, interface, channel, simulate=simulate)
    with (
        connected(axis, files, simulate=simulate, truth=truth, seed=seed, force=force) as (bus, clock),
        Drive(bus, axis, clock, force=force) as drive,
    ):
        drive.boot()
        faulty = drive.state() is State.FAULT
        fault = drive.fault_reset() if faulty else None
        state = drive.state()
    write_json(
        json_file,
        {"schema": "hdbridge.reset/1", "axis": axis.name, "fault": fault, "state": state.value},
    )
    done = f"the fault is reset ({fault})" if faulty else "there is no fault to reset"
    console.print(f"{done}: the drive is in '{state.value}'", markup=False, soft_wrap=True)
