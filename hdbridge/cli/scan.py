"""``hdbridge scan``: the nodes on the bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from hdbridge.cli.options import (
    BitrateOption,
    BorrowOption,
    ChannelOption,
    ForceOption,
    InterfaceOption,
    JsonOption,
    SeedOption,
    SimulateOption,
    TruthOption,
    note,
    progress_bar,
    say,
    write_json,
)
from hdbridge.cli.session import Session, bare_bus
from hdbridge.commissioning.bringup import ASK_TIMEOUT_S, LISTEN_S
from hdbridge.errors import DriveError, InputError

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.commissioning.bringup.scan import Node, Scan


def command(
    profile: Annotated[
        str | None,
        typer.Argument(
            metavar="PROFILE",
            help="Axis whose bus is scanned and whose drive is expected. Without it: --interface and "
            "--channel.",
        ),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    force: ForceOption = False,
    borrow: BorrowOption = False,
    bitrate_bps: BitrateOption = None,
    listen_s: Annotated[
        float,
        typer.Option("--listen", min=0.0, max=3600.0, help="Seconds to listen before asking; at least 0.51."),
    ] = LISTEN_S,
    timeout_ms: Annotated[
        float, typer.Option("--timeout-ms", min=1.0, max=5000.0, help="Time for each node id to answer.")
    ] = 1000.0 * ASK_TIMEOUT_S,
    simulate: SimulateOption = False,
    truth: TruthOption = None,
    seed: SeedOption = 0,
    json_file: JsonOption = None,
) -> None:
    """List the nodes on a CAN bus: type, identity, state, and lines for an axis file.

    Listens first, and sends nothing if another master is heard. Then reads a few objects of each node id.
    Writes and enables nothing, and leaves a node alone that another SDO client is talking to.

    Exit status 4 if no node was found, or PROFILE's drive is missing.
    """
    from hdbridge.axis import BusConfig
    from hdbridge.commissioning.bringup.match import compare
    from hdbridge.commissioning.bringup.scan import scan_bus
    from hdbridge.drive.link import Link

    axis = None
    if profile is not None:
        session = Session(profile, simulate, truth, seed, interface, channel, force, borrow)
        axis, opened = session.axis, session.connected()
    elif simulate or interface is None or channel is None:
        raise InputError("scan needs a bus: give a PROFILE, or --interface and --channel (socketcan, can0)")
    else:
        named = BusConfig(interface=interface, channel=channel, bitrate_bps=bitrate_bps)
        opened = bare_bus(named, force=force)
    with opened as (bus, clock), progress_bar() as bar:
        link = Link(bus, clock)
        task = bar.add_task("asking nodes", total=1.0)
        found = scan_bus(
            link,
            listen_s=listen_s,
            timeout_s=timeout_ms / 1000.0,
            force=force,
            progress=lambda share: bar.update(task, completed=share),
        )
    matches, lines = (False, []) if axis is None else compare(axis, found)
    result = _as_dict(link.name, found)
    if axis is not None:
        result["axis"] = {"name": axis.name, "matches": matches, "differences": lines}
    write_json(json_file, result)
    _print(link.name, found)
    if axis is not None:
        _print_match(axis, matches, lines)
    _judge(link.name, found, axis, matches)


def _print(name: str, found: Scan) -> None:
    from hdbridge.commissioning.bringup.match import axis_lines

    count = len(found.nodes)
    say(f"{name}: {count} node{'' if count == 1 else 's'}")
    for node in found.nodes:
        say(f"\nnode {node.node_id}: {node.kind}", style="bold")
        for label, value in _facts(node).items():
            say(f"{label:>12}  {value}")
        if node.usable or node.profile == 406:
            say("  for the axis file:")
            for line in axis_lines(node):
                say(f"    {line}")
    for remark in found.remarks:
        note(f"note: {remark}")


def _facts(node: Node) -> dict[str, str]:
    facts = {"NMT state": node.state}
    if node.device_type is not None:
        facts["device type"] = f"{node.device_type:08X}h"
    if node.identity:
        facts["identity"] = ", ".join(
            f"{name.replace('_', ' ')} {value:#x}" for name, value in node.identity.items()
        )
    facts |= {name: text for name, text in node.names.items() if text}
    if node.modes is not None:
        facts["modes"] = ", ".join(node.mode_names) or "none"
    return facts


def _print_match(axis: AxisConfig, matches: bool, lines: list[str]) -> None:
    if matches:
        say(f"\nnode {axis.drive.node_id} is the drive of {axis.path}")
    for line in lines:
        say(line)


def _judge(name: str, found: Scan, axis: AxisConfig | None, matches: bool) -> None:
    if not found.nodes:
        raise DriveError(
            f"{name}: no node answers; check power, wiring, the termination at both ends (60 ohm between "
            "CAN_H and CAN_L) and that every node has the same bit rate"
        )
    if axis is not None and not matches:
        raise DriveError(f"{name}: the drive of {axis.path} is not among the nodes; see the lines above")


def _as_dict(name: str, found: Scan) -> dict[str, Any]:
    from hdbridge.commissioning.bringup.match import axis_lines

    return {
        "schema": "hdbridge.scan/1",
        "bus": name,
        "nodes": [
            {
                "node_id": node.node_id,
                "answers": node.answers,
                "kind": node.kind,
                "device_type": node.device_type,
                "profile": node.profile,
                "nmt_state": node.nmt_state,
                "state": node.state,
                "identity": node.identity,
                "names": node.names,
                "modes": node.mode_names,
                "usable": node.usable,
                "axis_file": axis_lines(node) if node.usable or node.profile == 406 else [],
            }
            for node in found.nodes
        ],
        "remarks": list(found.remarks),
    }
