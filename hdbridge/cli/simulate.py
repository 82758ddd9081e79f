"""``hdbridge simulate``: the simulated drive on its own, in real time, on any bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.interrupt import deferred_interrupt
from hdbridge.cli.options import (
    ChannelOption,
    GatewayAxisOption,
    InterfaceOption,
    ProfileArgument,
    SeedOption,
    TruthOption,
    note,
)
from hdbridge.cli.session import Session, simulated_by
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.errors import BusInUseError, InputError

if TYPE_CHECKING:
    import can

    from hdbridge.axis import BusConfig
    from hdbridge.device.node import DriveNode

    Maker = Callable[[can.BusABC, Clock, Path], DriveNode]


def command(
    profile: ProfileArgument,
    truth: TruthOption = None,
    seed: SeedOption = 0,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    gateway: Annotated[
        bool,
        typer.Option(
            "--gateway",
            help="PROFILE is a machine: an ideal drive with the bus and objects of its gateway.",
        ),
    ] = False,
    axis: GatewayAxisOption = None,
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
    from hdbridge.device.run import run
    from hdbridge.drive.link import open_bus

    if gateway and (truth, interface, channel) != (None, None, None):
        raise InputError(
            "--gateway: the drive is ideal and its bus is the gateway's; leave out --truth, --interface and "
            "--channel"
        )
    if axis and not gateway:
        raise InputError("--axis: names an axis of a gateway; add --gateway, or leave it out")
    name, config, make = (
        _ideal(profile, axis) if gateway else _simulated(profile, truth, seed, interface, channel)
    )
    clock = MonotonicClock()
    with (
        deferred_interrupt() as interrupted,
        open_bus(config, shared=True) as bus,
        TemporaryDirectory(prefix="hdbridge-gateway-") as folder,
    ):
        node = make(bus, clock, Path(folder))
        _refuse_another(bus, clock, node.node_id)
        note(f"{name} drive: node {node.node_id} on {bus.channel_info}; Ctrl-C ends it")
        end = float("inf") if duration_s is None else clock.now() + duration_s
        run(bus, node, clock, lambda: interrupted() or clock.now() >= end)


def _refuse_another(bus: can.BusABC, clock: Clock, node_id: int) -> None:
    """Raises `BusInUseError` if another node with this id answers a request or sends frames of its own."""
    from hdbridge.drive.link import Link
    from hdbridge.drive.manners import listening_s
    from hdbridge.drive.objects import COB_SDO_REQUEST

    link = Link(bus, clock)
    # SDO upload of 1000h, which every node has
    link.send(COB_SDO_REQUEST + node_id, b"\x40\x00\x10\x00\0\0\0\0")
    end_s = clock.now() + listening_s()
    while (frame := link.recv(end_s)) is not None:
        if frame.can_id & 0x7F == node_id and frame.can_id >> 7 in (0x1, 0x3, 0x5, 0x7, 0x9, 0xB, 0xE):
            raise BusInUseError(
                f"{link.name}: a node {node_id} is on this bus already ({frame.can_id:03X}h); stop it first"
            )


def _simulated(
    profile: str, truth: Path | None, seed: int, interface: str | None, channel: str | None
) -> tuple[str, BusConfig, Maker]:
    from hdbridge.device.node import DriveNode
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

    def make(bus: can.BusABC, clock: Clock, _: Path) -> DriveNode:
        plate = nameplate_of(known, load_object=axis.load_encoder.source.address)
        return DriveNode(
            bus, Machine(known, seed), axis.eds_path, axis.drive.node_id, clock, plate, known.firmware,
            bit_rate_bps=axis.bus.bitrate_bps,
        )  # fmt: skip

    return "simulated", axis.bus, make


def _ideal(machine: str, name: str | None) -> tuple[str, BusConfig, Maker]:
    from hdbridge.cli.gateway import gateway_axis
    from hdbridge.daemon.gateway.ideal import IdealAxis
    from hdbridge.daemon.gateway.objects import nameplate, write_eds
    from hdbridge.daemon.gateway.slave import BEHAVIOUR
    from hdbridge.device.node import DriveNode

    axis, settings, model = gateway_axis(machine, name)

    def make(bus: can.BusABC, clock: Clock, folder: Path) -> DriveNode:
        plate = nameplate(axis, settings)
        plant = IdealAxis(axis.gear.ratio * plate.load_counts_per_turn / plate.motor_counts_per_turn)
        return DriveNode(
            bus, plant, write_eds(folder, axis, settings, model), settings.nodes[axis.name], clock, plate,
            BEHAVIOUR, bit_rate_bps=settings.bus.bitrate_bps,
        )  # fmt: skip

    return "ideal", settings.bus, make
