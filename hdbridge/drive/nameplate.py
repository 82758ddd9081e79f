"""Comparison of a drive's identification and scaling with the axis file. Pure function of readings.

Every difference is a line of text with the key of the axis file, its value, and the drive's value. The
boot-up refuses the drive with the first line; the bring-up shows them all.
"""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.drive import objects
from hdbridge.drive.layout import cyclic_mode
from hdbridge.drive.objects import Address

Readings = Mapping[Address, int]
"""Values read from the drive, by address; objects that the drive lacks are missing."""

IDENTITY: Final[tuple[tuple[Address, str], ...]] = (
    (objects.VENDOR_ID, "vendor_id"),
    (objects.PRODUCT_CODE, "product_code"),
    (objects.REVISION, "revision"),
    (objects.SERIAL, "serial"),
)
"""Identity objects, and their keys under ``drive.identity``."""
_RATED_TORQUE_TOLERANCE: Final = 0.01


def scaling_addresses(axis: AxisConfig) -> tuple[Address, ...]:
    """Returns the objects that define the drive's position scaling, all of which are optional."""
    source = axis.load_encoder.source
    additional = source.node is None and source.index == objects.ADDITIONAL_POSITIONS
    return (
        objects.ENCODER_INCREMENTS,
        objects.ENCODER_REVOLUTIONS,
        objects.GEAR_MOTOR,
        objects.GEAR_SHAFT,
        objects.FEED,
        objects.FEED_SHAFT,
        objects.POLARITY,
        *(objects.additional_resolution(source.subindex) if additional else ()),
    )


def device_type_complaints(axis: AxisConfig, device_type: int) -> Iterator[str]:
    """Yields a complaint unless 1000h reports a CiA-402 drive."""
    if device_type & 0xFFFF != objects.DEVICE_PROFILE_402:
        yield (
            f"{_at(axis, objects.DEVICE_TYPE)} is {device_type:08X}h, device profile {device_type & 0xFFFF}; "
            f"expected 402 (drives and motion control); check {axis.where('drive.node_id')}"
        )


def identity_complaints(axis: AxisConfig, found: Mapping[str, int]) -> Iterator[str]:
    """Yields the identity values (keys of ``drive.identity``) that differ from the axis file."""
    for address, name in IDENTITY:
        wanted = getattr(axis.drive.identity, name)
        if wanted is not None and found.get(name) != wanted:
            yield (
                f"{_at(axis, address)} is {found[name]:X}h, but {axis.where(f'drive.identity.{name}')} is "
                f"{wanted:X}h; connect the right drive or correct the file"
            )


def mode_complaints(axis: AxisConfig, modes: int) -> Iterator[str]:
    """Yields a complaint unless 6502h contains the control cycle's mode; a value of 0 counts as unknown."""
    if modes and not modes & cyclic_mode(axis).mode.supported_bit:
        yield (
            f"{_at(axis, objects.SUPPORTED_MODES)} is {modes:08X}h, without the mode {axis.drive.mode} of "
            f"{axis.where('drive.mode')}; {mode_advice(modes)}"
        )


def mode_advice(modes: int) -> str:
    """Returns advice for a drive whose 6502h lacks the mode of the control cycle."""
    for name, each in objects.CYCLIC.items():
        if modes & each.mode.supported_bit:
            return f"'mode: {name}' is supported"
    return (
        "this drive cannot be used: choose one with cyclic synchronous position (csp) or interpolated "
        "position (ip), or enable that in the drive"
    )


def scaling_complaints(axis: AxisConfig, readings: Readings) -> Iterator[str]:
    """Yields the contradictions between the axis file and every object that defines the drive's scaling."""
    try:
        increments = _ratio(axis, readings, objects.ENCODER_INCREMENTS, objects.ENCODER_REVOLUTIONS)
        feed = _ratio(axis, readings, objects.FEED, objects.FEED_SHAFT) if axis.drive.feed_scales else None
        gear = _ratio(axis, readings, objects.GEAR_MOTOR, objects.GEAR_SHAFT) or Fraction(1)
    except _NotARatioError as problem:
        yield str(problem)
        return
    yield from _gear(axis, gear, feed)
    yield from _motor_counts(axis, increments, None if feed is None else feed / gear)
    yield from _polarity(axis, readings)
    yield from _load_counts(axis, readings)


def torque_notes(axis: AxisConfig, rated_mnm: int | None) -> Iterator[str]:
    """Yields a note if 6076h differs from the axis file, which is not a reason to refuse the drive."""
    if rated_mnm is None:
        return
    drive_nm, file_nm = rated_mnm / 1000.0, axis.drive.rated_torque_nm
    if abs(drive_nm - file_nm) > _RATED_TORQUE_TOLERANCE * file_nm:
        yield (
            f"{_at(axis, objects.RATED_TORQUE)}: the drive says {drive_nm:g} Nm, "
            f"{axis.where('drive.rated_torque_nm')} is {file_nm:g}; torques are reported with the latter"
        )


def _gear(axis: AxisConfig, gear: Fraction, feed: Fraction | None) -> Iterator[str]:
    where, ratio = axis.where("gear.ratio"), axis.gear.ratio
    if gear not in (1, Fraction(ratio)):
        yield (
            f"{_at(axis, objects.GEAR_MOTOR)}: the drive knows a gear of {float(gear):g}, but "
            f"{where} is {ratio:g}; correct the one that is wrong"
        )
    elif feed is None and gear != 1 and axis.drive.feed_scales:
        yield (
            f"{_at(axis, objects.GEAR_MOTOR)}: the drive divides positions by a gear ratio of "
            f"{float(gear):g}; set 6091h to 1:1, {where} is the only one"
        )


def _motor_counts(axis: AxisConfig, increments: Fraction | None, per_turn: Fraction | None) -> Iterator[str]:
    counts = axis.motor_encoder.counts_per_turn
    informative = (
        f"; if the drive reports encoder counts regardless of 6092h: 'feed_scales: false' under "
        f"{axis.where('drive')}"
    )
    for value, used, hint in (
        (increments, "608Fh:01 / 608Fh:02 (encoder resolution)", ""),
        (per_turn, "6092h (feed) over 6091h (gear ratio)", informative),
    ):
        if value is not None and value != counts:
            yield (
                f"node {axis.drive.node_id}, {used}: the drive counts {float(value):g} per motor turn, but "
                f"{axis.where('motor_encoder.counts_per_turn')} is {counts}; set the drive's scaling to "
                f"plain encoder counts, or correct the file{hint}"
            )


def _polarity(axis: AxisConfig, readings: Readings) -> Iterator[str]:
    polarity = readings.get(objects.POLARITY, 0)
    if polarity & 0x80:
        yield (
            f"{_at(axis, objects.POLARITY)} is {polarity:02X}h, the drive reverses positions itself; set it "
            f"to 0 and use {axis.where('motor_encoder.direction')}"
        )


def _load_counts(axis: AxisConfig, readings: Readings) -> Iterator[str]:
    """Compares the resolution of a load encoder at 60E4h (60E6h over 60EBh) with the axis file.

    The drive may state the resolution per turn of the load or of the motor.
    """
    source, counts = axis.load_encoder.source, axis.load_encoder.counts_per_turn
    if source.node is not None or source.index != objects.ADDITIONAL_POSITIONS:
        return
    sub = source.subindex
    try:
        found = _ratio(axis, readings, *objects.additional_resolution(sub))
    except _NotARatioError as problem:
        yield str(problem)
        return
    if found not in (None, counts, Fraction(counts) / Fraction(axis.gear.ratio)):
        yield (
            f"node {axis.drive.node_id}, 60E6h:{sub:02X} / 60EBh:{sub:02X} (additional encoder resolution): "
            f"the drive counts {float(found):g} per turn, but {axis.where('load_encoder.counts_per_turn')} "
            f"is {counts}; correct the one that is wrong"
        )


class _NotARatioError(Exception):
    """One of the two objects of a ratio is 0."""


def _ratio(axis: AxisConfig, readings: Readings, above: Address, below: Address) -> Fraction | None:
    """Returns the ratio of two objects; None if the drive lacks the first."""
    if above not in readings:
        return None
    numerator, denominator = readings[above], readings.get(below, 1)
    if numerator == 0 or denominator == 0:
        raise _NotARatioError(
            f"{_at(axis, above)} is {numerator}, over {denominator}: not a ratio; set the drive's "
            "scaling first"
        )
    return Fraction(numerator, denominator)


def _at(axis: AxisConfig, address: Address) -> str:
    return f"node {axis.drive.node_id}, object {address.index:04X}h:{address.sub:02X} '{address.name}'"
