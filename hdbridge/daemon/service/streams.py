"""Streams: set-points of a client, sent to the control process as knots with velocities.

A point without a velocity takes the slope between its neighbours, so it waits for the next point; the last
point of a stream is at rest. The stream begins once `LEAD_S` of path or its end has been received, so the
client may lag by that time.
"""

from collections.abc import Sequence
from itertools import pairwise
from types import TracebackType
from typing import Final, Self

from hdbridge.client.messages import StreamPoint
from hdbridge.daemon.memory import CommandKind, Knot
from hdbridge.daemon.service.axislink import COMPLETE, Activity, AxisLink
from hdbridge.errors import InputError, RefusedError

LEAD_S: Final = 0.1
"""Duration of buffered path before a stream begins."""
ROOM_POLL_S: Final = 0.02
BEGIN_DEG: Final = 1e-6
"""Maximum distance between the first point of a stream and the axis's position."""


class Knots:
    """Converts the points of a stream to knots, without I/O.

    ``begin_deg`` is the position of the axis, at rest at time 0.
    """

    def __init__(self, stream: int, begin_deg: float) -> None:
        self._stream = stream
        self._begin = StreamPoint(time_s=0.0, position_deg=begin_deg, velocity_deg_s=0.0)
        self._last: list[StreamPoint] = []
        """Last point with a knot, and the newest point while its velocity is unknown."""

    def add(self, points: Sequence[StreamPoint]) -> list[Knot]:
        """Returns the knots that these points complete.

        Raises InputError if a point is invalid; none of the points is used then.
        """
        if not points:
            return []
        knots: list[Knot] = []
        chain = [*self._last, *points]
        if not self._last:
            self._check_begin(points[0])
            knots.append(self._knot(self._begin, 0.0))
            chain = [self._begin, *points[points[0].time_s == 0.0 :]]
        for one, next_ in pairwise(chain):
            if not next_.time_s > one.time_s:
                raise InputError(
                    f"a set-point at {next_.time_s:g} s after one at {one.time_s:g} s: each must be later "
                    "than the one before; none of these was accepted"
                )
        for before, point, after in zip(chain, chain[1:], [*chain[2:], None], strict=False):
            if point.velocity_deg_s is not None:
                knots.append(self._knot(point, point.velocity_deg_s))
            elif after is not None:
                knots.append(self._knot(point, _slope(before, after)))
        self._last = chain[-1:] if chain[-1].velocity_deg_s is not None else chain[-2:]
        return knots

    def end(self) -> list[Knot]:
        """Returns the last knot, at rest, if it was held back."""
        return [self._knot(each, 0.0) for each in self._last[1:]]

    def _knot(self, point: StreamPoint, velocity_deg_s: float) -> Knot:
        return Knot(self._stream, float(point.time_s), float(point.position_deg), float(velocity_deg_s))

    def _check_begin(self, first: StreamPoint) -> None:
        begin_deg = self._begin.position_deg
        if first.time_s == 0.0 and abs(first.position_deg - begin_deg) > BEGIN_DEG:
            raise InputError(
                f"a stream begins at {first.position_deg:.9g} deg, but the axis is at {begin_deg:.9g}: "
                "begin there, or move there first"
            )
        if first.time_s == 0.0 and first.velocity_deg_s:
            raise InputError(
                f"a stream begins with {first.velocity_deg_s:g} deg/s, but the axis is at rest: begin at rest"
            )


def _slope(one: StreamPoint, other: StreamPoint) -> float:
    return (other.position_deg - one.position_deg) / (other.time_s - one.time_s)


class ServiceStream:
    """Open stream of set-points, an asynchronous context manager; the stream ends with the block."""

    def __init__(self, link: AxisLink, activity: Activity, timeout_s: float) -> None:
        """The stream belongs to ``activity`` and ends with it."""
        self._link = link
        self._activity = activity
        self._timeout_s = timeout_s
        self._number = link.core.next_stream()
        self._knots: Knots | None = None
        self._queue = link.core.memory.knots[link.index]
        self._has_begun = False
        self._last_s = 0.0
        """Time of the last knot that was sent."""
        self._ended = False

    async def put(self, points: Sequence[StreamPoint]) -> None:
        """Passes on set-points; waits while the buffer is full. Raises if the stream has ended."""
        self._check_open()
        if self._knots is None:
            self._link.core.poll()
            self._knots = Knots(self._number, self._link.value("load_target_deg"))
        await self._hand_over(self._knots.add(points))
        if not self._has_begun and self._last_s >= LEAD_S:
            await self._begin()

    async def end(self) -> None:
        """Ends the stream; returns once the axis has followed it and is at rest."""
        self._check_open()
        if self._knots is None:
            self._ended = True
            self._activity.end(COMPLETE)
            return
        await self._hand_over(self._knots.end())
        if not self._has_begun:
            await self._begin()
        self._ended = True
        await self._link.do(CommandKind.STREAM_END)
        await self._link.arrival(self._activity)

    async def _begin(self) -> None:
        begin = CommandKind.STREAM_BEGIN
        await self._link.begin(self._activity, begin, a=float(self._timeout_s), j=self._number)
        self._has_begun = True

    async def _hand_over(self, knots: Sequence[Knot]) -> None:
        while knots:
            taken = self._queue.put(knots)
            if taken:
                self._last_s = knots[taken - 1].time_s
            knots = knots[taken:]
            if knots:
                if not self._has_begun:
                    await self._begin()
                await self._link.core.timing.sleep(ROOM_POLL_S)
                self._check_open()

    def _check_open(self) -> None:
        """Raises RefusedError with the reason if the stream has ended, LeaseError if the lease has."""
        self._link.core.lease.check(self._activity.holder)
        self._link.core.poll()
        if self._activity.error is not None:
            raise self._activity.error
        if self._activity.over or self._ended:
            why = self._activity.over or "it was ended"
            raise RefusedError(f"{self._link.name}: the stream has ended: {why}")

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Calls `end` unless the stream is over or the block failed.

        After a failure, the axis brakes once the buffer is used up.
        """
        if error is None and not (self._activity.over or self._ended):
            await self.end()
