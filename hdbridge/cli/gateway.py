"""``hdbridge gateway``: the axes of a machine as drives of another master."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import MachineArgument, notes
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.daemon.machinefile import GatewaySettings


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(
        help="The axes of a machine as drives of another master.",
        no_args_is_help=True,
        rich_markup_mode="markdown",
    )
    group.command("eds")(eds)
    group.command("simulate")(simulate)
    app.add_typer(group, name="gateway")


AxisOption = Annotated[
    str | None, typer.Option("--axis", help="Which axis, if the gateway has several.", show_default=False)
]


def eds(machine: MachineArgument, axis: AxisOption = None) -> None:
    """Print the EDS of an axis on the gateway's bus, for the tool that configures the other master.

    hdbridge gateway eds cell > axis1.eds
    """
    from hdbridge.daemon.gateway.objects import eds as text_of

    typer.echo(text_of(*gateway_axis(machine, axis)), nl=False)


def simulate(
    machine: MachineArgument,
    axis: AxisOption = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", min=0.0, help="Stop after this many seconds; without it at Ctrl-C."),
    ] = None,
) -> None:
    """Run an ideal drive in place of the gateway, in real time, until Ctrl-C.

    It has the bus, node id and objects of the gateway, and its load is where it was asked for. It needs no
    daemon and no other drive, so it serves the tests of another master's program.
    """
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from hdbridge.cli.interrupt import deferred_interrupt
    from hdbridge.clock import MonotonicClock
    from hdbridge.daemon.gateway.ideal import IdealAxis
    from hdbridge.daemon.gateway.objects import eds as text_of
    from hdbridge.daemon.gateway.objects import nameplate
    from hdbridge.daemon.gateway.slave import BEHAVIOUR
    from hdbridge.device.node import DriveNode
    from hdbridge.device.run import run
    from hdbridge.drive.link import open_bus

    config, settings = gateway_axis(machine, axis)
    plate, node_id, clock = nameplate(config, settings), settings.nodes[config.name], MonotonicClock()
    scale = config.gear.ratio * plate.load_counts_per_turn / plate.motor_counts_per_turn
    with (
        deferred_interrupt() as interrupted,
        open_bus(settings.bus, shared=True) as bus,
        TemporaryDirectory(prefix="hdbridge-gateway-") as folder,
    ):
        path = Path(folder) / "gateway.eds"
        path.write_text(text_of(config, settings), encoding="utf-8")
        node = DriveNode(bus, IdealAxis(scale), path, node_id, clock, plate, BEHAVIOUR)
        notes.print(f"ideal drive: node {node_id} on {bus.channel_info}; Ctrl-C ends it")
        end = float("inf") if duration_s is None else clock.now() + duration_s
        run(bus, node, clock, lambda: interrupted() or clock.now() >= end)


def gateway_axis(machine: str, name: str | None) -> tuple[AxisConfig, GatewaySettings]:
    """An axis of a machine's gateway, and the gateway; InputError if it has none, or the name is needed."""
    from hdbridge.daemon.machine import Machine

    found = Machine.find(machine)
    if found.gateway is None:
        raise InputError(
            f"{found.path}: has no gateway; expected a machine file with a key 'gateway' (docs/gateway.md)"
        )
    names = [*found.gateway.nodes]
    if name is None and len(names) > 1:
        raise InputError(
            f"{found.path}: the gateway has several axes; give --axis with one of: {', '.join(names)}"
        )
    if name is not None and name not in names:
        raise InputError(f"--axis {name}: is not in the gateway; expected one of: {', '.join(names)}")
    return found.axis(name or names[0]).config, found.gateway
