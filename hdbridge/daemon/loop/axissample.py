"""Values of one axis after a turn, as plain numbers for the ring of samples."""

import math
from typing import Final

from hdbridge.control.axiscycle import AxisCycle
from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.follower import Follower
from hdbridge.daemon.loop.outerfeed import OuterFeed
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory.cells import OuterCells
from hdbridge.daemon.memory.layout import NO_FAULT, SampleFlag
from hdbridge.drive.states import State
from hdbridge.motion import MotionMode

_FOLLOW: Final = MotionMode.FOLLOW
_POWER_INDEX: Final = {state: place for place, state in enumerate(State)}
# Plain integers: combining enum flags would cost more than the rest of the sample.
_FRESH, _COMPENSATING, _LIMITED, _MEMORY_KNOWN, _CHANGING, _AT_REST, _UNDERRUN, _DOUBTED, _KNOWN0, _KNOWN1 = (
    map(int, SampleFlag)
)


class AxisSampler:
    """Collects the sample of one axis in each turn."""

    def __init__(
        self, cycle: AxisCycle, follower: Follower, outer_feed: OuterFeed, outer: OuterCells
    ) -> None:
        self._outer_feed, self._outer = outer_feed, outer
        self._cycle, self._follower = cycle, follower
        self._image, self._supervision = cycle.image, cycle.supervision
        axis = cycle.image.axis
        self._ratio = axis.gear.ratio
        self._motor_deg = axis.motor_encoder.degrees(1)
        encoder = axis.load_encoder
        self._load_deg = math.nan if encoder.is_motor_encoder else encoder.degrees(1)
        self._limited = 0

    def take(self, state: AxisState, *, changing: bool, underrun: bool) -> tuple[float, ...]:
        """Returns the fields of `layout.Axis` for the turn that has just ended."""
        image, feedback, follower = self._image, self._cycle.feedback, self._follower
        set_point, motor_deg = follower.set_point, self._motor_deg
        position_deg = motor_deg * feedback.motor_counts
        stop = self._supervision.stop
        flags = _FRESH if feedback.fresh else 0
        reading0 = reading1 = received_s = math.nan
        if feedback.readings:
            flags, reading0, reading1 = _readings(flags, feedback.readings)
        if state is AxisState.ENABLED or state is AxisState.STOPPING:
            correction = follower.correction
            correction_arcsec, predicted_arcsec = correction.correction_arcsec, correction.predicted_arcsec
            target_deg, weight, loop_arcsec = follower.target_deg, correction.weight, follower.loop_arcsec
            limited = correction.limited
            if limited != self._limited:
                self._limited = limited
                flags |= _LIMITED
            if follower.compensating:
                flags |= _COMPENSATING
            if correction.memory_known:
                flags |= _MEMORY_KNOWN
            if set_point.at_rest:
                flags |= _AT_REST
            if changing:
                flags |= _CHANGING
            if underrun:
                flags |= _UNDERRUN
            if follower.loop_doubt:
                flags |= _DOUBTED
            if set_point.mode is _FOLLOW:
                received_s = self._outer_feed.received_s
        else:
            flags |= _AT_REST
            target_deg = position_deg / self._ratio
            correction_arcsec = predicted_arcsec = weight = loop_arcsec = 0.0
        return (
            state, set_point.mode, _POWER_INDEX[image.power.state],
            NO_FAULT if stop is None else FAULT_INDEX[stop.fault],
            feedback.statusword, flags,
            target_deg, motor_deg * feedback.demand_counts, position_deg,
            self._load_deg * feedback.load_counts,
            feedback.torque_permille * follower.sensed.torque_nm, set_point.velocity_deg_s,
            correction_arcsec, predicted_arcsec, loop_arcsec, weight, reading0, reading1,
            math.nan if self._cycle.silent else motor_deg * image.target_counts,
            received_s, *self._outer.values(),
        )  # fmt: skip


def _readings(flags: int, readings: tuple[float | None, ...]) -> tuple[int, float, float]:
    """Returns the flags with those of the known channels added, and both readings (NaN if unknown)."""
    known = [each if each is not None else math.nan for each in (*readings, None)[:2]]
    for value, bit in zip(known, (_KNOWN0, _KNOWN1), strict=True):
        if not math.isnan(value):
            flags |= bit
    return flags, known[0], known[1]
