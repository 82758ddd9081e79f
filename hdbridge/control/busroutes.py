"""Which axes can share a bus, and which identifier is whose. Pure.

One cycle, one master, and no identifier twice. What a turn of the bus has to know of its axes is sorted here
once, whenever an axis begins, falls silent or is stopped, so that the turn looks up and decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hdbridge.drive.busload import FRAME_BITS
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.control.axiscycle import AxisCycle


Slot = tuple[int, Callable[[bytes], None], "AxisCycle"]
"""One TPDO of a turn: its bit among those of the turn, what takes its data (`PdoLengthError` where the length
is wrong), and whose it is. A plain tuple, which is unpacked in a third of the time of a named one."""


class Routes(NamedTuple):
    """Who is on the bus, and whose each identifier is."""

    speaking: tuple[AxisCycle, ...]
    listening: tuple[AxisCycle, ...]
    """Those that are silent."""
    slots: dict[int, Slot]
    """The TPDOs that may come with every SYNC."""
    listeners: dict[int, AxisCycle]
    """Whom any other frame concerns."""
    awaited: int
    """The bits of the TPDOs for which a turn waits."""
    bits: int
    """Most bits that SYNC, the awaited TPDOs and the RPDOs take on the wire."""


def routes(axes: Sequence[AxisCycle]) -> Routes:
    """The routes as the axes are now; sets what each needs of a turn."""
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
    """InputError that names both sides where these axes cannot run in one cycle of ``period_s``."""
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
    """A drive whose identifiers cannot be changed need not make them of its node id."""
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
    """Nearly all identifiers of an axis are made of node ids, so these must differ."""
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
