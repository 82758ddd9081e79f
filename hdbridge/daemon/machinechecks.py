"""Consistency checks between the axes of one machine, with the place of each error. Opens nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from hdbridge.axis import AxisConfig, BusConfig
from hdbridge.daemon.machinefile import MachineFile, token_complaint
from hdbridge.drive.busload import check_bus_load
from hdbridge.drive.link import unknown_interface
from hdbridge.errors import InputError
from hdbridge.files.yamlfile import Document, Location

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Axis

T = TypeVar("T")


class Places:
    """Source of error messages about a machine file, or about the axis file that replaces it."""

    def __init__(self, path: Path, document: Document | None) -> None:
        self._path, self._document = path, document
        self.folder = path.parent

    def error(self, at: Location, message: str) -> InputError:
        if self._document is None:
            return InputError(f"{self._path}: {message}")
        return self._document.error(at, message)

    def where(self, at: Location) -> str:
        """Returns ``line 5`` of the file, for reference in another message."""
        return f"line {self._document.position(at)[0]}" if self._document is not None else str(self._path)


def agreed(axes: Sequence[Axis], ask: Callable[[AxisConfig], T], places: Places, key: str) -> T:
    """Returns the common value of all axis files; raises InputError if they differ."""
    first = ask(axes[0].config)
    for number, axis in enumerate(axes[1:], start=1):
        if ask(axis.config) != first:
            raise places.error(
                ("axes", number, "profile"),
                f"{axis.config.where(key)}: differs from that of '{axes[0].name}' "
                f"({axes[0].config.where(key)}); expected the same in both, or '{key}' in the machine file",
            )
    return first


def check_together(axes: Sequence[Axis], places: Places) -> None:
    """Checks that all axes have the same SYNC and master, and unique names and node ids.

    PDO identifiers follow from the node ids, so they are unique as well.
    """
    names: dict[str, int] = {}
    nodes: dict[int, str] = {}
    first = axes[0].config
    for number, axis in enumerate(axes):
        at = ("axes", number, "profile")
        config = axis.config
        if (other := names.setdefault(axis.name, number)) != number:
            raise places.error(
                at,
                f"an axis '{axis.name}' stands in {places.where(('axes', other))} already; expected another "
                f"name in {config.where('name')}",
            )
        for key in ("cycle_ms", "master_node_id"):
            found, expected = getattr(config.drive, key), getattr(first.drive, key)
            if found != expected:
                raise places.error(
                    at,
                    f"{config.where(f'drive.{key}')}: found {found:g}; expected {expected:g}, as of "
                    f"'{first.name}': one master sends one SYNC to all axes",
                )
        for node, key in _nodes(config):
            if (owner := nodes.setdefault(node, axis.name)) != axis.name:
                raise places.error(
                    at, f"{config.where(key)}: node {node} is of '{owner}' already; expected another node id"
                )


def _nodes(config: AxisConfig) -> Iterator[tuple[int, str]]:
    yield config.drive.node_id, "drive.node_id"
    if config.load_encoder.source.node is not None:
        yield config.load_encoder.source.node, "load_encoder.source.node"


def check_load(axes: Sequence[AxisConfig], bus: BusConfig, places: Places) -> None:
    """Checks that the frames of a cycle fit into it."""
    try:
        check_bus_load(axes, bus.bitrate_bps)
    except InputError as problem:
        raise places.error(("axes",), str(problem)) from None


def check_gateway(file: MachineFile, axes: Sequence[Axis], bus: BusConfig, places: Places) -> None:
    """Known axes, one node id each, a bus of its own, and positions that fit into an int32."""
    gateway = file.gateway
    if gateway is None:
        return
    outer = gateway.bus
    if (outer.interface, str(outer.channel)) == (bus.interface, str(bus.channel)):
        raise places.error(
            ("gateway", "bus"),
            f"{outer.interface}:{outer.channel} is the bus of the drives; expected another one, on which the "
            "other master is",
        )
    known = {axis.name: axis.config for axis in axes}
    nodes: dict[int, str] = {}
    for name, node in gateway.nodes.items():
        at = ("gateway", "nodes", name)
        if name not in known:
            raise places.error(at, f"no axis '{name}'; expected one of: {', '.join(known)}")
        if (owner := nodes.setdefault(node, name)) != name:
            raise places.error(at, f"node {node} is '{owner}' already; expected another node id")
        limits = known[name].limits
        farthest = max(abs(limits.position_min_deg), abs(limits.position_max_deg)) / 360.0
        if farthest * gateway.counts_per_turn >= 1 << 31:
            raise places.error(
                ("gateway",),
                f"{gateway.counts_per_turn} counts_per_turn: the limits of '{name}' do not fit into 32 bits; "
                f"expected at most {int((1 << 31) / farthest) - 1}",
            )


def check_interfaces(file: MachineFile, places: Places) -> None:
    """Checks that python-can has the interfaces of the file."""
    gateway = file.gateway
    for at, bus in ((("bus",), file.bus), (("gateway", "bus"), gateway.bus if gateway else None)):
        if bus is not None and (unknown := unknown_interface(bus.interface)):
            raise places.error((*at, "interface"), unknown)


def check_tcp(file: MachineFile, places: Places) -> None:
    """Checks that the token file exists and only its owner can read it."""
    tcp = file.api.tcp
    if tcp is None:
        return
    if complaint := token_complaint(places.folder / tcp.token_file):
        raise places.error(("api", "tcp", "token_file"), complaint)
