"""``hdbridge new``: a new profile folder."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import (
    BitrateOption,
    ChannelOption,
    EdsOption,
    InterfaceOption,
    JsonOption,
    NodeOption,
    note,
    say,
    write_json,
)
from hdbridge.clock import MonotonicClock
from hdbridge.errors import DriveError, InputError

if TYPE_CHECKING:
    from hdbridge.commissioning.bringup.scan import Node


class Source(Enum):
    """Origin of a new profile."""

    DEMO = "demo"
    ARTICLE = "article"
    SCAN = "scan"


def command(
    name: Annotated[Path, typer.Argument(metavar="NAME", help="New folder; its name is the axis's.")],
    source: Annotated[
        Source,
        typer.Option("--from", help="Bundled profile to copy, or the drive that answers on a bus."),
    ] = Source.DEMO,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bitrate_bps: BitrateOption = None,
    node_id: NodeOption = None,
    eds: EdsOption = None,
    json_file: JsonOption = None,
) -> None:
    """Make the folder of an axis: a copy of a bundled profile, or from the data of a drive on the bus.

    With `--from scan --interface socketcan --channel can0` the axis file has the identity, encoders and gear
    that the drive reports; missing values are marked, and `hdbridge check` stops there. Nothing moves.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.commissioning.bringup.newprofile import copy_bundled

    if source is Source.SCAN:
        written = _scanned(name, interface, channel, bitrate_bps, node_id, eds)
    else:
        given = {"--interface": interface, "--channel": channel, "--node": node_id, "--eds": eds}
        for option, value in given.items():
            if value is not None:
                raise InputError(f"{option} says where to scan: give --from scan with it, or leave it out")
        written = copy_bundled(source.value, name)
    write_json(json_file, {"schema": "hdbridge.new/1", "files": [str(each) for each in written]})
    for each in written:
        say(f"wrote {each}")
    try:
        AxisConfig.load(name)
    except InputError as problem:
        say(f"to be completed: {problem}")
    say(f"next: hdbridge check {name}")


def _scanned(
    folder: Path,
    interface: str | None,
    channel: str | None,
    bitrate_bps: int | None,
    node_id: int | None,
    eds: Path | None,
) -> list[Path]:
    from hdbridge.axis import BusConfig
    from hdbridge.commissioning.bringup.newprofile import write_scanned
    from hdbridge.commissioning.bringup.scan import scan_bus
    from hdbridge.drive.link import Link, open_bus

    if interface is None or channel is None:
        raise InputError("--from scan needs a bus: give --interface and --channel (socketcan, can0)")
    bus = BusConfig(interface=interface, channel=channel, bitrate_bps=bitrate_bps)
    with open_bus(bus) as opened:
        note("asking nodes ...")
        link = Link(opened, MonotonicClock())
        found = scan_bus(link)
    return write_scanned(folder, bus, _chosen(link.name, found.nodes, node_id), eds)


def _chosen(bus: str, nodes: tuple[Node, ...], node_id: int | None) -> Node:
    usable = [each for each in nodes if each.usable and node_id in {None, each.node_id}]
    if len(usable) == 1:
        return usable[0]
    there = ", ".join(f"{each.node_id} ({each.kind})" for each in nodes) or "none"
    if not usable:
        raise DriveError(f"{bus}: no CiA-402 drive with CSP answers; found nodes: {there}")
    raise InputError(f"{bus}: several drives answer: {there}; choose one with --node")
