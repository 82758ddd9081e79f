"""Checks that need no power: files, bus, node, identity, EDS, scaling, boot-up, encoders at rest."""

from collections.abc import Iterator
from typing import Final

from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.bringup.checks import Verdict, failed, passed
from hdbridge.commissioning.bringup.context import BringUpContext
from hdbridge.commissioning.bringup.judge import judge_channels, judge_rest
from hdbridge.commissioning.bringup.match import compare
from hdbridge.commissioning.bringup.scale import LOAD_COUNTS, MOTOR_COUNTS, RATIO
from hdbridge.commissioning.bringup.scan import scan_bus
from hdbridge.commissioning.bringup.slow import SlowAxis
from hdbridge.drive import objects
from hdbridge.drive.bootplan import left_to_drive, plan
from hdbridge.drive.bootup import await_sdo
from hdbridge.drive.dictionary import load_eds
from hdbridge.drive.gains import changed_gains, read_gains
from hdbridge.drive.nameplate import (
    IDENTITY,
    device_type_complaints,
    identity_complaints,
    mode_complaints,
    scaling_addresses,
    scaling_complaints,
    torque_notes,
)
from hdbridge.drive.objects import Address, IntegerType
from hdbridge.drive.sdo import ABSENT, SdoAbortError
from hdbridge.errors import DriveError, SdoError

REST_S: Final = 1.0


def files(context: BringUpContext) -> Verdict:
    """Reads the axis file and the EDS, and checks that every boot-up value fits its object."""
    axis = context.load()
    od = load_eds(axis.eds_path, axis.drive.node_id)
    rows, left = plan(axis, od), left_to_drive(axis, od)
    context.admit(axis, od)
    names = ", ".join(f"{each.index:04X}h:{each.sub:02X}" for each in left)
    return passed(
        f"{axis.path}, {axis.eds_path.name}: {len(rows)} objects to compare and write"
        + (f"; left to the drive, see `hdbridge check`: {names}" if left else ""),
        axis_file=str(axis.path),
        eds=str(axis.eds_path),
        writes=len(rows),
        left=len(left),
    )


def bus(context: BringUpContext) -> Verdict:
    """Opens the bus and checks that no other master uses it."""
    context.connect()
    context.drive.listen()
    link = context.drive.link
    return passed(f"{link.name} is open, no other master is heard", bus=link.name)


def answers(context: BringUpContext) -> Verdict:
    """Checks that the node answers; if it does not, lists the nodes that do."""
    axis, drive = context.axis, context.drive
    try:
        where = axis.where("drive.node_id")
        device_type = await_sdo(drive.link, drive.monitor, drive.sdo, where)
    except SdoAbortError:
        raise
    except DriveError as error:
        if drive.monitor.watch(axis.drive.node_id).heard_since((0, 0, 0)):
            return failed(str(error))
        found = scan_bus(drive.link, listen_s=0.3, force=True)
        _, lines = compare(axis, found)
        others = ", ".join(f"node {each.node_id} ({each.kind})" for each in found.nodes) or "nobody"
        wiring = "check power, cable, termination (60 ohm between CAN_H and CAN_L) and bit rate"
        return failed(
            f"node {axis.drive.node_id} does not answer; on the bus: {others}",
            *(lines if found.nodes else (wiring, *lines)),
        )
    if complaints := [*device_type_complaints(axis, device_type)]:
        return failed(f"device type {device_type:08X}h is no CiA-402 drive", *complaints)
    return passed(f"node {axis.drive.node_id}, device type {device_type:08X}h (CiA 402)")


def identity(context: BringUpContext) -> Verdict:
    """Checks that it is the drive of the axis file and supports the required mode."""
    axis, sdo = context.axis, context.drive.sdo
    found = {
        name: sdo.fetch(address)
        for address, name in IDENTITY
        if sdo.has(address.index, address.sub) or getattr(axis.drive.identity, name) is not None
    }
    remedies = [*identity_complaints(axis, found)]
    if sdo.has(objects.SUPPORTED_MODES.index, objects.SUPPORTED_MODES.sub):
        remedies += mode_complaints(axis, sdo.fetch(objects.SUPPORTED_MODES))
    text = ", ".join(f"{name.replace('_', ' ')} {value:#x}" for name, value in found.items())
    remedies += _retuned(context)
    return failed(text, *remedies, **found) if remedies else passed(text, **found)


def _retuned(context: BringUpContext) -> list[str]:
    """Lines on servo gains that differ from those that the model's response in motion was measured with."""
    path = context.axis.path.with_name("model.yaml")
    response = TransmissionModel.load(path).response if path.exists() else None
    if response is None or not response.gain_objects:
        return []
    changed = changed_gains(response.gain_objects, read_gains(context.drive.sdo))
    return [f"{line}; restore it, or measure the response again: hdbridge motion" for line in changed]


def eds(context: BringUpContext) -> Verdict:
    """Checks the EDS against the drive: the objects used exist and have the stated type."""
    axis, drive = context.axis, context.drive
    where = axis.where("drive.eds")
    wrong: list[str] = []
    looked_at = 0
    for index, sub in dict.fromkeys(_listed(context)):
        looked_at += 1
        try:
            drive.sdo.read(index, sub)
        except SdoAbortError as error:
            if error.code in ABSENT:  # other codes refuse the access, not the object
                wrong.append(str(error).split(";", 1)[0])
        except SdoError as error:
            if "answered" not in str(error):
                raise
            wrong.append(str(error).split(";", 1)[0])
    information = drive.sdo.od.device_information
    for name, address in (("vendor_number", objects.VENDOR_ID), ("product_number", objects.PRODUCT_CODE)):
        stated = getattr(information, name, None)
        found = drive.sdo.fetch(address)
        if isinstance(stated, int) and stated and stated != found:
            wrong.append(f"the EDS is for {name.replace('_', ' ')} {stated:#x}, the drive says {found:#x}")
    if wrong:
        return failed(
            f"{len(wrong)} of {looked_at} objects are not as {axis.drive.eds} says",
            f"{where}: found {axis.drive.eds}, expected the EDS file of this drive and firmware",
            *wrong,
            objects=looked_at,
        )
    return passed(f"{looked_at} objects answer as {axis.drive.eds} says", objects=looked_at)


def _listed(context: BringUpContext) -> Iterator[tuple[int, int]]:
    """Yields the objects to check: those that are used and that the EDS lists."""
    axis, sdo = context.axis, context.drive.sdo
    target = context.drive.image.cyclic.target
    for address in (
        *objects.REQUIRED,
        target,
        objects.RATED_TORQUE,
        objects.ERROR_CODE,
        *scaling_addresses(axis),
    ):
        if sdo.has(address.index, address.sub):
            yield address.index, address.sub
    for row in plan(axis, sdo.od):
        if row.node_id == axis.drive.node_id and sdo.has(row.index, row.sub):
            yield row.index, row.sub
    source = axis.load_encoder.source
    if source.node is None and sdo.has(source.index, source.subindex):
        yield source.index, source.subindex
    for channel in axis.channels.values():
        yield channel.source.index, channel.source.subindex


def units(context: BringUpContext) -> Verdict:
    """Compares every object that defines the drive's scaling with the axis file."""
    axis, sdo = context.axis, context.drive.sdo

    def read(*addresses: Address) -> dict[Address, int]:
        return {each: sdo.fetch(each) for each in addresses if sdo.has(each.index, each.sub)}

    readings = read(*scaling_addresses(axis))
    complaints = [*scaling_complaints(axis, readings)]
    said = ", ".join(f"{each.index:04X}h:{each.sub:02X} {value}" for each, value in readings.items())
    text = said or "the drive has no object that says how it counts"
    if complaints:
        return failed(text, *complaints)
    gear = readings.get(objects.GEAR_MOTOR, 1) / readings.get(objects.GEAR_SHAFT, 1)
    for key, known in (
        (MOTOR_COUNTS, objects.ENCODER_INCREMENTS in readings),
        (RATIO, gear != 1.0),
        (LOAD_COUNTS, any(each.index == 0x60E6 for each in readings)),
    ):
        if known:
            context.confirmed.add(key)
    notes = torque_notes(axis, read(objects.RATED_TORQUE).get(objects.RATED_TORQUE))
    return passed("; ".join((text, *notes)))


def boot(context: BringUpContext) -> Verdict:
    """Boots the drive: writes the plan and reads every object back."""
    drive = context.boot()
    report = drive.report
    assert report is not None
    return passed(
        f"{len(report.held)} objects as planned, {len(report.written)} of them written; OPERATIONAL, "
        f"'{report.state.value}'" + "".join(f"; {each}" for each in report.notes),
        held=len(report.held),
        written=len(report.written),
    )


def rest(context: BringUpContext) -> Verdict:
    """Checks that both encoders come with every SYNC and stand still without power; reads the channels."""
    drive = context.drive
    with context.interruptible() as interrupted:
        positions = drive.read_positions()
        drive.image.seed(
            positions.motor_counts, positions.load_counts, drive.sdo.read(0x6041, 0, IntegerType.UINT16)
        )
        seen = SlowAxis(drive, context.torque_percent, interrupted).sit(REST_S)
    fresh = [each for each in seen if each.fresh]
    verdict = judge_rest(
        context.axis, [each.motor_counts for each in fresh], [each.load_counts for each in fresh]
    )
    context.noise_arcsec = float(verdict.figures["load_noise_arcsec"] or 0.0)
    readings = {each.key: each.value for each in drive.image.channels}
    return judge_channels(context.axis, readings, REST_S, verdict)
