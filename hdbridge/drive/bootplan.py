"""Adapts the boot-up's writes to a drive: omits those that the drive's EDS does not allow. Pure."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig
from hdbridge.drive import objects
from hdbridge.drive.dictionary import dictionary_of, find, held, integer_type, permitted
from hdbridge.drive.layout import cyclic_mode, layouts
from hdbridge.drive.nameplate import mode_advice
from hdbridge.drive.objects import Mode
from hdbridge.drive.writes import PlannedWrite, rows
from hdbridge.errors import InputError


@dataclass(frozen=True, slots=True)
class OmittedObject:
    """Object whose value the boot-up leaves to the drive, or that the drive cannot provide."""

    index: int
    sub: int
    reason: str
    """Relative clause for messages, for example ``which drive.eds lacks``."""
    consequence: str
    field: str = ""
    """Field of the axis file that would have set the value."""

    def __str__(self) -> str:
        """For example ``605Dh:00, which drive.eds lacks: how a halt brakes``."""
        return f"{self.index:04X}h:{self.sub:02X}, {self.reason}: {self.consequence}"


def plan(axis: AxisConfig, od: ObjectDictionary | None = None) -> list[PlannedWrite]:
    """Returns all writes of a boot-up in order, for the drive and for a load encoder with its own node id.

    ``od`` is the drive's object dictionary, by default that of the axis's EDS. Objects left to the drive are
    omitted, and unused PDOs are disabled. Raises `InputError` with the line of the axis file if a value
    cannot be expressed in its object, or if the EDS forbids it, lacks an object that the control cycle or the
    axis file needs, or excludes the mode.
    """
    return _split(axis, od)[0]


def left_to_drive(axis: AxisConfig, od: ObjectDictionary | None = None) -> list[OmittedObject]:
    """Returns the objects that `plan` leaves to the drive, and missing ones that the cycle does not need."""
    od = dictionary_of(axis) if od is None else od
    return [*_split(axis, od)[1], *_not_read(axis, od)]


def unrequested_objects(axis: AxisConfig) -> list[str]:
    """Describes the objects that the master sends only because the drive's fixed mappings contain them."""
    own = {(each.index, each.sub) for each in (objects.CONTROLWORD, objects.MODE, cyclic_mode(axis).target)}
    od = dictionary_of(axis)
    found = []
    for layout in layouts(axis, od).rpdos:
        for entry in layout.codec.entries:
            variable = find(od, entry.index, entry.sub)
            if variable is not None and (entry.index, entry.sub) not in own:
                value = held(variable) or 0
                found.append(f"{entry.index:04X}h:{entry.sub:02X} = {value} in RPDO{layout.number}")
    return found


def _split(axis: AxisConfig, od: ObjectDictionary | None) -> tuple[list[PlannedWrite], list[OmittedObject]]:
    """Splits all rows into the writes of the boot-up and the objects left to the drive."""
    od = dictionary_of(axis) if od is None else od
    _check_mode(axis, od)
    pdos = layouts(axis, od)
    planned: list[PlannedWrite] = []
    left: dict[tuple[int, int], OmittedObject] = {}
    for row in rows(axis, od, pdos):
        reason = _omission_reason(axis, od, row)
        if reason is None:
            planned.append(row)
        else:
            left[row.index, row.sub] = OmittedObject(row.index, row.sub, reason, row.without, row.field)
    watchdogs = [(objects.HEARTBEAT_CONSUMER.index, objects.HEARTBEAT_CONSUMER.sub)]
    watchdogs += [(objects.RPDO_COMMUNICATION + each.number - 1, 5) for each in pdos.rpdos]
    if left.keys() >= set(watchdogs):
        for key in watchdogs:
            left[key] = replace(left[key], consequence="nothing stops the axis when its master dies")
    return planned, list(left.values())


def _omission_reason(axis: AxisConfig, od: ObjectDictionary, row: PlannedWrite) -> str | None:
    """Returns the reason for leaving an object to the drive; None if the boot-up sets it.

    Raises `InputError` if the drive must not keep its own value.
    """
    if row.node_id != axis.drive.node_id or not (row.without or row.exact):
        return None
    variable, eds = find(od, row.index, row.sub), axis.drive.eds
    if variable is None:
        return f"which {eds} lacks"
    kind = integer_type(variable)
    if kind is None:
        return f"which is not an integer in {eds}"
    found = held(variable)
    if not variable.writable:
        if found is None or row.holds(found):
            return None
        reason = f"which is read-only in {eds} ({found})"
        if row.exact:
            raise InputError(
                f"{axis.where(row.field)}: {_of(row)}, {reason}; write that value, or change the drive"
            )
        return reason
    low, high = permitted(variable, kind)
    if low <= row.value <= high or row.kept or row.composed:  # The limits apply to only a part of the value.
        return None
    if row.exact or axis.states(row.field):
        raise InputError(f"{axis.where(row.field)}: {_of(row)}; {eds} permits {low} to {high}")
    return f"for which {eds} permits {low} to {high}, not {row.value}"


def _of(row: PlannedWrite) -> str:
    return f"gives {row.value} for object {row.index:04X}h:{row.sub:02X}"


def _check_mode(axis: AxisConfig, od: ObjectDictionary) -> None:
    """Raises `InputError` if 6502h in the EDS, or without it the limits of 6060h, exclude the mode."""
    modes, said = _value_of_6502h(od), "6502h is {:08X}h"
    mode = find(od, objects.MODE.index, objects.MODE.sub)
    if not modes and mode is not None:
        low, high = permitted(mode, integer_type(mode) or objects.MODE.type)
        modes, said = (
            sum(each.supported_bit for each in Mode if low <= each <= high),
            f"6060h permits {low} to {high}",
        )
    if modes and not modes & cyclic_mode(axis).mode.supported_bit:
        raise InputError(
            f"{axis.where('drive.mode')}: {axis.drive.mode} is not among the modes of {axis.drive.eds} "
            f"({said.format(modes)}); {mode_advice(modes)}"
        )


def _value_of_6502h(od: ObjectDictionary) -> int:
    """Returns the supported drive modes (6502h) from the EDS; 0 if missing there."""
    variable = find(od, objects.SUPPORTED_MODES.index, objects.SUPPORTED_MODES.sub)
    return (held(variable) if variable is not None else None) or 0


def _not_read(axis: AxisConfig, od: ObjectDictionary) -> Iterator[OmittedObject]:
    """Yields the optional objects of cycle and boot-up that the drive cannot provide."""
    absent = layouts(axis, od).absent
    for address, consequence in (
        (objects.POSITION_DEMAND, "the last target sent is used instead"),
        (objects.TORQUE_ACTUAL, "torque is neither recorded nor checked"),
        (objects.SUPPORTED_MODES, "only the drive itself shows if it has the mode"),
        (objects.ERROR_CODE, "only emergency messages explain a fault"),
    ):
        variable = find(od, address.index, address.sub)
        if variable is None:
            reason = f"which {axis.drive.eds} lacks"
        elif address in absent:
            reason = f"which no TPDO of {axis.drive.eds} can carry"
        elif address == objects.SUPPORTED_MODES and not _value_of_6502h(od):
            reason = f"for which {axis.drive.eds} gives no value"
        else:
            continue
        yield OmittedObject(address.index, address.sub, reason, consequence)
