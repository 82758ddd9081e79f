"""Motion of one axis for clients: moves, jogs, streams and a queue of way points.

The newest request wins: a move replaces any present motion and clears the queue. The control process decides
if a motion is possible, before the present one changes.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Final

from hdbridge.client.messages import QueueItem
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind
from hdbridge.daemon.service.axislink import ENDS_WITH_LEASE, Activity, AxisLink, Kind
from hdbridge.daemon.service.streams import ServiceStream
from hdbridge.errors import HdbridgeError, InputError, RefusedError
from hdbridge.motion import MotionMode

QUEUE_MOST: Final = 1000
"""Maximum number of waiting way points."""


class AxisMotion:
    """The present motion of one axis and its queue. Every method that begins a motion requires the lease."""

    def __init__(self, link: AxisLink, check: Callable[[str], None]) -> None:
        """``check`` raises if the holder of this token may not move the axis."""
        self._link, self._check = link, check
        self.activity: Activity | None = None
        self._points: deque[QueueItem] = deque()
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

    async def move(
        self,
        holder: str,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> None:
        """Moves to ``target_deg``, or redirects a present motion there; with ``wait`` returns at rest there.

        Raises RefusedError if another command replaced this one before its end.
        """
        self._check(holder)
        self._check_target(target_deg)
        activity = Activity(Kind.MOVE, holder)
        async with self.commanding:
            await self._goto(activity, target_deg, velocity_deg_s, acceleration_deg_s2)
            self.replace(activity, "another move took its place")
        if wait:
            await self._link.arrival(activity)

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float = 0.5) -> None:
        """Turns at a speed; brakes to rest unless called again within ``timeout_s``."""
        self._check(holder)
        activity = Activity(Kind.JOG, holder)
        async with self.commanding:
            activity.since = self._link.core.log.newest
            answer = await self._link.do(CommandKind.JOG, a=float(velocity_deg_s), b=float(timeout_s))
            activity.command_id = answer.id
            self.replace(activity, "a jog took its place")

    async def stream(self, holder: str, timeout_s: float = 0.5) -> ServiceStream:
        """Opens a stream of set-points. It begins at rest, with the first set-points that are put.

        If none come for ``timeout_s`` and all are used up, the axis brakes to rest.
        """
        self._check(holder)
        activity = Activity(Kind.STREAM, holder)
        async with self.commanding:
            link = self._link
            if link.state is not AxisState.ENABLED:
                await link.do(CommandKind.STREAM_BEGIN, a=timeout_s)  # refused, with the reason
            stream = ServiceStream(link, activity, timeout_s)
            self.replace(activity, "a stream took its place")
        return stream

    async def queue(self, holder: str, points: Sequence[QueueItem]) -> int:
        """Appends all or none of these moves, each begun when the one before has ended.

        Returns the number of waiting moves. Raises InputError for an invalid point, RefusedError if another
        motion is under way or the queue is full.
        """
        self._check(holder)
        name = self._link.name
        for point in points:
            self._check_target(point.target_deg)
        if self.busy(Kind.JOG, Kind.STREAM, Kind.COORDINATED):
            assert self.activity is not None
            raise RefusedError(
                f"{name}: {self.activity.kind.value} is under way; stop it, or wait for its end"
            )
        if self.queued + len(points) > QUEUE_MOST:
            raise RefusedError(f"{name}: {self.queued} way points wait; more than {QUEUE_MOST} are not taken")
        if points and self._link.state is not AxisState.ENABLED:
            await self.move(holder, points[0].target_deg)  # refused, with the reason
        self._points.extend(points)
        if self.busy(Kind.QUEUE):
            assert self.activity is not None
            self.activity.holder = holder
        elif points:
            before, self.activity = self.activity, Activity(Kind.QUEUE, holder)
            self._start(self._run(self.activity, before))
        return self.queued

    async def clear_queue(self, holder: str) -> int:
        """Discards the waiting moves and returns their number. The present move continues."""
        self._check(holder)
        forgotten = self.queued
        self._points.clear()
        return forgotten

    async def end_without_lease(self) -> None:
        """Stops an activity that must end with its lease, if that lease has ended."""
        if not self._is_without_lease():
            return
        async with self.commanding:
            # Another client's motion may have replaced it meanwhile; that one continues.
            activity, link = self.activity, self._link
            if activity is None or not self._is_without_lease():
                return
            self.replace(None, "the lease has ended")
            if activity.kind is Kind.JOG and link.value("mode") == MotionMode.HOLD:
                return  # its time-out has stopped it already
            link.core.log.note(
                f"{activity.kind.value} was stopped: the lease of its client has ended", link.index
            )
            await link.do(CommandKind.STOP)

    def _is_without_lease(self) -> bool:
        activity, lease = self.activity, self._link.core.lease
        return activity is not None and self.busy(*ENDS_WITH_LEASE) and not lease.holds(activity.holder)

    async def close(self) -> None:
        """Ends the queue; the axis completes its present motion."""
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _goto(
        self, activity: Activity, target_deg: float, velocity: float | None, acceleration: float | None
    ) -> None:
        activity.since = self._link.core.log.newest
        answer = await self._link.do(
            CommandKind.MOVE,
            a=float(target_deg),
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
                    await self._goto(
                        activity, point.target_deg, point.velocity_deg_s, point.acceleration_deg_s2
                    )
                    # The queue may have been cleared while this move was being sent.
                    if not activity.over and self._points and self._points[0] is point:
                        self._points.popleft()
                # Waits for this move, whose end is not that of the queue.
                move = Activity(Kind.MOVE, activity.holder, activity.command_id, activity.since)
                await link.arrival(move, activity)
                await link.until(lambda: bool(activity.over), point.dwell_s)
        except HdbridgeError as error:
            if self.activity is activity:
                self._points.clear()
                link.core.log.note(f"the queue of way points has ended: {error}", link.index)
        finally:
            activity.end("the queue came to its end")

    def _check_target(self, target_deg: float) -> None:
        limits = self._link.config.limits
        if not (math.isfinite(target_deg) and limits.contains(target_deg)):
            raise InputError(
                f"{self._link.name}: a target of {target_deg!r} deg; the position limits are "
                f"{limits.position_min_deg:g} and {limits.position_max_deg:g} deg; nothing of it was begun"
            )

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
