"""Connection to one axis of the control process: its newest sample, commands, and the end of motions."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Unpack

from hdbridge.axis import AxisConfig
from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import STOPPED, AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind
from hdbridge.daemon.service.core import ANSWER_S, Arguments, Core
from hdbridge.daemon.service.timing import POLL_S
from hdbridge.drive.states import State
from hdbridge.drive.supervision import EXPLAINED_HINT, ROWS
from hdbridge.errors import DaemonError, InputError, RefusedError, SafetyStop
from hdbridge.motion import MotionMode

_POWER: Final = tuple(State)


class Kind(Enum):
    """Kind of an activity."""

    MOVE = "a move"
    JOG = "a jog"
    QUEUE = "a queue of moves"
    STREAM = "a stream"
    COORDINATED = "a coordinated move"


ENDS_WITH_LEASE = frozenset({Kind.JOG, Kind.QUEUE, Kind.STREAM})
"""Activities that are stopped when the lease under which they began ends. Moves complete on their own."""


@dataclass(slots=True, eq=False)
class Activity:
    """One activity, in progress until it completes or is replaced."""

    kind: Kind
    holder: str
    """Token of the lease under which the activity began."""
    command_id: int = 0
    """Id of the command to the control process that began this motion."""
    since: int = 0
    """Number of the newest log entry before the activity; later entries report its outcome."""
    over: str = ""
    """Reason for the end; empty while the activity is in progress."""

    def end(self, why: str) -> None:
        """Ends the activity; only the first reason counts."""
        self.over = self.over or why


class AxisLink:
    """Connection to one axis; ``index`` is its index in the shared memory."""

    def __init__(self, core: Core, index: int, config: AxisConfig) -> None:
        self.core = core
        self.index = index
        self.config = config
        self.name = config.name

    # ---------------------------------------------------------------- the newest cycle

    def value(self, field: str) -> float:
        """Returns a field of `AXIS_SAMPLE` in the newest cycle; 0 before the first."""
        newest = self.core.observer.newest
        return float(newest[0]["axes"][self.index][field]) if newest is not None else 0.0

    @property
    def state(self) -> AxisState:
        """State of the axis in the control process."""
        return AxisState(int(self.value("state")))

    @property
    def power(self) -> State:
        """The drive's power state."""
        newest = self.core.observer.newest
        return _POWER[int(self.value("power"))] if newest is not None else State.UNKNOWN

    def seeds(self) -> Arguments:
        """Returns the counts of both encoders and the statusword, as arguments of ENABLE."""
        encoder = self.config.load_encoder
        motor = round(self.value("motor_position_deg") / self.config.motor_encoder.degrees(1))
        load = (
            motor if encoder.is_motor_encoder else round(self.value("load_position_deg") / encoder.degrees(1))
        )
        return Arguments(i=motor, j=load, k=int(self.value("statusword")))

    # ---------------------------------------------------------------- commands

    async def do(
        self, kind: CommandKind, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]
    ) -> Event:
        """Runs `Core.do`, then waits for a sample later than the answer."""
        answer = await self.core.do(kind, self.index, within_s, **arguments)
        observer = self.core.observer
        await self.until(lambda: observer.cycle > answer.cycle, ANSWER_S)
        return answer

    async def begin(self, activity: Activity, kind: CommandKind, **arguments: Unpack[Arguments]) -> None:
        """Runs `do` for the command that begins the motion of an activity."""
        activity.since = self.core.log.newest
        activity.command_id = (await self.do(kind, **arguments)).id

    async def until(self, found: Callable[[], bool], within_s: float) -> bool:
        """Waits until ``found()`` is True, checking each cycle; returns False after ``within_s``."""
        timing, observer = self.core.timing, self.core.observer
        deadline_s = timing.clock.now() + within_s
        observer.poll()
        while not found():
            left_s = deadline_s - timing.clock.now()
            if left_s <= 0.0:
                return False
            await timing.sleep(min(POLL_S, left_s))
            observer.poll()
        return True

    async def arrival(self, activity: Activity, waiting: Activity | None = None) -> None:
        """Waits until a motion has ended.

        ``waiting`` is the activity that waits, if it is a different one; the wait ends with it. Raises
        SafetyStop if the supervision stopped the motion, RefusedError if another activity replaced it,
        InputError if one of its set-points was refused, and DaemonError if the control process is gone.
        """
        stopping = False
        while True:
            done, stopping = self._poll_motion(activity, stopping)
            if done:
                return
            why = activity.over or (waiting.over if waiting is not None else "")
            if why and not stopping:
                raise RefusedError(f"{self.name}: {why}")
            if not self.core.observer.alive:
                raise DaemonError(
                    f"{self.name}: the control process has completed no cycle lately: it hangs or has died; "
                    "the drive stops automatically, and the axis will be disabled"
                )
            await self.core.timing.sleep(POLL_S)

    def check(self, activity: Activity) -> None:
        """Checks a motion without waiting. Raises like `arrival`, and RefusedError if it has ended."""
        done, _ = self._poll_motion(activity, stopping=False)
        if done or activity.over:
            raise RefusedError(f"{self.name}: {activity.over}")

    def _poll_motion(self, activity: Activity, stopping: bool) -> tuple[bool, bool]:
        """Returns (motion has ended, axis is stopping for a reason not yet reported)."""
        self.core.observer.poll()
        log = self.core.log
        newest = log.newest
        for event in log.since(activity.since):
            if event.axis not in {self.index, -1}:
                continue
            if event.kind is EventKind.STOPPED:
                activity.end("the supervision stopped it")
                raise SafetyStop(f"{self.name}: {event.text}", stop_hint(event, self.name))
            if event.kind is EventKind.STATE:
                stopping = AxisState(event.code) in STOPPED
                if not stopping and event.code != AxisState.ENABLED:
                    activity.end(f"the axis became {AxisState(event.code).name.lower()}")
            elif event.id == activity.command_id and self._ended(event, activity):
                return True, stopping
        activity.since = newest
        return False, stopping

    def _ended(self, event: Event, activity: Activity) -> bool:
        """Returns True if an event reports the end of the motion; raises if it ended early."""
        if event.kind is EventKind.STREAM_REFUSED:
            activity.end(event.text)
            raise InputError(f"{self.name}: {event.text}; the axis brakes")
        if event.kind is EventKind.UNDERRUN:
            activity.end("its set-points ran out in motion, and the axis braked")
        if event.kind is not EventKind.MOTION_ENDED:
            return False
        if event.code == MotionMode.STOP:
            why = activity.over or "it was braked before its end"
            activity.end(why)
            raise RefusedError(f"{self.name}: {why}")
        activity.end("it is complete")
        return True


def stop_hint(stopped: Event, axis: str) -> str:
    """Returns advice on how to recover from a stop."""
    fault = fault_of(stopped.code)
    if stopped.id:
        return EXPLAINED_HINT
    return ROWS[fault].hint if fault is not None else reset_hint(axis)


def reset_hint(axis: str) -> str:
    """Returns advice on how to recover from a commanded stop."""
    return f"reset it when the axis may move again: hdbridge ctl reset {axis}"
