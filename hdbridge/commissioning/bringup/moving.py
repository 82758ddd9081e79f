"""Checks under power: enable at rest, a nudge, a motor turn each way, and every way to stop."""

from typing import Final

from hdbridge.commissioning.bringup.checks import Verdict, failed, not_possible, passed
from hdbridge.commissioning.bringup.context import BringUpContext
from hdbridge.commissioning.bringup.judge import (
    judge_following,
    judge_hold,
    judge_nudge,
    judge_settling,
    judge_stop,
    judge_torque,
)
from hdbridge.commissioning.bringup.scale import Turned, judge_turn
from hdbridge.commissioning.bringup.slow import Silence, SlowAxis, TravelPlan, plan_travel
from hdbridge.drive import objects
from hdbridge.drive.emergencies import HEARTBEAT_LOST
from hdbridge.drive.layout import layouts
from hdbridge.drive.states import State, decode
from hdbridge.drive.supervision import Fault
from hdbridge.errors import InputError

NUDGE_DEG: Final = 2.0
HOLD_S: Final = 0.5
BACK_FROM_DEG: Final = 60.0
SETTLE_S: Final = 0.8
_NOT_MOVED: Final = "the motor turn was not finished"
_OFF: Final = (State.SWITCH_ON_DISABLED, State.NOT_READY_TO_SWITCH_ON)
_DRIVES_DOING: Final = frozenset(
    {Fault.DROPPED_OUT, Fault.DRIVE_FAULT, Fault.NMT_CHANGE, Fault.LOST_TPDO, Fault.EMERGENCY}
)
"""Faults that the master's supervision sees when a drive stops on its own."""


def hold(context: BringUpContext) -> Verdict:
    """Checks that the axis stays in place when power comes."""
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
    """Moves the motor two degrees, out and back."""
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        with slow.enabled():
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
    """Moves the motor one turn each way and compares direction and travel of both encoders."""
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        with slow.enabled():
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
    """Judges the following error of that move."""
    if not context.out:
        return not_possible(_NOT_MOVED)
    return judge_following(context.axis, [each.demand_counts - each.motor_counts for each in context.out])


def torque(context: BringUpContext) -> Verdict:
    """Judges the torque of that move."""
    if not context.out:
        return not_possible(_NOT_MOVED)
    if objects.TORQUE_ACTUAL in layouts(context.axis).absent:
        return not_possible("the drive does not send its torque (6077h)")
    limit = min(context.torque_percent, context.axis.limits.torque_percent)
    return judge_torque(context.axis, [each.torque_permille for each in context.out], limit)


def settling(context: BringUpContext) -> Verdict:
    """Judges how the load settled after that move."""
    if len(context.out) <= context.rest_begins:
        return not_possible(_NOT_MOVED)
    resting = [each.load_counts for each in context.out[context.rest_begins :]]
    return judge_settling(context.axis, resting, context.axis.drive.cycle_s, context.noise_arcsec)


def quick_stop(context: BringUpContext) -> Verdict:
    """Quick-stops a slow motion and judges travel, time and final state."""
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        with slow.enabled():
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
    """Withholds the master's heartbeat during slow motion: the drive must stop on its own."""
    axis, sdo = context.axis, context.drive.sdo
    has_timer = _timer(context) is not None
    if not sdo.has(objects.HEARTBEAT_CONSUMER.index, objects.HEARTBEAT_CONSUMER.sub):
        if has_timer:
            return not_possible("the drive watches no heartbeat (no 1016h); its RPDO event timer has to do")
        return failed(
            "the drive has neither a heartbeat consumer (1016h) nor an RPDO event timer (1400h:05)",
            f"nothing stops this axis when its master dies; if the drive does have them, "
            f"{axis.where('drive.eds')} is not its EDS",
        )
    beat_s = axis.drive.heartbeat_ms / 1000.0
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        with slow.enabled():
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
    """Withholds SYNC and set-points during slow motion while the heartbeat continues: the drive must stop."""
    axis, sdo = context.axis, context.drive.sdo
    timer = _timer(context)
    if timer is None:
        return not_possible("the drive has no RPDO event timer (1400h:05); its heartbeat consumer has to do")
    timer_s = sdo.read(timer, 5) / 1000.0
    with context.interruptible() as interrupted:
        slow = context.slow(interrupted)
        with slow.enabled():
            speed, silence = slow.lose_set_points(_far_from(context, slow), 3.0 * timer_s + 0.2)
    return _judge_silence(
        context,
        silence,
        speed,
        "SYNC and set-points",
        timer_s,
        f"the drive ignores that no set-point comes: {axis.where('drive.cycle_ms')} decides its RPDO event "
        "timer (1400h:05); check it and 6007h in the drive's manual",
    )


def switched_off(context: BringUpContext) -> Verdict:
    """Checks that the drive boots again, and leaves it switched off."""
    drive = context.boot()
    word = drive.sdo.fetch(objects.STATUSWORD)
    state = decode(word)
    text = f"boots again; '{state.value}' (statusword {word:04X}h)"
    if state in _OFF:
        return passed(text)
    return failed(text, "switch the drive off by its enable input and look at its error display")


def _timer(context: BringUpContext) -> int | None:
    """Returns the communication parameter of a cyclic RPDO with an event timer; None if there is none."""
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
    """Returns the target of a move to be stopped: back to the initial position, or away from it."""
    if abs(slow.place_deg - context.began_deg) > BACK_FROM_DEG:
        return context.began_deg
    return slow.place_deg + _plan(context, slow).span_deg


def _between(start: Turned, end: Turned) -> Turned:
    return Turned(end.motor_counts - start.motor_counts, end.load_counts - start.load_counts)


def _noticed(context: BringUpContext) -> str:
    """Returns advice for a drive that reports the loss of its master and continues."""
    axis = context.axis
    option = axis.drive.quick_stop_option
    again = (
        f"; or it stopped, and went on by 'enable operation', which this check still sends (transition 16): "
        f"{axis.where('drive.quick_stop_option')}: found {option}, with 1 to 4 it cannot"
        if option >= 5
        else ""
    )
    return (
        "the drive noticed that its master is silent, and neither stops (6007h) nor leaves OPERATIONAL "
        f"(1029h) for it: see its manual for both{again}; the check of the set-points says whether it stops "
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
            f"no {what}: it stopped by itself, and the master's own 'enable operation', which a dead master "
            f"does not send, took it out of that (transition 16){said}"
        )
        return judge_stop(
            context.axis,
            speed,
            silence.distance_deg,
            silence.noticed_after_s or 0.0,
            what,
            2.0 * after_s + 0.05,
        )
    if silence.noticed_after_s is None or still_on or not silence.stands:
        return failed(
            f"no {what} in motion at {speed:.3g} motor deg/s: the drive goes on{said}",
            *(
                [_noticed(context)]
                if any(e.code == HEARTBEAT_LOST for e in silence.emergencies)
                else [remedy]
            ),
            reacted=False,
        )
    return judge_stop(
        context.axis,
        speed,
        silence.distance_deg,
        silence.noticed_after_s,
        f"no {what}: '{state.value}' by itself",
        2.0 * after_s + 0.05,
    )
