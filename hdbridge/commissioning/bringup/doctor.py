"""Checks of `doctor`, without and with power. A new check is a function and a row."""

from collections.abc import Iterator
from typing import Final

from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.bringup.checks import Check, Verdict, failed, judged, not_possible, passed
from hdbridge.commissioning.bringup.judge import (
    LOAD_COUNTS,
    MOTOR_COUNTS,
    RATIO,
    Turned,
    judge_channels,
    judge_following,
    judge_hold,
    judge_nudge,
    judge_rest,
    judge_settling,
    judge_stop,
    judge_torque,
    judge_turn,
)
from hdbridge.commissioning.bringup.scan import compare, scan_bus
from hdbridge.commissioning.bringup.slow import BringUpContext, Silence, SlowAxis, TravelPlan, plan_travel
from hdbridge.drive import objects
from hdbridge.drive.bootplan import left_to_drive, plan
from hdbridge.drive.bootup import await_sdo, read_identity
from hdbridge.drive.dictionary import load_eds
from hdbridge.drive.emergencies import HEARTBEAT_LOST
from hdbridge.drive.gains import changed_gains, read_gains
from hdbridge.drive.layout import layouts
from hdbridge.drive.nameplate import (
    device_type_complaints,
    identity_complaints,
    mode_complaints,
    scaling_addresses,
    scaling_complaints,
    torque_notes,
)
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.sdo import ABSENT, SdoAbortError
from hdbridge.drive.states import State, decode
from hdbridge.drive.supervision import Fault
from hdbridge.errors import DriveError, InputError, SdoError

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
    """Checks that the node answers; if not, lists the nodes that answer."""
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
        return failed(f"device type {device_type:08X}h is not a CiA-402 drive", *complaints)
    return passed(f"node {axis.drive.node_id}, device type {device_type:08X}h (CiA 402)")


def identity(context: BringUpContext) -> Verdict:
    """Checks that the drive's identity matches the axis file and that it supports the required mode."""
    axis, sdo = context.axis, context.drive.sdo
    found = read_identity(axis, sdo)
    remedies = [*identity_complaints(axis, found)]
    if sdo.has(objects.SUPPORTED_MODES.index, objects.SUPPORTED_MODES.sub):
        remedies += mode_complaints(axis, sdo.fetch(objects.SUPPORTED_MODES))
    text = ", ".join(f"{name.replace('_', ' ')} {value:#x}" for name, value in found.items())
    remedies += _retuned(context)
    return judged(not remedies, text, *remedies, **found)


def _retuned(context: BringUpContext) -> list[str]:
    """Returns one line for each servo gain that has changed since the model's response was measured."""
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
            wrong.append(f"the EDS is for {name.replace('_', ' ')} {stated:#x}, the drive reports {found:#x}")
    if wrong:
        return failed(
            f"{len(wrong)} of {looked_at} objects do not agree with {axis.drive.eds}",
            f"{where}: found {axis.drive.eds}, expected the EDS file of this drive and firmware",
            *wrong,
            objects=looked_at,
        )
    return passed(f"{looked_at} objects agree with {axis.drive.eds}", objects=looked_at)


def _listed(context: BringUpContext) -> Iterator[tuple[int, int]]:
    """Yields index and subindex of the objects to check: those that are both used and listed in the EDS."""
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
    readings = sdo.fetch_listed(scaling_addresses(axis))
    complaints = [*scaling_complaints(axis, readings)]
    said = ", ".join(f"{each.index:04X}h:{each.sub:02X} {value}" for each, value in readings.items())
    text = said or "the drive has no object that states its scaling"
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
    notes = torque_notes(axis, sdo.fetch_listed((objects.RATED_TORQUE,)).get(objects.RATED_TORQUE))
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
    """Checks that the encoder readings are constant without power, and that other channels are plausible."""
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


NUDGE_DEG: Final = 2.0
HOLD_S: Final = 0.5
BACK_FROM_DEG: Final = 60.0
SETTLE_S: Final = 0.8
_NOT_MOVED: Final = "the motor turn was not finished"
_OFF: Final = (State.SWITCH_ON_DISABLED, State.NOT_READY_TO_SWITCH_ON)
_DRIVES_DOING: Final = frozenset(
    {Fault.DROPPED_OUT, Fault.DRIVE_FAULT, Fault.NMT_CHANGE, Fault.LOST_TPDO, Fault.EMERGENCY}
)
"""Faults that the master's supervision reports when a drive stops on its own."""


def hold(context: BringUpContext) -> Verdict:
    """Checks that the axis stays in place when power is switched on."""
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        positions = context.drive.read_positions()
        with slow.enabled() as first:
            seen = [first, *slow.sit(HOLD_S)]
    return judge_hold(
        context.axis,
        Turned(positions.motor_counts, positions.load_counts),
        [Turned(each.motor_counts, each.load_counts) for each in seen],
    )


def nudge(context: BringUpContext) -> Verdict:
    """Moves the motor two degrees out and back, and checks that it follows."""
    with context.moving() as slow:
        way = _plan(context, slow)
        context.began_deg = slow.place_deg
        step = NUDGE_DEG if way.span_deg > 0 else -NUDGE_DEG
        begin, start_deg = slow.stand(), slow.place_deg
        slow.travel(start_deg + step)
        there = slow.stand()
        slow.travel(start_deg)
        back = slow.stand()
    return judge_nudge(
        context.axis,
        context.axis.motor_encoder.counts(step),
        there.motor_counts - begin.motor_counts,
        back.motor_counts - there.motor_counts,
    )


def turn(context: BringUpContext) -> Verdict:
    """Moves the motor about one turn each way, and compares direction and travel of both encoders."""
    with context.moving() as slow:
        way, start_deg = _plan(context, slow), slow.place_deg
        slow.travel(start_deg + way.lead_deg)
        near = slow.stand()
        context.out = slow.travel(start_deg + way.lead_deg + way.span_deg)
        context.rest_begins = len(context.out)
        context.out += slow.sit(SETTLE_S)
        far = slow.stand()
        slow.travel(start_deg + way.span_deg)
        turned_back = slow.stand()
        slow.travel(start_deg)
        home = slow.stand()
    return judge_turn(
        context.axis, _between(near, far), _between(turned_back, home), frozenset(context.confirmed)
    )


def following(context: BringUpContext) -> Verdict:
    """Judges the following error of the last move."""
    if not context.out:
        return not_possible(_NOT_MOVED)
    return judge_following(context.axis, [each.demand_counts - each.motor_counts for each in context.out])


def torque(context: BringUpContext) -> Verdict:
    """Judges the torque of the last move."""
    if not context.out:
        return not_possible(_NOT_MOVED)
    if objects.TORQUE_ACTUAL in layouts(context.axis).absent:
        return not_possible("the drive does not send its torque (6077h)")
    limit = min(context.torque_percent, context.axis.limits.torque_percent)
    return judge_torque(context.axis, [each.torque_permille for each in context.out], limit)


def settling(context: BringUpContext) -> Verdict:
    """Judges the settling of the load after the last move."""
    if len(context.out) <= context.rest_begins:
        return not_possible(_NOT_MOVED)
    resting = [each.load_counts for each in context.out[context.rest_begins :]]
    return judge_settling(context.axis, resting, context.axis.drive.cycle_s, context.noise_arcsec)


def quick_stop(context: BringUpContext) -> Verdict:
    """Quick-stops a slow motion, and judges stopping distance, time and final state."""
    with context.moving() as slow:
        speed, distance, time_s = slow.stop_on_the_way(_far_from(context, slow))
        state = slow.image.power.state
    axis = context.axis
    verdict = judge_stop(axis, speed, distance, time_s, f"'{state.value}'", 0.0)
    option = axis.drive.quick_stop_option
    expected = State.QUICK_STOP_ACTIVE if option >= 5 else State.SWITCH_ON_DISABLED
    report = context.drive.report
    chosen = report is not None and any(row.index == objects.QUICK_STOP_OPTION.index for row in report.held)
    if chosen and state is not expected:
        return failed(
            verdict.measured,
            f"{axis.where('drive.quick_stop_option')}: found {option}, after which '{expected.value}' is "
            f"expected, but the drive is in '{state.value}'; see its manual for 605Ah",
            **verdict.figures,
        )
    return verdict


def heartbeat(context: BringUpContext) -> Verdict:
    """Withholds the master's heartbeat during slow motion; the drive must stop on its own."""
    axis, sdo = context.axis, context.drive.sdo
    has_timer = _timer(context) is not None
    if not sdo.has(objects.HEARTBEAT_CONSUMER.index, objects.HEARTBEAT_CONSUMER.sub):
        if has_timer:
            return not_possible(
                "the drive watches no heartbeat (no 1016h); its RPDO event timer must suffice"
            )
        return failed(
            "the drive has neither a heartbeat consumer (1016h) nor an RPDO event timer (1400h:05)",
            f"nothing stops this axis when its master dies; if the drive does have them, "
            f"{axis.where('drive.eds')} is not its EDS",
        )
    beat_s = axis.drive.heartbeat_ms / 1000.0
    with context.moving() as slow:
        speed, silence = slow.lose_heartbeat(_far_from(context, slow), 3.0 * beat_s + 0.2)
    if silence.event is not None and silence.event.fault not in _DRIVES_DOING:
        return failed(f"disturbed: {silence.event}", "remove the cause and check again")
    return _judge_silence(
        context,
        silence,
        speed,
        "heartbeat",
        beat_s,
        f"the drive ignores that its master is silent: {axis.where('drive.heartbeat_ms')} "
        f"({axis.drive.heartbeat_ms} ms) was written to 1016h; check 6007h and 1029h in the drive's manual, "
        "and that the drive has no other setting that disables the reaction",
    )


def set_points(context: BringUpContext) -> Verdict:
    """Withholds SYNC and set-points during slow motion while the heartbeat continues; the drive must stop."""
    axis, sdo = context.axis, context.drive.sdo
    timer = _timer(context)
    if timer is None:
        return not_possible(
            "the drive has no RPDO event timer (1400h:05); its heartbeat consumer must suffice"
        )
    timer_s = sdo.read(timer, 5) / 1000.0
    with context.moving() as slow:
        speed, silence = slow.lose_set_points(_far_from(context, slow), 3.0 * timer_s + 0.2)
    return _judge_silence(
        context,
        silence,
        speed,
        "SYNC and set-points",
        timer_s,
        f"the drive ignores missing set-points: {axis.where('drive.cycle_ms')} determines its RPDO event "
        "timer (1400h:05); check it and 6007h in the drive's manual",
    )


def switched_off(context: BringUpContext) -> Verdict:
    """Boots the drive again and checks that it is switched off."""
    drive = context.boot()
    word = drive.sdo.fetch(objects.STATUSWORD)
    state = decode(word)
    text = f"boots again; '{state.value}' (statusword {word:04X}h)"
    remedy = "switch the drive off by its enable input and look at its error display"
    return judged(state in _OFF, text, remedy)


def _timer(context: BringUpContext) -> int | None:
    """Returns the index of the communication parameter of a cyclic RPDO with an event timer, or None."""
    used = (objects.RPDO_COMMUNICATION + layout.number - 1 for layout in context.drive.image.rpdos)
    return next((each for each in used if context.drive.sdo.has(each, 5)), None)


def _plan(context: BringUpContext, slow: SlowAxis) -> TravelPlan:
    way = plan_travel(context.axis, slow.place_deg)
    if way is None:
        where = context.axis.where("limits.position_min_deg")
        raise InputError(
            f"the axis stands at {slow.place_deg / context.axis.gear.ratio:.4g} deg and has no room to move "
            f"within {where} and position_max_deg; turn it away from its limits, or home it"
        )
    return way


def _far_from(context: BringUpContext, slow: SlowAxis) -> float:
    """Returns the target of a move to be interrupted: back to the initial position, or away from it."""
    if abs(slow.place_deg - context.began_deg) > BACK_FROM_DEG:
        return context.began_deg
    return slow.place_deg + _plan(context, slow).span_deg


def _between(start: Turned, end: Turned) -> Turned:
    return Turned(end.motor_counts - start.motor_counts, end.load_counts - start.load_counts)


def _noticed(context: BringUpContext) -> str:
    """Returns advice for a drive that reports the loss of its master but continues."""
    axis = context.axis
    option = axis.drive.quick_stop_option
    again = (
        f"; or it stopped, and 'enable operation', which this check still sends, restarted it (transition "
        f"16): {axis.where('drive.quick_stop_option')}: found {option}; 1 to 4 prevent that"
        if option >= 5
        else ""
    )
    return (
        "the drive detects that its master is silent, but neither stops (6007h) nor leaves OPERATIONAL "
        f"(1029h): see its manual for both{again}; the check of the set-points shows whether it stops "
        "otherwise"
    )


def _judge_silence(
    context: BringUpContext, silence: Silence, speed: float, what: str, after_s: float, remedy: str
) -> Verdict:
    state = decode(silence.statusword)
    still_on = state is State.OPERATION_ENABLED
    said = "".join(f"; it sent {each}" for each in silence.emergencies)
    if silence.resumed:
        what = (
            f"no {what}: it stopped on its own, and the master's own 'enable operation', which a dead master "
            f"does not send, restarted it (transition 16){said}"
        )
    elif silence.noticed_after_s is None or still_on or not silence.stands:
        noticed = any(each.code == HEARTBEAT_LOST for each in silence.emergencies)
        return failed(
            f"no {what} in motion at {speed:.3g} motor deg/s: the drive continues{said}",
            _noticed(context) if noticed else remedy,
            reacted=False,
        )
    else:
        what = f"no {what}: '{state.value}' on its own"
    after, allowed_s = silence.noticed_after_s or 0.0, 2.0 * after_s + 0.05
    return judge_stop(context.axis, speed, silence.distance_deg, after, what, allowed_s)


CHECKS: Final[tuple[Check[BringUpContext], ...]] = (
    Check("files", "the files", files),
    Check("bus", "the bus", bus, ("files",)),
    Check("node", "the node answers", answers, ("bus",)),
    Check("identity", "the right drive", identity, ("node",)),
    Check("eds", "the EDS fits", eds, ("node",)),
    Check("units", "the drive's units", units, ("node",)),
    Check("boot", "boot-up, read back", boot, ("identity", "eds", "units")),
    Check("rest", "encoders at rest", rest, ("boot",)),
    Check("hold", "power on at rest", hold, ("rest",), moves=True),
    Check("nudge", "a nudge", nudge, ("hold",), moves=True),
    Check("turn", "counts, directions, ratio", turn, ("nudge",), moves=True),
    Check("following", "following error", following, ("nudge",)),
    Check("torque", "torque", torque, ("nudge",)),
    Check("settling", "settling", settling, ("nudge",)),
    Check("quick_stop", "quick stop", quick_stop, ("nudge",), moves=True),
    Check("heartbeat", "master's heartbeat lost", heartbeat, ("quick_stop",), moves=True),
    Check("set_points", "SYNC and set-points lost", set_points, ("quick_stop",), moves=True),
    Check("off", "left switched off", switched_off, ("boot",)),
)
