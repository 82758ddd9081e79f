"""Motion of one axis for clients: moves, jogs, streams and a queue of way points.

The newest request takes precedence: a move replaces any motion in progress and clears the queue. The control
process decides whether a motion is possible, before the motion in progress changes. In a coordinated move,
several axes follow one plan, as streams that begin in the same cycle.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Final

from hdbridge.client.messages import QueueItem
from hdbridge.control.bench import axis_view
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Knot
from hdbridge.daemon.service.axislink import ENDS_WITH_LEASE, Activity, AxisLink, Kind
from hdbridge.daemon.service.streams import ServiceStream
from hdbridge.errors import HdbridgeError, InputError, RefusedError
from hdbridge.motion import MotionMode, coordinated

if TYPE_CHECKING:
    from hdbridge.daemon.service.axis import ServiceAxis

QUEUE_MOST: Final = 1000
"""Maximum number of waiting way points."""
STREAM_TIMEOUT_S: Final = 5.0
ROOM_POLL_S: Final = 0.05


class AxisMotion:
    """Current motion of one axis and its queue. Every method that begins a motion requires the lease."""

    def __init__(self, link: AxisLink, check: Callable[[str], None]) -> None:
        """``check`` raises LeaseError unless it is called with the token of the lease's current holder."""
        self._link, self._check = link, check
        self.activity: Activity | None = None
        self._points: deque[QueueItem] = deque()
        self.commanding = asyncio.Lock()
        """Held while one motion replaces another."""

    @property
    def queued(self) -> int:
        """Number of waiting way points."""
        return len(self._points)

    def in_progress(self, *kinds: Kind) -> Activity | None:
        """Returns the activity in progress if it is of one of these kinds."""
        activity = self.activity
        return activity if activity is not None and not activity.over and activity.kind in kinds else None

    def replace(self, activity: Activity | None, why: str) -> None:
        """Ends the current activity, clears the queue, and makes ``activity`` (if any) the current one."""
        if self.activity is not None:
            self.activity.end(why)
        self._points.clear()
        self.activity = activity

    async def move(
        self,
        holder: str,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> None:
        """Moves to ``target_deg``, or redirects a motion in progress; with ``wait``, returns at rest there.

        Raises RefusedError if another command replaced this move before its end.
        """
        self._check(holder)
        self._check_target(target_deg)
        activity, request = Activity(Kind.MOVE, holder), self._link.request(holder)
        async with self.commanding:
            request.check()
            await self._goto(activity, target_deg, velocity_deg_s, acceleration_deg_s2)
            self.replace(activity, "it was replaced by another move")
        if wait:
            await self._link.arrival(activity)

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float = 0.5) -> None:
        """Turns at a speed; brakes to rest unless called again within ``timeout_s``."""
        self._check(holder)
        activity, request = Activity(Kind.JOG, holder), self._link.request(holder)
        async with self.commanding:
            request.check()
            await self._link.begin(activity, CommandKind.JOG, a=float(velocity_deg_s), b=float(timeout_s))
            self.replace(activity, "it was replaced by a jog")

    async def stream(self, holder: str, timeout_s: float = 0.5) -> ServiceStream:
        """Opens a stream of set-points, which begins at rest with the first set-points.

        If none arrive for ``timeout_s`` and all are used up, the axis brakes to rest.
        """
        self._check(holder)
        activity, request = Activity(Kind.STREAM, holder), self._link.request(holder)
        async with self.commanding:
            request.check()
            link = self._link
            if link.state is not AxisState.ENABLED:
                await link.do(CommandKind.STREAM_BEGIN, a=timeout_s)  # raises RefusedError with the reason
            stream = ServiceStream(link, activity, timeout_s)
            self.replace(activity, "it was replaced by a stream")
        return stream

    async def queue(self, holder: str, points: Sequence[QueueItem]) -> None:
        """Appends all or none of these moves, each of which begins at the end of the one before.

        Raises InputError for an invalid point, RefusedError if another motion is in progress or the queue is
        full.
        """
        self._check(holder)
        name = self._link.name
        for point in points:
            self._check_target(point.target_deg)
        if (other := self.in_progress(Kind.JOG, Kind.STREAM, Kind.COORDINATED)) is not None:
            raise RefusedError(f"{name}: {other.kind.value} is in progress; stop it, or wait for its end")
        if self.queued + len(points) > QUEUE_MOST:
            raise RefusedError(f"{name}: {self.queued} way points are waiting; the maximum is {QUEUE_MOST}")
        if points and self._link.state is not AxisState.ENABLED:
            await self.move(holder, points[0].target_deg)  # raises RefusedError with the reason
        self._points.extend(points)
        if (present := self.in_progress(Kind.QUEUE)) is not None:
            present.holder = holder
        elif points:
            before, self.activity = self.activity, Activity(Kind.QUEUE, holder)
            self._link.core.start(self._run(self.activity, before))

    async def clear_queue(self, holder: str) -> None:
        """Discards the waiting moves. The current move continues."""
        self._check(holder)
        self._points.clear()

    async def end_without_lease(self) -> None:
        """Stops an activity that must end with its lease, if that lease has ended."""
        if self._without_lease() is None:
            return
        async with self.commanding:
            # Another client's motion may have replaced it meanwhile; that one continues.
            activity, link = self._without_lease(), self._link
            if activity is None:
                return
            self.replace(None, "the lease has ended")
            if activity.kind is Kind.JOG and link.value("mode") == MotionMode.HOLD:
                return  # its time-out has stopped it already
            link.core.log.note(
                f"{activity.kind.value} was stopped: the lease of its client has ended", link.index
            )
            await link.do(CommandKind.STOP)

    def _without_lease(self) -> Activity | None:
        activity, lease = self.in_progress(*ENDS_WITH_LEASE), self._link.core.lease
        return None if activity is None or lease.holds(activity.holder) else activity

    async def _goto(
        self, activity: Activity, target_deg: float, velocity: float | None, acceleration: float | None
    ) -> None:
        await self._link.begin(
            activity,
            CommandKind.MOVE,
            a=float(target_deg),
            b=math.nan if velocity is None else float(velocity),
            c=math.nan if acceleration is None else float(acceleration),
        )

    async def _run(self, activity: Activity, before: Activity | None) -> None:
        """Runs the way points in turn, until none is left or another activity replaces the queue."""
        link = self._link
        try:
            if before is not None and before.kind is Kind.MOVE and not before.over:
                await link.arrival(before, activity)
            while self._points and not activity.over:
                async with self.commanding:
                    if activity.over or not self._points:
                        return
                    point, move = self._points[0], Activity(Kind.MOVE, activity.holder)
                    await self._goto(move, point.target_deg, point.velocity_deg_s, point.acceleration_deg_s2)
                    # The queue may have been cleared while this move was being sent.
                    if not activity.over and self._points and self._points[0] is point:
                        self._points.popleft()
                await link.arrival(move, activity)
                await link.core.until(lambda: bool(activity.over), point.dwell_s)
        except HdbridgeError as error:
            if self.activity is activity:
                self._points.clear()
                link.core.log.note(f"the queue of way points has ended: {error}", link.index)
        finally:
            activity.end("the queue is complete")

    def _check_target(self, target_deg: float) -> None:
        limits = self._link.config.limits
        if not (math.isfinite(target_deg) and limits.contains(target_deg)):
            raise InputError(
                f"{self._link.name}: a target of {target_deg!r} deg; the position limits are "
                f"{limits.position_min_deg:g} and {limits.position_max_deg:g} deg; nothing was begun"
            )


async def run_together(
    holder: str, axes: Sequence[ServiceAxis], targets_deg: Mapping[str, float], share: float, *, wait: bool
) -> None:
    """Plans a move from the current targets and begins it on all axes in one cycle; ``wait`` awaits its end.

    Raises InputError for targets outside the limits, and RefusedError for an axis that is in motion or not
    enabled; in both cases before any motion.
    """
    for axis in axes:
        axis.check_may(holder)
    core, requests = axes[0].core, [axis.link.request(holder) for axis in axes]
    async with AsyncExitStack() as stack:
        for axis in sorted(axes, key=lambda each: each.link.index):
            await stack.enter_async_context(axis.motion.commanding)
        core.poll()
        plan = await core.timing.work(
            coordinated,
            {axis.name: axis.link.value("load_target_deg") for axis in axes},
            [dict(targets_deg)],
            {axis.name: axis_view(axis.axis.config).limits for axis in axes},
            core.memory.period_s,
            share,
        )
        stream = core.next_stream()
        waiting = {axis: [Knot(stream, *row) for row in plan.knots[axis.name].tolist()] for axis in axes}
        for request in requests:
            request.check()  # planning took a while
        _hand_over(waiting)
        begin, mask = CommandKind.STREAM_BEGIN, sum(1 << axis.link.index for axis in axes)
        id_ = core.post(begin, axes[0].link.index, a=STREAM_TIMEOUT_S, i=mask, j=stream)
        activities = {axis: Activity(Kind.COORDINATED, holder, id_) for axis in axes}
        for axis, activity in activities.items():
            axis.link.follow(activity)
        await core.answer(begin, id_)
        for axis, activity in activities.items():
            axis.motion.replace(activity, "it was replaced by a coordinated move")
    following = asyncio.ensure_future(_follow(waiting, activities))
    if wait:
        await asyncio.shield(following)  # the move is supervised even if its client disconnects
    else:
        # Retrieves the result that nobody awaits; it is in the event log.
        following.add_done_callback(lambda done: done.cancelled() or done.exception())


async def _follow(waiting: dict[ServiceAxis, list[Knot]], activities: Mapping[ServiceAxis, Activity]) -> None:
    """Waits until all axes have arrived. If one fails, stops the others and raises its error."""
    arrivals = [axis.link.arrival(activity) for axis, activity in activities.items()]
    try:
        await asyncio.gather(_feed(waiting, activities), *arrivals)
    except BaseException:
        for axis, activity in activities.items():
            if not activity.over:
                activity.end("another axis of a coordinated move did not continue")
                with suppress(HdbridgeError):
                    await axis.link.do(CommandKind.STOP)
        raise


async def _feed(waiting: dict[ServiceAxis, list[Knot]], activities: Mapping[ServiceAxis, Activity]) -> None:
    """Passes on the remaining knots as the queues empty, then ends the streams."""
    core = next(iter(waiting)).core
    while any(waiting.values()):
        await core.timing.sleep(ROOM_POLL_S)
        if any(each.over for each in activities.values()):
            return
        _hand_over(waiting)
    for axis, activity in activities.items():
        if not activity.over:
            try:
                await axis.link.do(CommandKind.STREAM_END)
            except HdbridgeError:
                if not activity.over:
                    raise


def _hand_over(waiting: dict[ServiceAxis, list[Knot]]) -> None:
    for axis, knots in waiting.items():
        del knots[: axis.core.memory.knots[axis.link.index].put(knots)]
