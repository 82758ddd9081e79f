"""Motion of one axis for clients: moves, jogs, streams and a queue of way points.

The newest request wins: a move replaces any present motion and clears the queue. The control process decides
if a motion is possible, before the present one changes.
"""

import asyncio
import math
from collections import deque
from collections.abc import Coroutine, Sequence
from typing import Any, Final, NamedTuple

from hdbridge.axis.config import Limits
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind
from hdbridge.daemon.service.activity import ENDS_WITH_LEASE, Activity, Kind
from hdbridge.daemon.service.axislink import AxisLink
from hdbridge.daemon.service.streams import ServiceStream
from hdbridge.errors import HdbridgeError, InputError, RefusedError

QUEUE_MOST: Final = 1000
"""Maximum number of waiting way points."""


class WayPoint(NamedTuple):
    """One move of a queue."""

    target_deg: float
    velocity_deg_s: float | None = None
    """Maximum velocity; None for the axis's limit."""
    acceleration_deg_s2: float | None = None
    """Maximum acceleration; None for the axis's limit."""
    dwell_s: float = 0.0
    """Rest before the next move."""


class AxisMotion:
    """The present motion of one axis and its queue."""

    def __init__(self, link: AxisLink, limits: Limits) -> None:
        self._link = link
        self._limits = limits
        self.activity: Activity | None = None
        self._points: deque[WayPoint] = deque()
        self.commanding = asyncio.Lock()
        """Held while one motion replaces another."""
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def queued(self) -> int:
        """Number of waiting way points."""
        return len(self._points)

    def busy(self, *kinds: Kind) -> bool:
        """Returns True if an activity of one of these kinds is under way."""
        activity = self.activity
        return activity is not None and not activity.over and activity.kind in kinds

    def replace(self, activity: Activity | None, why: str) -> None:
        """Replaces the present activity by another or none, and clears the queue."""
        if self.activity is not None:
            self.activity.end(why)
        self._points.clear()
        self.activity = activity

    def without_lease(self) -> bool:
        """Returns True if the present activity must stop because the lease under which it began has ended."""
        activity = self.activity
        return (
            self.busy(*ENDS_WITH_LEASE)
            and activity is not None
            and not self._link.core.lease.holds(activity.holder)
        )

    async def move(self, holder: str, point: WayPoint) -> Activity:
        """Begins a move, from rest or during any motion."""
        self._check(point)
        activity = Activity(Kind.MOVE, holder)
        async with self.commanding:
            await self._goto(activity, point)
            self.replace(activity, "another move took its place")
        return activity

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float) -> None:
        """Turns at a speed until the time-out."""
        activity = Activity(Kind.JOG, holder)
        async with self.commanding:
            activity.since = self._link.core.log.newest
            answer = await self._link.do(CommandKind.JOG, a=float(velocity_deg_s), b=float(timeout_s))
            activity.command_id = answer.id
            self.replace(activity, "a jog took its place")

    async def stream(self, holder: str, timeout_s: float) -> ServiceStream:
        """Opens a stream, which begins with the first set-points that are put."""
        activity = Activity(Kind.STREAM, holder)
        async with self.commanding:
            link = self._link
            if link.state is not AxisState.ENABLED:
                await link.do(CommandKind.STREAM_BEGIN, a=timeout_s)  # refused, with the reason
            stream = ServiceStream(link, activity, timeout_s)
            self.replace(activity, "a stream took its place")
        return stream

    async def queue(self, holder: str, points: Sequence[WayPoint]) -> int:
        """Appends all or none of these moves, each begun when the one before has ended.

        Returns the number of waiting moves. Raises InputError for an invalid point, RefusedError if another
        motion is under way or the queue is full.
        """
        name = self._link.name
        for point in points:
            self._check(point)
        if self.busy(Kind.JOG, Kind.STREAM, Kind.COORDINATED):
            assert self.activity is not None
            raise RefusedError(
                f"{name}: {self.activity.kind.value} is under way; stop it, or wait for its end"
            )
        if self.queued + len(points) > QUEUE_MOST:
            raise RefusedError(f"{name}: {self.queued} way points wait; more than {QUEUE_MOST} are not taken")
        if points and self._link.state is not AxisState.ENABLED:
            await self.move(holder, points[0])  # refused, with the reason
        self._points.extend(points)
        if self.busy(Kind.QUEUE):
            assert self.activity is not None
            self.activity.holder = holder
        elif points:
            before, self.activity = self.activity, Activity(Kind.QUEUE, holder)
            self._start(self._run(self.activity, before))
        return self.queued

    def clear_queue(self) -> int:
        """Discards the waiting moves and returns their number."""
        forgotten = self.queued
        self._points.clear()
        return forgotten

    async def close(self) -> None:
        """Ends the queue; the axis completes its present motion."""
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _goto(self, activity: Activity, point: WayPoint) -> None:
        activity.since = self._link.core.log.newest
        velocity, acceleration = point.velocity_deg_s, point.acceleration_deg_s2
        answer = await self._link.do(
            CommandKind.MOVE,
            a=float(point.target_deg),
            b=math.nan if velocity is None else float(velocity),
            c=math.nan if acceleration is None else float(acceleration),
        )
        activity.command_id = answer.id

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
                    point = self._points[0]
                    await self._goto(activity, point)
                    # The queue may have been cleared while this move was being sent.
                    if not activity.over and self._points and self._points[0] is point:
                        self._points.popleft()
                await self._leg(activity)
                await link.until(lambda: bool(activity.over), point.dwell_s)
        except HdbridgeError as error:
            if self.activity is activity:
                self._points.clear()
                link.core.log.note(f"the queue of way points has ended: {error}", link.index)
        finally:
            activity.end("the queue came to its end")

    async def _leg(self, activity: Activity) -> None:
        """Waits for the end of one move of the queue, without ending the queue."""
        move = Activity(Kind.MOVE, activity.holder, activity.command_id, activity.since)
        await self._link.arrival(move, activity)

    def _check(self, point: WayPoint) -> None:
        limits, name = self._limits, self._link.name
        if not (math.isfinite(point.target_deg) and limits.contains(point.target_deg)):
            raise InputError(
                f"{name}: a target of {point.target_deg!r} deg; the position limits are "
                f"{limits.position_min_deg:g} and {limits.position_max_deg:g} deg; nothing of it was begun"
            )
        for what, value in (("velocity", point.velocity_deg_s), ("acceleration", point.acceleration_deg_s2)):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"{name}: a {what} of {value!r}; expected a finite number above 0")
        if not (math.isfinite(point.dwell_s) and point.dwell_s >= 0.0):
            raise InputError(f"{name}: a rest of {point.dwell_s!r} s; expected 0 or more")

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
