"""What the boot-up writes into the drive, as a list that a person can read before it happens. Pure.

Every row says which object gets which value, why, and which field of the axis file it comes from. The
boot-up writes the rows in order and reads each one back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hdbridge.drive import objects
from hdbridge.drive.channels import channel_complaints
from hdbridge.drive.image import (
    Layout,
    channel_layouts,
    position_limits_counts,
    rpdo_layout,
    tpdo_layouts,
)
from hdbridge.drive.objects import PDO_INVALID, Address, IntegerType
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

    from hdbridge.axis import AxisConfig

SYNCHRONOUS: Final = 1
"""Transmission type: sent, or put into force, at every SYNC."""
RPDO_TIMEOUT_CYCLES: Final = 4
"""The drive gives up on the master after this many cycles without a set-point (and not before 10 ms)."""
_PDOS_PER_KIND: Final = 512
_COB_COMPARED: Final = PDO_INVALID | 0x7FF
_EVERYTHING: Final = -1
_REQUIRED: Final = frozenset((each.index, each.sub) for each in objects.REQUIRED)
_NAMED: Final = 4
"""Objects that are named of those that are lacking."""

# Option codes that no field of the axis file chooses: braked rather than coasting wherever CiA 402 offers it.
SHUTDOWN_DISABLES: Final = 0
DISABLE_SLOWS_DOWN: Final = 1
FAULT_QUICK_STOPS: Final = 2
LOST_MASTER_QUICK_STOPS: Final = 3
ERROR_LEAVES_OPERATIONAL: Final = 0


@dataclass(frozen=True, slots=True)
class PlannedWrite:
    """One object to be written and read back."""

    node_id: int
    index: int
    sub: int
    value: int
    why: str
    field: str = ""
    """Field of the axis file that decides the value; empty where none does."""
    type: IntegerType | None = None
    """Integer type; None where the EDS or the profile says it."""
    compared: int = _EVERYTHING
    """Bits that must read back as written."""
    kept: int = 0
    """Bits that stay as the drive has them."""

    def __str__(self) -> str:
        """``605Ah:00 = 6 (6h): what a quick stop does [drive.quick_stop_option]``."""
        source = f" [{self.field}]" if self.field else ""
        return f"{self.index:04X}h:{self.sub:02X} = {self.value} ({self.value:X}h): {self.why}{source}"


def plan(axis: AxisConfig, od: ObjectDictionary | None = None) -> list[PlannedWrite]:
    """All writes of a boot-up in order, for the drive and a load encoder that is a node of its own.

    With the drive's object dictionary ``od``, objects that a drive need not have are left out where it has
    none (`left_out`), and its other PDOs are disabled. Raises `InputError` where a value of the axis file
    cannot be expressed in its object, or the dictionary lacks what the control cycle or the axis file needs.
    """
    rows = _rows(axis, od)
    if od is not None:
        _check_dictionary(axis, od, rows)
    return [row for row, optional in rows if not (optional and _lacks(axis, od, row))]


def left_out(axis: AxisConfig, od: ObjectDictionary) -> list[PlannedWrite]:
    """The writes that `plan` leaves out because the dictionary lacks their objects."""
    return [row for row, optional in _rows(axis, od) if optional and _lacks(axis, od, row)]


def _rows(axis: AxisConfig, od: ObjectDictionary | None) -> list[_Row]:
    return [*_heartbeats(axis), *_pdos(axis, od), *_cycle(axis), *_options(axis), *_limits(axis)]


def _lacks(axis: AxisConfig, od: ObjectDictionary | None, row: PlannedWrite) -> bool:
    return od is not None and row.node_id == axis.drive.node_id and not _has(od, row.index, row.sub)


def _check_dictionary(axis: AxisConfig, od: ObjectDictionary, rows: list[_Row]) -> None:
    """`InputError` where the dictionary lacks an object that there is no doing without."""
    lacking = [str(each) for each in objects.REQUIRED if not _has(od, each.index, each.sub)]
    lacking += [
        f"{row.index:04X}h:{row.sub:02X}"
        for row, optional in rows
        if not optional and (row.index, row.sub) not in _REQUIRED and _lacks(axis, od, row)
    ]
    if lacking:
        lacking = list(dict.fromkeys(lacking))
        more = f" and {len(lacking) - _NAMED} more" if len(lacking) > _NAMED else ""
        raise InputError(
            f"{axis.where('drive.eds')}: {axis.drive.eds} lacks {', '.join(lacking[:_NAMED])}{more}, which "
            "hdbridge cannot do without; expected the EDS file of this drive, with all of its objects"
        )
    if complaints := channel_complaints(axis, od):
        raise InputError(complaints[0])


def _has(od: ObjectDictionary, index: int, sub: int) -> bool:
    entry = od.get(index)
    members = getattr(entry, "subindices", None)
    return entry is not None and (sub in members if members is not None else sub == 0)


_Row = tuple[PlannedWrite, bool]
"""A write, and whether a drive may lack the object."""


def _row(
    axis: AxisConfig, address: Address, value: int, why: str, field: str = "", *, optional: bool = False
) -> _Row:
    kind = address.type
    if not kind.minimum <= value <= kind.maximum:
        raise InputError(
            f"{axis.where(field)} gives {value} for object {address}, outside [{kind.minimum}, "
            f"{kind.maximum}]; "
            "choose a value that the object can hold"
        )
    return PlannedWrite(axis.drive.node_id, address.index, address.sub, value, why, field), optional


def master_heartbeat(axis: AxisConfig) -> int:
    """Value of 1016h: whose heartbeat the drive watches, and for how long it may stay away."""
    return axis.drive.master_node_id << 16 | axis.drive.heartbeat_ms


def set_point_timeout_ms(axis: AxisConfig) -> int:
    """Value of 1400h:05: for how long set-points may stay away."""
    return max(math.ceil(RPDO_TIMEOUT_CYCLES * axis.drive.cycle_ms), 10)


def drives_patience_s(axis: AxisConfig) -> float:
    """For how long a drive with all its watchdogs waits for a silent master before it stops by itself."""
    return min(axis.drive.heartbeat_ms, set_point_timeout_ms(axis)) / 1000.0


def _heartbeats(axis: AxisConfig) -> Iterator[_Row]:
    ms = axis.drive.heartbeat_ms
    field = "drive.heartbeat_ms"
    yield _row(axis, objects.HEARTBEAT_PRODUCER, ms, "the drive sends its heartbeat every so many ms", field)
    yield _row(
        axis,
        objects.HEARTBEAT_CONSUMER,
        master_heartbeat(axis),
        f"the drive stops by itself when node {axis.drive.master_node_id}, the master, is silent for {ms} ms",
        field,
        optional=True,
    )
    yield _row(
        axis,
        objects.ERROR_BEHAVIOUR,
        ERROR_LEAVES_OPERATIONAL,
        "a lost master also takes the drive out of OPERATIONAL, so that nobody goes on unnoticed",
        optional=True,
    )
    source = axis.load_encoder.source
    if source.node is not None:
        address = objects.HEARTBEAT_PRODUCER
        why = "the load encoder sends its heartbeat every so many ms"
        yield PlannedWrite(source.node, address.index, address.sub, ms, why, field, address.type), True


def _pdos(axis: AxisConfig, od: ObjectDictionary | None) -> Iterator[_Row]:
    used = set()
    for layout in (*tpdo_layouts(axis), *channel_layouts(axis)):
        used.add((layout.node_id, objects.TPDO_COMMUNICATION + layout.number - 1))
        yield from _pdo(layout, objects.TPDO_COMMUNICATION, objects.TPDO_MAPPING, _carried(axis, layout))
    layout = rpdo_layout(axis)
    used.add((layout.node_id, objects.RPDO_COMMUNICATION))
    timeout_ms = set_point_timeout_ms(axis)
    timer = PlannedWrite(
        layout.node_id,
        objects.RPDO_COMMUNICATION,
        5,
        timeout_ms,
        f"the drive stops by itself when no set-point comes for {timeout_ms} ms",
        "drive.cycle_ms",
        IntegerType.UINT16,
    )
    *others, last = _pdo(layout, objects.RPDO_COMMUNICATION, objects.RPDO_MAPPING, ["", ""])
    yield from others
    yield timer, True
    yield last
    for base, kind in ((objects.TPDO_COMMUNICATION, "TPDO"), (objects.RPDO_COMMUNICATION, "RPDO")):
        for index in range(base, base + _PDOS_PER_KIND):
            if od is not None and _has(od, index, 1) and (axis.drive.node_id, index) not in used:
                yield _invalidate(axis.drive.node_id, index, f"{kind}{index - base + 1} is not used"), False


def _carried(axis: AxisConfig, layout: Layout) -> list[str]:
    """The key of the axis file that chose each entry of a PDO; empty where none did."""
    encoder = axis.load_encoder.source
    keys = {(encoder.index, encoder.subindex): "load_encoder.source"}
    for key, channel in axis.channels.items():
        keys[channel.source.index, channel.source.subindex] = f"{key}.source"
    return [keys.get((entry.index, entry.sub), "") for entry in layout.codec.entries]


def _invalidate(node_id: int, index: int, why: str, field: str = "") -> PlannedWrite:
    return PlannedWrite(
        node_id,
        index,
        1,
        PDO_INVALID,
        why,
        field,
        type=IntegerType.UINT32,
        compared=PDO_INVALID,
        kept=PDO_INVALID - 1,
    )


def _pdo(layout: Layout, communication: int, mapping: int, fields: list[str]) -> Iterator[_Row]:
    """The order that CiA 301 prescribes: invalid, empty, entries, count, valid.

    ``fields`` are the keys of the axis file that chose the entries, empty where none did.
    """
    node_id, number, can_id, codec, every = layout
    field = next(filter(None, fields), "")
    of_channel = communication == objects.TPDO_COMMUNICATION and number > 2
    often = f"{field.split('.')[0]}.every_cycles" if of_channel else ""
    communication += number - 1
    mapping += number - 1
    name = f"{'TPDO' if communication >= objects.TPDO_COMMUNICATION else 'RPDO'}{number}"
    byte, word = IntegerType.UINT8, IntegerType.UINT32
    count = len(codec.entries)
    yield _invalidate(node_id, communication, f"{name} is off while it is changed", field), False
    yield PlannedWrite(node_id, mapping, 0, 0, f"{name} maps nothing while it is changed", type=byte), False
    for place, (entry, chosen) in enumerate(zip(codec.entries, fields, strict=True), start=1):
        yield (
            PlannedWrite(node_id, mapping, place, entry.mapping, f"{name} carries {entry}", chosen, word),
            False,
        )
    yield PlannedWrite(node_id, mapping, 0, count, f"{name} maps {count} objects", field, byte), False
    when = "every SYNC" if every == SYNCHRONOUS else f"every SYNC in {every}"
    yield PlannedWrite(node_id, communication, 2, every, f"{name} goes with {when}", often, byte), False
    yield (
        PlannedWrite(
            node_id,
            communication,
            1,
            can_id,
            f"{name} is {can_id:03X}h on the bus",
            "drive.node_id" if not field else "",
            word,
            compared=_COB_COMPARED,
            # Bit 30 says that the PDO cannot be asked for by RTR; some drives insist on it.
            kept=0x4000_0000,
        ),
        False,
    )


def _cycle(axis: AxisConfig) -> Iterator[_Row]:
    mantissa, exponent = axis.drive.interpolation_period
    why = f"the cycle is {axis.drive.cycle_ms:g} ms = {mantissa}e{exponent} s"
    yield _row(axis, objects.CYCLE_MANTISSA, mantissa, why, "drive.cycle_ms")
    yield _row(axis, objects.CYCLE_EXPONENT, exponent, why, "drive.cycle_ms")


def _options(axis: AxisConfig) -> Iterator[_Row]:
    drive = axis.drive
    yield _row(
        axis,
        objects.QUICK_STOP_OPTION,
        drive.quick_stop_option,
        "what a quick stop does",
        "drive.quick_stop_option",
    )
    yield _row(axis, objects.HALT_OPTION, drive.halt_option, "how a halt brakes", "drive.halt_option")
    for address, value, why in (
        (objects.SHUTDOWN_OPTION, SHUTDOWN_DISABLES, "'shutdown' switches the power stage off"),
        (objects.DISABLE_OPTION, DISABLE_SLOWS_DOWN, "'disable operation' brakes before it disables"),
        (objects.FAULT_REACTION_OPTION, FAULT_QUICK_STOPS, "a fault brakes with the quick-stop ramp"),
        (objects.ABORT_CONNECTION_OPTION, LOST_MASTER_QUICK_STOPS, "a lost master means a quick stop"),
    ):
        yield _row(axis, address, value, why, optional=True)


def _limits(axis: AxisConfig) -> Iterator[_Row]:
    limits, drive = axis.limits, axis.drive
    least, greatest = position_limits_counts(axis)
    margin = f"at the load, x ratio, wider by the compensation's {axis.compensation.maximum_arcsec:g} arcsec"
    # A reversed encoder makes the axis's lower end the drive's upper one; the counts are in order already.
    ends = ["limits.position_min_deg", "limits.position_max_deg"][:: axis.motor_encoder.direction]
    yield _row(axis, objects.LIMIT_MIN, least, f"lower end in motor counts ({margin})", ends[0])
    yield _row(axis, objects.LIMIT_MAX, greatest, f"upper end in motor counts ({margin})", ends[1])
    rpm = math.ceil(limits.velocity_deg_s * axis.gear.ratio / 6.0)
    yield _row(
        axis,
        objects.MAX_MOTOR_SPEED,
        rpm,
        "speed limit in rpm of the motor",
        "limits.velocity_deg_s",
        optional=True,
    )
    yield _row(
        axis,
        objects.QUICK_STOP_DECELERATION,
        motor_rate(axis, limits.acceleration_deg_s2),
        "ramp of a quick stop, motor counts/s2",
        "limits.acceleration_deg_s2",
        optional=True,
    )
    yield _row(
        axis,
        objects.MAX_TORQUE,
        round(limits.torque_percent * 10.0),
        "torque limit in per mille of the rated torque",
        "limits.torque_percent",
        optional=True,
    )
    window = round(abs(axis.motor_encoder.counts(drive.following_error_deg)))
    if window == 0:
        raise InputError(
            f"{axis.where('drive.following_error_deg')} {drive.following_error_deg:g} is less than half a "
            "motor count, "
            "and 0 in object 6065h means no supervision; raise it"
        )
    yield _row(
        axis,
        objects.FOLLOWING_WINDOW,
        window,
        "following error window, motor counts",
        "drive.following_error_deg",
    )
    yield _row(
        axis,
        objects.FOLLOWING_TIME,
        drive.following_error_time_ms,
        "time after which a following error counts, ms",
        "drive.following_error_time_ms",
    )


def motor_rate(axis: AxisConfig, load_deg: float) -> int:
    """A speed or acceleration at the load in whole motor counts (per s or s2), at least 1."""
    return max(round(abs(axis.motor_encoder.counts(load_deg * axis.gear.ratio))), 1)
