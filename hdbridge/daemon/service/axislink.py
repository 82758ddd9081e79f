"""Connection to one axis of the control process: its newest sample, commands, and the end of motions."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, Unpack
from weakref import WeakSet

from hdbridge.axis import AxisConfig
from hdbridge.daemon.loop.states import STOPPED, AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind
from hdbridge.daemon.service.core import ANSWER_S, Arguments, Core
from hdbridge.daemon.service.eventlog import stop_hint
from hdbridge.daemon.service.timing import POLL_S
from hdbridge.drive.states import State
from hdbridge.errors import DaemonError, HdbridgeError, InputError, RefusedError, SafetyStop
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


COMPLETE: Final = "it is complete"
"""Reason for the end of an activity that was not cut short."""


@dataclass(slots=True, eq=False, weakref_slot=True)
class Activity:
    """One activity, in progress until it completes or is replaced."""

    kind: Kind
    holder: str
    """Token of the lease under which the activity began."""
    command_id: int = 0
    """Id of the command to the control process that began this motion."""
    over: str = ""
    """Reason for the end; empty while the activity is in progress."""
    error: HdbridgeError | None = None
    """Stop by the supervision, or refusal of a set-point."""
    stopping: bool = False
    """True while the axis stops for a reason that is not reported yet."""

    def end(self, why: str) -> None:
        """Ends the activity; only the first reason counts."""
        self.over = self.over or why

    def take(self, event: Event, axis: str) -> None:
        """Takes an event of the axis, which is named for errors."""
        if event.kind is EventKind.STOPPED:
            self.error = SafetyStop(f"{axis}: {event.text}", stop_hint(event, axis))
            self.end("the supervision stopped it")
        elif event.kind is EventKind.STATE:
            self.stopping = event.code in STOPPED
            if not self.stopping and event.code != AxisState.ENABLED:
                self.end(f"the axis became {AxisState(event.code).name.lower()}")
        elif event.id != self.command_id:
            return
        elif event.kind is EventKind.STREAM_REFUSED:
            self.error = InputError(f"{axis}: {event.text}; the axis brakes")
            self.end(event.text)
        elif event.kind is EventKind.UNDERRUN:
            self.end("its set-points ran out in motion, and the axis braked")
        elif event.kind is EventKind.MOTION_ENDED:
            self.end("it was braked before its end" if event.code == MotionMode.STOP else COMPLETE)


@dataclass(frozen=True, slots=True)
class Request:
    """A client's request for power or motion, in force until a stop of the axis or the end of the lease."""

    link: "AxisLink"
    holder: str
    """Token of the lease under which the request was made."""
    stops: int
    """Value of `AxisLink.stops` at the time of the request."""

    def check(self) -> None:
        """Raises LeaseError or RefusedError if the request is no longer in force.

        Must be called just before a command that leads to power or motion, without a wait between the two.
        """
        self.link.core.lease.check(self.holder, renew=False)
        self.check_not_stopped()

    def check_not_stopped(self) -> None:
        """Raises RefusedError if the axis was stopped since the request. Thread-safe."""
        if self.link.stops != self.stops:
            raise RefusedError(f"{self.link.name}: {self.link.stopped_by}")


class AxisLink:
    """Connection to one axis; ``index`` is its index in the shared memory."""

    def __init__(self, core: Core, index: int, config: AxisConfig) -> None:
        self.core = core
        self.index = index
        self.config = config
        self.name = config.name
        self.stops = 0
        """Number of stops requested so far."""
        self.stopped_by = ""
        """Reason for the last of them."""
        self._activities: WeakSet[Activity] = WeakSet()

    # ---------------------------------------------------------------- the newest cycle

    def value(self, field: str) -> float:
        """Returns a field of `AXIS_SAMPLE` in the newest cycle; 0 before the first."""
        newest = self.core.newest
        return float(newest[0]["axes"][self.index][field]) if newest is not None else 0.0

    @property
    def state(self) -> AxisState:
        """State of the axis in the control process."""
        return AxisState(int(self.value("state")))

    @property
    def power(self) -> State:
        """The drive's power state."""
        newest = self.core.newest
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

    def request(self, holder: str) -> Request:
        """Returns a request made now by the holder of the lease."""
        return Request(self, holder, self.stops)

    def withdraw_requests(self, why: str) -> None:
        """Withdraws all requests made so far, because of a stop."""
        self.stopped_by = why
        self.stops += 1

    async def do(
        self, kind: CommandKind, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]
    ) -> Event:
        """Runs `Core.do` for this axis."""
        return await self.core.do(kind, self.index, within_s, **arguments)

    async def begin(self, activity: Activity, kind: CommandKind, **arguments: Unpack[Arguments]) -> None:
        """Runs `do` for the command that begins the motion of an activity."""
        activity.command_id = self.core.post(kind, self.index, **arguments)
        self.follow(activity)
        await self.core.answer(kind, activity.command_id)

    def follow(self, activity: Activity) -> None:
        """Passes the events of the axis to an activity from now on, as long as it is referred to."""
        self._activities.add(activity)

    def on_event(self, event: Event) -> None:
        """Takes an event of the axis."""
        for activity in self._activities:
            activity.take(event, self.name)

    async def arrival(self, activity: Activity, waiting: Activity | None = None) -> None:
        """Waits until a motion has ended.

        ``waiting`` is the activity that waits, if it is a different one; the wait ends with it. Raises
        SafetyStop if the supervision stopped the motion, RefusedError if another activity replaced it,
        InputError if one of its set-points was refused, and DaemonError if the control process is gone.
        """
        core = self.core
        while True:
            core.poll()
            if activity.error is not None:
                raise activity.error
            if activity.over == COMPLETE:
                return
            why = activity.over or (waiting.over if waiting is not None else "")
            if why and not activity.stopping:
                raise RefusedError(f"{self.name}: {why}")
            if not core.alive:
                raise DaemonError(
                    f"{self.name}: the control process has completed no cycle lately: it hangs or has died; "
                    "the drive stops automatically, and the axis will be disabled"
                )
            await core.timing.sleep(POLL_S)
