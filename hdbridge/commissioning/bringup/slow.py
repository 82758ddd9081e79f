"""Shared state of the checks, and slow, torque-limited motion of an unverified axis in raw counts.

Each `enabled` block switches power on at rest, and on every exit brings the axis to rest and switches power
off again. Everything runs in the control cycle with full supervision.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean
from typing import Final, NamedTuple

import can
from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig
from hdbridge.cia301 import wrap_int32
from hdbridge.clock import Clock
from hdbridge.commissioning.bringup import TORQUE_PERCENT
from hdbridge.commissioning.bringup.judge import Turned
from hdbridge.control.bench import axis_view
from hdbridge.control.runner import AxisRunner
from hdbridge.drive import objects
from hdbridge.drive.drive import Drive
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.monitor import Emergency
from hdbridge.drive.objects import COB_EMCY
from hdbridge.drive.states import FAULTS, State, decode
from hdbridge.drive.supervision import Event
from hdbridge.errors import SafetyStop
from hdbridge.motion.procedures.moves import MoveTo, Path

MOTOR_SPEED_DEG_S: Final = 120.0
"""Speed of the moves, motor degrees per second, if the limits allow four times as much."""
LEAD_DEG: Final = 45.0
"""Motor travel before each measured standstill, degrees, so that the gear is on the same branch of its
hysteresis loop."""
MARGIN_DEG: Final = 1.0
"""Motor travel kept clear of the axis limits, degrees."""
LEAST_TRAVEL_DEG: Final = 20.0


class TravelPlan(NamedTuple):
    """Planned travel from the current position, signed motor degrees."""

    lead_deg: float
    span_deg: float
    """Whole motor turns if the limits allow, so that periodic errors cancel out."""


def plan_travel(axis: AxisConfig, here_deg: float) -> TravelPlan | None:
    """Returns the travel from a motor angle, in the direction with more room; None without enough room.

    The span is one motor turn, or several if one cannot distinguish a high ratio from its neighbour.
    """
    limits, ratio = axis.limits, axis.gear.ratio
    ahead = limits.position_max_deg * ratio - here_deg - MARGIN_DEG
    behind = here_deg - limits.position_min_deg * ratio - MARGIN_DEG
    wanted = 360.0 * max(1, round(ratio / 50.0))
    sign = 1.0 if ahead >= min(wanted + LEAD_DEG, behind) else -1.0
    room = max(ahead, behind) if sign < 0 else ahead
    if room < LEAST_TRAVEL_DEG:
        return None
    lead = min(LEAD_DEG, room / 8.0)
    span = min(wanted, room - lead)
    if span >= 360.0:
        span = 360.0 * math.floor(span / 360.0)
    return TravelPlan(sign * lead, sign * span)


class QuietLink(Link):
    """Link that can withhold frames with chosen identifiers, in order to imitate a dead master."""

    def __init__(self, bus: can.BusABC, clock: Clock) -> None:
        super().__init__(bus, clock)
        self.muted: set[int] = set()
        self.sent_s: dict[int, float] = {}
        """Time at which a frame with each identifier was last sent, s."""
        self.unheard: set[int] = set()
        """Identifiers of received frames that are not passed on."""
        self.withheld: list[Frame] = []
        """Received frames that were not passed on."""

    def recv(self, deadline_s: float) -> Frame | None:
        """Receives a frame, skipping those in `unheard`."""
        while (frame := super().recv(deadline_s)) is not None and frame.can_id in self.unheard:
            self.withheld.append(frame)
        return frame

    def send(self, can_id: int, data: bytes) -> None:
        """Sends a frame unless its identifier is muted."""
        if can_id not in self.muted:
            super().send(can_id, data)
            self.sent_s[can_id] = self.now()


@dataclass(frozen=True, slots=True)
class Silence:
    """Reaction of the drive to a silent master."""

    noticed_after_s: float | None
    """Time from the last frame to the drive's reaction, s; None without a reaction within its time-out."""
    event: Event | None
    """First event of the master's supervision, if it continued to run."""
    statusword: int
    """Statusword of the drive at standstill."""
    stands: bool
    distance_deg: float
    """Motor travel from the last frame to standstill, degrees."""
    emergencies: tuple[Emergency, ...] = ()
    """Emergency messages that the drive sent during the silence."""
    resumed: bool = False
    """True if the drive entered the quick stop and the master's own controlword took it out again."""


class SlowAxis(AxisRunner):
    """Axis in slow motion, with limited torque. Raises like `AxisRunner`."""

    def __init__(self, drive: Drive, torque_percent: float, interrupted: Callable[[], bool]) -> None:
        self.link = QuietLink(drive.link.bus, drive.link.clock)
        super().__init__(drive, interrupted, self.link)
        self.torque_percent = min(torque_percent, drive.axis.limits.torque_percent)
        self.place_deg = 0.0
        """Target motor angle, degrees."""

    @contextmanager
    def enabled(self) -> Iterator[Feedback]:
        """Enters `powered` with the limited torque; quick-stops the axis at the end of the block."""
        drive = self._drive
        if drive.can_set(objects.MAX_TORQUE):
            drive.sdo.store(objects.MAX_TORQUE, round(10.0 * self.torque_percent))
        with self.powered() as feedback:
            self.place_deg = self.image.motor_deg(feedback.motor_counts)
            yield feedback
            self.brake()

    # -- motion -------------------------------------------------------------------------------------------

    def sit(self, duration_s: float) -> list[Feedback]:
        """Runs cycles without motion, with or without power; returns their feedback."""
        return [self.tick() for _ in range(math.ceil(duration_s / self.cycle.period_s))]

    def travel(self, motor_deg: float) -> list[Feedback]:
        """Moves slowly to a motor angle; returns the feedback of each cycle."""
        return list(self._follow(motor_deg))

    def stand(self, duration_s: float = 0.4) -> Turned:
        """Holds the position; returns the mean counts of both encoders over the last quarter of the time."""
        seen = self.sit(duration_s)
        tail = seen[-max(len(seen) // 4, 1) :]
        return Turned(
            fmean(each.motor_counts for each in tail), fmean(float(each.load_counts) for each in tail)
        )

    def _path(self, motor_deg: float, least_s: float) -> Path:
        """Returns the path to a motor angle, which lasts at least ``least_s``."""
        ratio, limits = self.axis.gear.ratio, self.axis.limits
        speed = min(MOTOR_SPEED_DEG_S, 0.25 * limits.velocity_deg_s * ratio)
        if least_s > 0.0:
            speed = min(speed, abs(motor_deg - self.place_deg) / least_s)
        slow = MoveTo(motor_deg / ratio, speed / ratio, acceleration_deg_s2=0.5 * limits.acceleration_deg_s2)
        return slow.path(self.place_deg / ratio, axis_view(self.axis).limits)

    def _follow(self, motor_deg: float, least_s: float = 0.0) -> Iterator[Feedback]:
        path, period_s, ratio = self._path(motor_deg, least_s), self.cycle.period_s, self.axis.gear.ratio
        elapsed_s = 0.0
        while True:
            self.place_deg = path.at(elapsed_s) * ratio
            yield self.tick(self.image.target_counts_for(self.place_deg))
            if elapsed_s >= path.duration_s:
                return
            elapsed_s += period_s

    # -- stops --------------------------------------------------------------------------------------------

    def stop_on_the_way(self, motor_deg: float) -> tuple[float, float, float]:
        """Quick-stops half-way; returns the speed before the stop, its travel and its time (motor deg, s)."""
        moved = self._half_way(self._follow(motor_deg), motor_deg)
        speed = self._measured_speed(moved)
        stop_feedbacks = self.stop()
        start, end = moved[-1].motor_counts, stop_feedbacks[-1].motor_counts
        rest = next(place for place, each in enumerate(stop_feedbacks) if abs(each.motor_counts - end) <= 1)
        way = abs(self.axis.motor_encoder.degrees(end - start))
        return speed, way, (rest + 1) * self.cycle.period_s

    def lose_heartbeat(self, motor_deg: float, patience_s: float) -> tuple[float, Silence]:
        """Moves, and withholds the master's heartbeat from half-way on; returns speed and reaction."""
        moving = self._follow(motor_deg, 2.0 * patience_s + 1.0)
        moved = self._half_way(moving, motor_deg)
        speed = self._measured_speed(moved)
        start = moved[-1]
        identifier = self.image.heartbeat_id
        last_s = self.link.sent_s.get(identifier, self.link.now())
        muted_s = self.link.now()
        self.link.muted.add(identifier)
        # The emergency message would make this master stop the axis before the drive's own reaction shows.
        self.link.unheard.add(COB_EMCY + self.axis.drive.node_id)
        noticed_s: float | None = None
        try:
            for _ in moving:
                if self.link.now() - muted_s > patience_s:
                    break
        except SafetyStop:
            pass  # `supervision.stop` holds the cause
        finally:
            self.link.muted.discard(identifier)
            self.link.unheard.clear()
            for frame in self.link.withheld:
                self._drive.monitor.dispatch(frame)
            self.link.withheld.clear()
        event = self.supervision.stop
        if event is not None:
            noticed_s = muted_s - last_s + (event.cycle - start.cycle) * self.cycle.period_s
        states = [decode(each.statusword) for each in self.cycle.stop_feedbacks] if event is not None else []
        if event is None:
            self.stop()
        silence = self._after_silence(start.motor_counts, noticed_s, event)
        said = self._drive.monitor.nodes[self.axis.drive.node_id].emergencies
        return speed, replace(
            silence,
            emergencies=tuple(each for each in said if each.time_s >= muted_s and each.code >> 8),
            resumed=(State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED) in pairwise(states),
        )

    def lose_set_points(self, motor_deg: float, patience_s: float) -> tuple[float, Silence]:
        """Moves, and withholds only SYNC and set-points from half-way on; returns speed and reaction."""
        moved = self._half_way(self._follow(motor_deg), motor_deg)
        speed, start, drive = self._measured_speed(moved), moved[-1], self._drive
        last_s = self.link.now()
        noticed_s: float | None = None
        while self.link.now() - last_s <= patience_s:
            if self._interrupted():
                raise KeyboardInterrupt  # leaving `powered` stops it
            drive.wait(0.002)
            if decode(drive.sdo.fetch(objects.STATUSWORD)) is not State.OPERATION_ENABLED:
                noticed_s = self.link.now() - last_s
                break
        if noticed_s is None:
            drive.quick_stop()
        result = self._after_silence(start.motor_counts, noticed_s, None)
        self.image.power.observe(result.statusword)
        return speed, result

    def _half_way(self, moving: Iterator[Feedback], motor_deg: float) -> Sequence[Feedback]:
        """Runs the move up to the middle of its travel; the rest of ``moving`` can still be run."""
        begin = self.place_deg
        seen: list[Feedback] = []
        for feedback in moving:
            seen.append(feedback)
            if abs(self.place_deg - begin) >= 0.5 * abs(motor_deg - begin):
                break
        return seen

    def _measured_speed(self, seen: Sequence[Feedback]) -> float:
        late = seen[-min(len(seen), 6) :]
        counts, time_s = late[-1].motor_counts - late[0].motor_counts, late[-1].time_s - late[0].time_s
        return abs(self.axis.motor_encoder.degrees(counts)) / time_s if time_s else 0.0

    def _after_silence(self, start_counts: int, noticed_s: float | None, event: Event | None) -> Silence:
        """Waits for standstill, and reads the position by SDO, because the drive may no longer send PDOs."""
        stands, sdo = self._drive.wait_for_standstill(), self._drive.sdo
        way = wrap_int32(sdo.fetch(objects.POSITION_ACTUAL) - wrap_int32(start_counts))
        statusword, distance_deg = sdo.fetch(objects.STATUSWORD), abs(self.axis.motor_encoder.degrees(way))
        return Silence(noticed_s, event, statusword, stands, distance_deg)


Connect = Callable[["AxisConfig"], AbstractContextManager[tuple["can.BusABC", Clock]]]
"""Opens an axis's bus and returns it with its clock."""
Interruptible = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Context that defers interrupts and yields a function that reports an interrupt."""


class BringUpContext(ExitStack):
    """Axis under examination, as a context manager that leaves the drive off and the bus closed.

    ``load`` reads the axis file and ``connect`` opens its bus. Both are checks, so they are passed as
    functions. ``torque_percent`` limits every motion, percent of the rated torque, in addition to the axis
    file's own limit. With ``force``, frames are sent even if another master is heard on the bus.
    """

    axis: AxisConfig
    """Axis file, from `admit` on."""
    drive: Drive
    """Drive, not necessarily booted, from `connect` on."""

    def __init__(
        self,
        load: Callable[[], AxisConfig],
        connect: Connect,
        *,
        torque_percent: float = TORQUE_PERCENT,
        force: bool = False,
        interruptible: Interruptible = lambda: nullcontext(lambda: False),
    ) -> None:
        super().__init__()
        self.load = load
        self.torque_percent = torque_percent
        self.interruptible = interruptible
        self.began_deg = 0.0
        """Motor angle before the axis was moved, degrees."""
        self.noise_arcsec = 0.0
        """Noise of the load encoder at rest, arcsec."""
        self.confirmed: set[str] = set()
        """Keys of the axis file that the drive's own objects confirm."""
        self.out: list[Feedback] = []
        """Feedback of the long forward move, and of the standstill at its end."""
        self.rest_begins = 0
        self._connect = connect
        self._force = force

    def admit(self, axis: AxisConfig, od: ObjectDictionary) -> None:
        """Stores the axis file and the EDS after they have been read."""
        self.axis, self._od = axis, od

    def connect(self) -> None:
        """Opens the bus without sending. Raises `BusError`."""
        bus, clock = self.enter_context(self._connect(self.axis))
        self.drive = self.enter_context(Drive(bus, self.axis, clock, self._od, force=self._force))

    def boot(self) -> Drive:
        """Boots the drive again, resets a fault left by an earlier check, and returns the drive, disabled."""
        report = self.drive.boot()
        if report.state in FAULTS:
            self.drive.fault_reset()
        return self.drive

    @contextmanager
    def moving(self) -> Iterator[SlowAxis]:
        """Yields the axis for slow motion, freshly booted and under power until the end of the block."""
        with self.interruptible() as interrupted:
            slow = self.slow(interrupted)
            with slow.enabled():
                yield slow

    def slow(self, interrupted: Callable[[], bool]) -> SlowAxis:
        """Returns the axis for slow motion, freshly booted and still switched off."""
        return SlowAxis(self.boot(), self.torque_percent, interrupted)
