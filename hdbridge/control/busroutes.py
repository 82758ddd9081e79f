"""Routing of identifiers to the axes of a bus, and the check that axes can share a bus. Pure.

All axes have one cycle and one master, and no identifier is used twice. The routes are computed whenever an
axis begins, falls silent or is stopped, so that a turn only looks them up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hdbridge.drive.busload import FRAME_BITS
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.control.axiscycle import AxisCycle


Slot = tuple[int, Callable[[bytes], None], "AxisCycle"]
"""One TPDO of a turn: its bit among those of the turn, the function that takes its data
(`PdoLengthError` if the length is wrong), and its axis. A plain tuple unpacks in a third of the time
of a named one."""


class Routes(NamedTuple):
    """Axes on the bus, and the axis of each identifier."""

    speaking: tuple[AxisCycle, ...]
    listening: tuple[AxisCycle, ...]
    """Silent axes."""
    slots: dict[int, Slot]
    """TPDOs that may come with every SYNC, by identifier."""
    listeners: dict[int, AxisCycle]
    """Axes that receive all other frames, by identifier."""
    awaited: int
    """Bits of the TPDOs that a turn waits for."""
    bits: int
    """Maximum number of bits that SYNC, the awaited TPDOs and the RPDOs take on the wire."""


def routes(axes: Sequence[AxisCycle]) -> Routes:
    """Returns the routes for the present states of the axes; also sets ``needed`` of each axis."""
    slots: dict[int, Slot] = {}
    listeners: dict[int, AxisCycle] = {}
    awaited, bits = 0, FRAME_BITS[0]
    for axis in axes:
        image = axis.image
        tpdos, channels = axis.route()
        axis.needed = 0
        for can_id in (*tpdos, *channels):
            bit = 1 << len(slots)
            slots[can_id] = (bit, image.handler(can_id), axis)
            if can_id in tpdos:
                axis.needed |= bit
            if axis.awaited:
                awaited |= bit
                bits += FRAME_BITS[image.length_of(can_id)]
        if not axis.silent:
            bits += sum(FRAME_BITS[layout.codec.length] for layout in image.rpdos)
        listeners.update(dict.fromkeys(axis.identifiers, axis))
    return Routes(
        tuple(axis for axis in axes if not axis.silent),
        tuple(axis for axis in axes if axis.silent),
        slots,
        listeners,
        awaited,
        bits,
    )


def check_members(axes: Sequence[AxisCycle], period_s: float) -> None:
    """Raises InputError, naming both axes, if these cannot share one cycle of ``period_s``."""
    for axis in axes:
        config = axis.image.axis
        if config.drive.cycle_s != period_s:
            raise InputError(
                f"{config.where('drive.cycle_ms')}: {config.drive.cycle_ms:g} ms, but the bus runs at "
                f"{1e3 * period_s:g} ms; all axes on one bus have one cycle"
            )
        first = axes[0].image.axis
        if config.drive.master_node_id != first.drive.master_node_id:
            raise InputError(
                f"{config.where('drive.master_node_id')}: {config.drive.master_node_id}, but "
                f"{first.where('drive.master_node_id')} has {first.drive.master_node_id}; "
                "a bus has one master with one heartbeat"
            )
    _check_nodes(axes)
    _check_identifiers(axes)


def _check_identifiers(axes: Sequence[AxisCycle]) -> None:
    """Checks that no identifier is used twice; fixed identifiers need not derive from the node id."""
    owners: dict[int, AxisCycle] = {}
    for axis in axes:
        image = axis.image
        for layout in (*image.tpdos, *image.channel_tpdos, *image.rpdos):
            other = owners.setdefault(layout.can_id, axis)
            if other is not axis:
                raise InputError(
                    f"{image.axis.where('drive.eds')} of '{axis.name}' and "
                    f"{other.image.axis.where('drive.eds')} of '{other.name}' both have a PDO with the "
                    f"identifier {layout.can_id:03X}h; put one of the drives on another bus"
                )


def _check_nodes(axes: Sequence[AxisCycle]) -> None:
    """Checks that node ids differ, because nearly all identifiers derive from them."""
    owners: dict[int, tuple[AxisCycle, str]] = {}
    for axis in axes:
        config = axis.image.axis
        nodes = {config.drive.node_id: "drive.node_id"}
        encoder = config.load_encoder.source.node
        if encoder is not None:
            nodes.setdefault(encoder, "load_encoder.source.node")
        for node_id, field in nodes.items():
            taken = owners.get(node_id)
            if taken is not None:
                other, others_field = taken
                raise InputError(
                    f"{config.where(field)} of '{axis.name}' and {other.image.axis.where(others_field)} of "
                    f"'{other.name}' are both node {node_id}: their frames would have the same identifiers; "
                    "give each node of the bus an id of its own"
                )
            owners[node_id] = axis, field
    for axis in axes:
        drive = axis.image.axis.drive
        taken = owners.get(drive.master_node_id)
        if taken is not None:
            other, others_field = taken
            raise InputError(
                f"{axis.image.axis.where('drive.master_node_id')} of '{axis.name}' and "
                f"{other.image.axis.where(others_field)} of '{other.name}' are both node "
                f"{drive.master_node_id}; give the master an id of its own"
            )
