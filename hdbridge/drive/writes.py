"""Writes of the boot-up, as a list for review before execution. Pure.

Every row contains the object, its value, the reason, and the field of the axis file from which it comes. The
boot-up reads each object first, writes the objects whose value differs, in this order, and reads them back.
`hdbridge.drive.bootplan` leaves missing objects that are optional in CiA 402 to the drive.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import partial
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODVariable

from hdbridge.axis import AxisConfig
from hdbridge.drive import objects
from hdbridge.drive.dictionary import find, held, integer_type, permitted
from hdbridge.drive.image import position_limits_counts
from hdbridge.drive.layout import PDOS_PER_KIND, Layout, Layouts
from hdbridge.drive.objects import PDO_INVALID, Address, IntegerType
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

SYNCHRONOUS: Final = 1
"""Transmission type of a PDO that is sent (TPDO) or applied (RPDO) at every SYNC."""
RPDO_TIMEOUT_CYCLES: Final = 4
"""Number of cycles without a set-point after which the drive stops (but not before 10 ms)."""
_COB_COMPARED: Final = PDO_INVALID | 0x7FF
_EVERYTHING: Final = -1
_EXPONENTS: Final = (-3, -4, -2, -5, -6, -1, 0)
_USUAL_EXPONENT: Final = -3
_LARGEST_MANTISSA: Final = 255


@dataclass(frozen=True, slots=True)
class PlannedWrite:
    """One write of the boot-up: the required value of one object."""

    node_id: int
    index: int
    sub: int
    value: int
    why: str
    field: str = ""
    """Field of the axis file that determines the value; empty if no field does."""
    type: IntegerType | None = None
    """Integer type; None if the EDS or the profile determines it."""
    compared: int = _EVERYTHING
    """Mask of the bits that must read back as written."""
    kept: int = 0
    """Mask of the bits that keep the drive's value."""
    composed: bool = False
    """True if the object packs several numbers. The limits of the EDS are ignored, because vendors state the
    limits for a single number."""
    without: str = ""
    """Consequence if the drive keeps its own value; empty if hdbridge requires this value."""
    exact: bool = False
    """True if a drive with this object must hold exactly this value."""
    pdo: int = 0
    """Communication parameter of the PDO that the row configures; the rows of a PDO are consecutive."""
    passing: bool = False
    """True if the object has the value only while its PDO is being changed."""

    def __str__(self) -> str:
        """Describes the write: ``605Ah:00 = 6 (6h): what a quick stop does [drive.quick_stop_option]``."""
        source = f" [{self.field}]" if self.field else ""
        return f"{self.index:04X}h:{self.sub:02X} = {self.value} ({self.value:X}h): {self.why}{source}"

    def holds(self, found: int) -> bool:
        """Returns True if an object with the value ``found`` needs no write."""
        return found & self.compared == self.value & self.compared


def rows(axis: AxisConfig, od: ObjectDictionary, pdos: Layouts) -> list[PlannedWrite]:
    """Returns all writes in order, whether or not the drive has the objects.

    The rows of the PDOs and of the cycle depend on what ``od`` permits. Raises `InputError` if a value of the
    axis file cannot be expressed in its object.
    """
    return [*_heartbeats(axis), *_pdos(axis, od, pdos), *_cycle(axis, od), *_options(axis), *_limits(axis)]


def _row(
    axis: AxisConfig,
    address: Address,
    value: int,
    why: str,
    field: str = "",
    *,
    without: str = "",
    exact: bool = False,
) -> PlannedWrite:
    kind = address.type
    if not kind.minimum <= value <= kind.maximum:
        raise InputError(
            f"{axis.where(field)} gives {value} for object {address}, outside [{kind.minimum}, "
            f"{kind.maximum}]; "
            "choose a value that the object can hold"
        )
    return PlannedWrite(
        axis.drive.node_id, address.index, address.sub, value, why, field, without=without, exact=exact
    )


def master_heartbeat(axis: AxisConfig) -> int:
    """Returns the value of 1016h: the master's node id and its heartbeat time-out, ms."""
    return axis.drive.master_node_id << 16 | axis.drive.heartbeat_ms


def set_point_timeout_ms(axis: AxisConfig) -> int:
    """Returns the value of 1400h:05: time without set-points after which the drive stops, ms."""
    return max(math.ceil(RPDO_TIMEOUT_CYCLES * axis.drive.cycle_ms), 10)


def drive_master_timeout_s(axis: AxisConfig) -> float:
    """Returns the time without a master after which a drive with all its watchdogs stops; s."""
    return min(axis.drive.heartbeat_ms, set_point_timeout_ms(axis)) / 1000.0


def _heartbeats(axis: AxisConfig) -> Iterator[PlannedWrite]:
    ms, master, field = axis.drive.heartbeat_ms, axis.drive.master_node_id, "drive.heartbeat_ms"
    why = "period of the drive's heartbeat, ms"
    without = "only missing TPDOs show that the drive is gone"
    yield _row(axis, objects.HEARTBEAT_PRODUCER, ms, why, field, without=without, exact=True)
    why = f"the drive stops on its own when node {master}, the master, is silent for {ms} ms"
    without = "only its event timer (1400h:05) stops the axis when the master dies"
    watched = _row(axis, objects.HEARTBEAT_CONSUMER, master_heartbeat(axis), why, field, without=without)
    yield replace(watched, composed=True)
    key, why = "communication_error_option", "its NMT state when the master is lost"
    yield _row(axis, objects.ERROR_BEHAVIOUR, getattr(axis.drive, key), why, f"drive.{key}", without=why)
    source = axis.load_encoder.source
    if source.node is not None:
        address = objects.HEARTBEAT_PRODUCER
        why = "period of the load encoder's heartbeat, ms"
        yield PlannedWrite(source.node, address.index, address.sub, ms, why, field, address.type)


def _pdos(axis: AxisConfig, od: ObjectDictionary, pdos: Layouts) -> Iterator[PlannedWrite]:
    used = set()
    for layout in (*pdos.cyclic, *pdos.channels):
        used.add((layout.node_id, objects.TPDO_COMMUNICATION + layout.number - 1))
        yield from _pdo(layout, objects.TPDO_COMMUNICATION, objects.TPDO_MAPPING, _carried(axis, layout))
    timeout_ms = set_point_timeout_ms(axis)
    for layout in pdos.rpdos:
        communication = objects.RPDO_COMMUNICATION + layout.number - 1
        used.add((layout.node_id, communication))
        timer = PlannedWrite(
            layout.node_id,
            communication,
            5,
            timeout_ms,
            f"the drive stops on its own when no set-point comes for {timeout_ms} ms",
            "drive.cycle_ms",
            IntegerType.UINT16,
            without="only its heartbeat consumer (1016h) stops the axis when the master dies",
            pdo=communication,
        )
        nothing = [""] * len(layout.codec.entries)
        *others, last = _pdo(layout, objects.RPDO_COMMUNICATION, objects.RPDO_MAPPING, nothing)
        yield from others
        yield timer
        yield last
    for base, kind, without in (
        (objects.TPDO_COMMUNICATION, "TPDO", "it keeps sending"),
        (objects.RPDO_COMMUNICATION, "RPDO", "it stays configured, but no node sends it"),
    ):
        for index in range(base, base + PDOS_PER_KIND):
            if find(od, index, 1) and (axis.drive.node_id, index) not in used:
                why = f"{kind}{index - base + 1} is not used"
                yield _invalid(axis.drive.node_id, index, why, without=without)


def _carried(axis: AxisConfig, layout: Layout) -> list[str]:
    """Returns the key of the axis file that requests each entry of a PDO; empty without one."""
    encoder = axis.load_encoder.source
    keys = {(encoder.index, encoder.subindex): "load_encoder.source"}
    for key, channel in axis.channels.items():
        keys[channel.source.index, channel.source.subindex] = f"{key}.source"
    return [keys.get((entry.index, entry.sub), "") for entry in layout.codec.entries]


def _invalid(
    node_id: int, index: int, why: str, field: str = "", *, without: str = "", pdo: int = 0
) -> PlannedWrite:
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
        without=without,
        pdo=pdo,
        passing=bool(pdo),
    )


def _pdo(layout: Layout, communication: int, mapping: int, fields: list[str]) -> Iterator[PlannedWrite]:
    """Yields the rows of one PDO in the order of CiA 301: invalid, empty, entries, count, valid.

    ``fields`` are the keys of the axis file that request the entries (see `_carried`).
    """
    node_id, number, can_id, codec, every, _ = layout
    field = next(filter(None, fields), "")
    of_channel = communication == objects.TPDO_COMMUNICATION and every != SYNCHRONOUS
    often = f"{field.split('.')[0]}.every_cycles" if of_channel and field else ""
    kind = "TPDO" if communication >= objects.TPDO_COMMUNICATION else "RPDO"
    name = f"{kind}{number}"
    communication += number - 1
    mapping += number - 1

    row = partial(PlannedWrite, node_id, pdo=communication)
    byte, word = IntegerType.UINT8, IntegerType.UINT32
    count = len(codec.entries)
    yield _invalid(node_id, communication, f"{name} is off while it is changed", field, pdo=communication)
    yield row(mapping, 0, 0, f"{name} maps nothing while it is changed", "", byte, passing=True)
    for place, (entry, chosen) in enumerate(zip(codec.entries, fields, strict=True), start=1):
        yield row(mapping, place, entry.mapping, f"{name} carries {entry}", chosen, word)
    yield row(mapping, 0, count, f"{name} maps {count} objects", field, byte)
    when = "every SYNC" if every == SYNCHRONOUS else f"every SYNC in {every}"
    yield row(communication, 2, every, f"{name} goes with {when}", often, byte)
    yield row(
        communication,
        1,
        can_id,
        f"{name} is {can_id:03X}h on the bus",
        "drive.node_id" if not field else "",
        word,
        compared=_COB_COMPARED,
        # Bit 30 forbids requests of the PDO by RTR; some drives insist on it.
        kept=0x4000_0000,
    )


def _cycle(axis: AxisConfig, od: ObjectDictionary) -> Iterator[PlannedWrite]:
    mantissa, exponent = _period(axis, od)
    why = f"the cycle is {axis.drive.cycle_ms:g} ms = {mantissa}e{exponent} s"
    without = f"the drive has to take its period, {axis.drive.cycle_ms:g} ms, from SYNC or its own settings"
    for address, value in ((objects.CYCLE_MANTISSA, mantissa), (objects.CYCLE_EXPONENT, exponent)):
        yield _row(axis, address, value, why, "drive.cycle_ms", without=without, exact=True)
    if axis.drive.mode == "ip":
        yield _row(
            axis, objects.INTERPOLATION_SUBMODE, 0, "linear interpolation", without="how it interpolates"
        )


def _period(axis: AxisConfig, od: ObjectDictionary) -> tuple[int, int]:
    """Returns the cycle time as a mantissa and an exponent (base 10, s) that the drive accepts."""
    seconds = Decimal(repr(axis.drive.cycle_ms)) / 1000
    pairs = [(seconds.scaleb(-exponent), exponent) for exponent in _EXPONENTS]
    whole = [(int(m), e) for m, e in pairs if m == int(m) and 1 <= m <= _LARGEST_MANTISSA]
    mantissa = find(od, objects.CYCLE_MANTISSA.index, objects.CYCLE_MANTISSA.sub)
    exponent = find(od, objects.CYCLE_EXPONENT.index, objects.CYCLE_EXPONENT.sub)
    if mantissa is None:
        return whole[0]
    for m, e in whole:
        taken = e == _USUAL_EXPONENT if exponent is None else _takes(exponent, e)
        if taken and _takes(mantissa, m):
            return m, e
    fixed = [each for each in (mantissa, exponent) if each is not None and not each.writable]
    said = " and ".join(f"60C2h:{each.subindex:02X} is read-only ({held(each)})" for each in fixed)
    raise InputError(
        f"{axis.where('drive.cycle_ms')}: {axis.drive.eds} does not permit {axis.drive.cycle_ms:g} ms in "
        f"object 60C2h: {said or 'it is out of its limits'}; expected a cycle that the drive can have"
    )


def _takes(variable: ODVariable, value: int) -> bool:
    if not variable.writable:
        return held(variable) in (None, value)
    kind = integer_type(variable)
    if kind is None:
        return False
    low, high = permitted(variable, kind)
    return low <= value <= high


def _options(axis: AxisConfig) -> Iterator[PlannedWrite]:
    drive = axis.drive
    for address, key, what in (
        (objects.QUICK_STOP_OPTION, "quick_stop_option", "what a quick stop does"),
        (objects.HALT_OPTION, "halt_option", "how a halt brakes"),
        (objects.SHUTDOWN_OPTION, "shutdown_option", "what 'shutdown' does under power"),
        (objects.DISABLE_OPTION, "disable_option", "how 'disable operation' brakes"),
        (objects.FAULT_REACTION_OPTION, "fault_reaction_option", "how a fault brakes"),
        (
            objects.ABORT_CONNECTION_OPTION,
            "abort_connection_option",
            "what it does when its master is lost; `hdbridge doctor` checks it",
        ),
    ):
        value: int = getattr(drive, key)
        yield _row(axis, address, value, what, f"drive.{key}", without=what)


def _limits(axis: AxisConfig) -> Iterator[PlannedWrite]:
    limits, drive = axis.limits, axis.drive
    least, greatest = position_limits_counts(axis)
    margin = f"at the load, x ratio, wider by the compensation's {axis.compensation.maximum_arcsec:g} arcsec"
    # A reversed encoder makes the axis's lower end the drive's upper one; the counts are already in order.
    ends = ["limits.position_min_deg", "limits.position_max_deg"][:: axis.motor_encoder.direction]
    window = round(abs(axis.motor_encoder.counts(drive.following_error_deg)))
    if window == 0:
        raise InputError(
            f"{axis.where('drive.following_error_deg')} {drive.following_error_deg:g} is less than half a "
            "motor count, and 0 in object 6065h means no supervision; raise it"
        )
    alone = "only hdbridge enforces it"
    slew = axis.compensation.slew_arcsec_s
    rpm = math.ceil((limits.velocity_deg_s + slew / ARCSEC_PER_DEG) * axis.gear.ratio / 6.0)
    ramp = motor_rate(axis, limits.acceleration_deg_s2)
    late = "time after which a following error counts"
    for address, value, why, field, without in (
        (objects.LIMIT_MIN, least, f"lower end in motor counts ({margin})", ends[0],
         f"lower end of travel; {alone}"),
        (objects.LIMIT_MAX, greatest, f"upper end in motor counts ({margin})", ends[1],
         f"upper end of travel; {alone}"),
        (objects.MAX_MOTOR_SPEED, rpm,
         f"speed limit in rpm of the motor (higher by the compensation's {slew:g} arcsec/s)",
         "limits.velocity_deg_s", f"speed limit; {alone}"),
        (objects.QUICK_STOP_DECELERATION, ramp, "ramp of a quick stop, motor counts/s2",
         "limits.acceleration_deg_s2", "ramp of a quick stop"),
        (objects.MAX_TORQUE, round(limits.torque_percent * 10.0),
         "torque limit in per mille of the rated torque", "limits.torque_percent", "torque limit"),
        (objects.FOLLOWING_WINDOW, window, "following error window, motor counts",
         "drive.following_error_deg", "following error window; hdbridge applies its own"),
        (objects.FOLLOWING_TIME, drive.following_error_time_ms, f"{late}, ms",
         "drive.following_error_time_ms", late),
    ):  # fmt: skip
        yield _row(axis, address, value, why, field, without=without)


def motor_rate(axis: AxisConfig, load_deg: float) -> int:
    """Converts a speed or acceleration at the load to whole motor counts (per s or s2), at least 1."""
    return max(round(abs(axis.motor_encoder.counts(load_deg * axis.gear.ratio))), 1)
