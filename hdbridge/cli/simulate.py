"""``hdbridge simulate``: the simulated drive on its own, in real time, on any bus."""

from __future__ import annotations

from typing import Annotated

import typer

from hdbridge.cli.interrupt import deferred_interrupt
from hdbridge.cli.options import (
    ChannelOption,
    InterfaceOption,
    ProfileArgument,
    SeedOption,
    TruthOption,
    notes,
)
from hdbridge.cli.session import Session, simulated_by
from hdbridge.clock import MonotonicClock
from hdbridge.errors import InputError


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("simulate")(simulate)


def simulate(
    profile: ProfileArgument,
    truth: TruthOption = None,
    seed: SeedOption = 0,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", min=0.0, help="Stop after this time, s; else at Ctrl-C."),
    ] = None,
) -> None:
    """Run the simulated drive of a profile on its bus, in real time, until Ctrl-C.

    Another process masters it, for example over SocketCAN:

        hdbridge simulate article --interface socketcan --channel vcan0 &

        hdbridge step article --interface socketcan --channel vcan0
    """
    from hdbridge.device.node import DriveNode
    from hdbridge.device.run import run
    from hdbridge.drive.link import open_bus
    from hdbridge.sim.lockstep import nameplate_of
    from hdbridge.sim.machine import Machine
    from hdbridge.sim.truth import Truth

    session = Session(profile, interface=interface, channel=channel)
    axis = session.axis
    if axis.bus.interface == "virtual":
        raise InputError(
            "the bus 'virtual' exists within one process only, so the simulated drive cannot be reached; "
            "give --interface udp_multicast --channel 239.0.0.1, or socketcan, "
            "or use 'hdbridge step --simulate'"
        )
    known = Truth.load(simulated_by(session.files, truth))
    clock = MonotonicClock()
    with deferred_interrupt() as interrupted, open_bus(axis.bus, shared=True) as bus:
        nameplate = nameplate_of(known, load_object=axis.load_encoder.source.address)
        node = DriveNode(
            bus,
            Machine(known, seed),
            axis.eds_path,
            axis.drive.node_id,
            clock,
            nameplate,
            known.firmware,
            bit_rate_bps=axis.bus.bitrate_bps,
        )
        notes.print(f"simulated drive: node {axis.drive.node_id} on {bus.channel_info}; Ctrl-C ends it")
        end = float("inf") if duration_s is None else clock.now() + duration_s
        run(bus, node, clock, lambda: interrupted() or clock.now() >= end)
