"""Routing of identifiers to the axes of a bus, and the check that axes can share a bus. Pure.

All axes have one cycle and one master, and no identifier is used twice. The routes are computed whenever an
axis begins, falls silent or is stopped, so a cycle only looks them up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hdbridge.drive.busload import FRAME_BITS
from hdbridge.drive.layout import layouts

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.control.axiscycle import AxisCycle


Slot = tuple[int, Callable[[bytes], None], "AxisCycle"]
"""One TPDO of a cycle: its bit in the mask of all TPDOs, the function that takes its data (`PdoLengthError`
if the length is wrong), and its axis. A plain tuple is unpacked in a third of the time that a named tuple
takes."""


class Routes(NamedTuple):
    """Axes on the bus, and the axis of each identifier."""

    speaking: tuple[AxisCycle, ...]
    listening: tuple[AxisCycle, ...]
    """Axes to which no RPDO is sent."""
    slots: dict[int, Slot]
    """TPDOs that may come with each SYNC, by identifier."""
    listeners: dict[int, AxisCycle]
    """Axes that receive all other frames, by identifier."""
    awaited: int
    """Bits of the TPDOs that a cycle waits for."""
    bits: int
    """Maximum number of bits that SYNC, the awaited TPDOs and the RPDOs take on the wire."""


def routes(axes: Sequence[AxisCycle]) -> Routes:
    """Returns the routes for the current states of the axes; also sets each axis's ``needed``."""
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


def conflict(axes: Sequence[AxisConfig]) -> tuple[int, str] | None:
    """Returns the first axis that cannot share a bus with those before it, and the reason."""
    first = axes[0]
    nodes: dict[int, tuple[AxisConfig, str]] = {first.drive.master_node_id: (first, "drive.master_node_id")}
    owners: dict[int, AxisConfig] = {}
    for place, axis in enumerate(axes):
        for key in ("cycle_ms", "master_node_id"):
            found, expected = getattr(axis.drive, key), getattr(first.drive, key)
            if found != expected:
                return place, (
                    f"{axis.where(f'drive.{key}')}: found {found:g}; expected {expected:g}, as of "
                    f"'{first.name}': one master sends one SYNC to all axes"
                )
        for node, key in ((axis.drive.node_id, "drive.node_id"), *_encoder_node(axis)):
            other, other_key = nodes.setdefault(node, (axis, key))
            if other is not axis or other_key == "drive.master_node_id":
                return place, (
                    f"{axis.where(key)} of '{axis.name}': node {node} is {other.where(other_key)} of "
                    f"'{other.name}' already; expected another node id"
                )
        pdos = layouts(axis)
        for layout in (*pdos.cyclic, *pdos.channels, *pdos.rpdos):
            owner = owners.setdefault(layout.can_id, axis)
            if owner is not axis:
                return place, (
                    f"{axis.where('drive.eds')} of '{axis.name}' and {owner.where('drive.eds')} of "
                    f"'{owner.name}' both have a PDO with the identifier {layout.can_id:03X}h; put one of "
                    "the drives on another bus"
                )
    return None


def _encoder_node(axis: AxisConfig) -> tuple[tuple[int, str], ...]:
    node = axis.load_encoder.source.node
    return () if node in {None, axis.drive.node_id} else ((node, "load_encoder.source.node"),)
