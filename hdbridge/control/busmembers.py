"""Which axes can share a bus: one cycle, one master, and no identifier twice. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.control.axiscycle import AxisCycle


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


def _check_nodes(axes: Sequence[AxisCycle]) -> None:
    """All identifiers of an axis are made of node ids, so it is these that must differ."""
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
