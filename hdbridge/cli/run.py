"""``hdbridge run``: the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli import eventlog
from hdbridge.cli.options import (
    ChannelOption,
    ForceOption,
    InterfaceOption,
    MachineArgument,
    SeedOption,
    need_extra,
)
from hdbridge.cli.session import check_bus_options, simulated_by
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.start import Simulation

_EXTRA = ("fastapi", "uvicorn", "websockets", "mcap", "prometheus_client")
"""Packages of the extra ``daemon``."""


def command(
    machine: MachineArgument,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Hold simulated drives in place of the bus.")
    ] = False,
    speed: Annotated[
        float,
        typer.Option(
            "--speed", min=0.01, max=1000.0, help="With --simulate: speed relative to real time, at most."
        ),
    ] = 1.0,
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            "--truth",
            metavar="TRUTH.yaml",
            help="Truth file of a simulated axis; once for each axis, in order.",
        ),
    ] = None,
    seed: SeedOption = 0,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    page: Annotated[
        bool, typer.Option("--page", help="Serve the live page to this computer and print its address.")
    ] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65_535, help="Port of --page; 0: any.")] = 8402,
    force: ForceOption = False,
) -> None:
    """Run the daemon: hold the drives of a machine and take load angles from clients.

    Nothing moves until a client enables an axis. SIGTERM, Ctrl-C and SIGHUP stop the axes in order and end
    the daemon; a second one stops them at the quick-stop ramp. A drive fault is reported and latched.

    Exit status: 0 ended in order, 1 a process died repeatedly, 2 bad input, 3 the bus cannot be opened or has
    another master, 7 another daemon has the API's address.
    """
    check_bus_options(interface, channel, simulate=simulate)
    need_extra("the daemon needs", _EXTRA, "daemon")
    from hdbridge.daemon.hold import hold
    from hdbridge.daemon.logs import LogSettings
    from hdbridge.daemon.machine import Machine
    from hdbridge.drive.link import check_interface

    held = Machine.find(machine)
    changes = {name: given for name, given in (("interface", interface), ("channel", channel)) if given}
    held = held.on_bus(**changes) if changes else held
    simulation = _simulation(held, truth or [], seed, speed) if simulate else None
    if (gateway := held.gateway) is not None and gateway.bus.interface == "virtual":
        raise InputError(
            f"{held.path}: gateway.bus: 'virtual' reaches no other process; expected the interface "
            "of the other master (socketcan, or udp_multicast without hardware)"
        )
    if simulation is None:
        where = "--interface" if interface else held.axes[0].config.where("bus.interface")
        check_interface(held.bus.interface, where)
        _check_real(held, truth or [], speed)
    log = LogSettings(*eventlog.handed_over())
    raise typer.Exit(hold(held, simulation, force=force, page=port if page else None, log=log))


def _simulation(machine: Machine, truths: list[Path], seed: int, speed: float) -> Simulation:
    from hdbridge.daemon.start import Simulation
    from hdbridge.sim.truth import Truth

    if truths and len(truths) != len(machine.axes):
        names = ", ".join(axis.name for axis in machine.axes)
        raise InputError(f"--truth: given {len(truths)} times; expected once for each of the axes {names}")
    paths = tuple(path.absolute() for path in truths) or tuple(
        simulated_by(axis.profile, None) for axis in machine.axes
    )
    for path in paths:
        Truth.load(path)
    return Simulation(paths, seed, speed)


def _check_real(machine: Machine, truths: list[Path], speed: float) -> None:
    if truths or speed != 1.0:
        raise InputError("--truth and --speed are for simulated axes: give --simulate with them")
    if machine.bus.interface == "virtual":
        raise InputError(
            f"{machine.path}: the bus 'virtual' reaches nothing outside this process; expected the interface "
            "of the bus (socketcan), or give --simulate, which puts simulated drives there"
        )
