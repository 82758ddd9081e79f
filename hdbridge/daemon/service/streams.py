"""Streams: set-points of a client, sent to the control process as knots with velocities.

A point without a velocity takes the slope between its neighbours, so it waits for the next point; the last
point of a stream is at rest. The stream begins once it has `LEAD_S` of path or its end, so the client may lag
by that time.
"""

from collections.abc import Sequence
from itertools import pairwise
from types import TracebackType
from typing import Final, Self

from hdbridge.client.messages import StreamPoint
from hdbridge.daemon.memory import CommandKind, Knot
from hdbridge.daemon.service.axislink import Activity, AxisLink
from hdbridge.errors import InputError, RefusedError

LEAD_S: Final = 0.1
"""Duration of buffered path before a stream begins."""
ROOM_POLL_S: Final = 0.02
BEGIN_DEG: Final = 1e-6
"""Maximum distance between the first point of a stream and the axis's position."""


class Knots:
    """Converts the points of a stream to knots. Pure.

    ``begin_deg`` is the position of the axis, at rest at time 0.
    """

    def __init__(self, stream: int, begin_deg: float) -> None:
        self._stream = stream
        self._begin_deg = begin_deg
        self._before: StreamPoint | None = None
        """Last point with a knot."""
        self._held: StreamPoint | None = None
        """Newest point while its velocity is unknown."""

    def add(self, points: Sequence[StreamPoint]) -> list[Knot]:
        """Returns the knots that these points complete. InputError if any is invalid; none is then used."""
        newest = self._held or self._before
        chain = [*([newest] if newest else []), *points]
        self._check(points, chain)
        knots: list[Knot] = []
        before, held = self._before, self._held
        for point in points:
            if before is None and held is None:
                knots.append(Knot(self._stream, 0.0, self._begin_deg, 0.0))
                before = StreamPoint(time_s=0.0, position_deg=self._begin_deg, velocity_deg_s=0.0)
                if point.time_s == 0.0:
                    continue
            if held is not None:
                assert before is not None
                knots.append(self._knot(held, _slope(before, point)))
                before, held = held, None
            if point.velocity_deg_s is None:
                held = point
            else:
                knots.append(self._knot(point, point.velocity_deg_s))
                before = point
        self._before, self._held = before, held
        return knots

    def end(self) -> list[Knot]:
        """Returns the last knot, at rest, if it was held back."""
        held, self._held = self._held, None
        if held is None:
            return []
        self._before = held
        return [self._knot(held, 0.0)]

    def _knot(self, point: StreamPoint, velocity_deg_s: float) -> Knot:
        return Knot(self._stream, float(point.time_s), float(point.position_deg), float(velocity_deg_s))

    def _check(self, points: Sequence[StreamPoint], chain: Sequence[StreamPoint]) -> None:
        if points and self._before is None and self._held is None:
            first = points[0]
            if first.time_s == 0.0 and abs(first.position_deg - self._begin_deg) > BEGIN_DEG:
                raise InputError(
                    f"a stream begins at {first.position_deg:.9g} deg, but the axis stands at "
                    f"{self._begin_deg:.9g}: begin there, or move there first"
                )
            if first.time_s == 0.0 and first.velocity_deg_s:
                raise InputError(
                    f"a stream begins with {first.velocity_deg_s:g} deg/s, but the axis is at rest: begin "
                    f"at rest"
                )
        for one, next_ in pairwise(chain):
            if not next_.time_s > one.time_s:
                raise InputError(
                    f"a set-point at {next_.time_s:g} s after one at {one.time_s:g} s: each must be later "
                    "than the one before; none of these was accepted"
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
        self._begun_cycle: int | None = None
        self._last_s = 0.0
        """Time of the last knot that was sent."""
        self._ended = False

    async def put(self, points: Sequence[StreamPoint]) -> None:
        """Passes on set-points; waits while the buffer is full. Raises if the stream has ended."""
        self._check_open()
        if self._knots is None:
            await self._link.until(lambda: True, 0.0)
            self._knots = Knots(self._number, self._link.value("load_target_deg"))
        await self._hand_over(self._knots.add(points))
        if self._begun_cycle is None and self._last_s >= LEAD_S:
            await self._begin()

    async def end(self) -> None:
        """Ends the stream; returns once the axis has followed it and is at rest."""
        self._check_open()
        if self._knots is None:
            self._ended = True
            self._activity.end("it came to its end")
            return
        await self._hand_over(self._knots.end())
        if self._begun_cycle is None:
            await self._begin()
        self._ended = True
        await self._link.do(CommandKind.STREAM_END)
        await self._link.arrival(self._activity)

    async def _begin(self) -> None:
        core = self._link.core
        self._activity.since = core.log.newest
        answer = await self._link.do(CommandKind.STREAM_BEGIN, a=float(self._timeout_s), j=self._number)
        self._activity.command_id = answer.id
        self._begun_cycle = answer.cycle

    async def _hand_over(self, knots: Sequence[Knot]) -> None:
        while knots:
            taken = self._queue.put(knots)
            if taken:
                self._last_s = knots[taken - 1].time_s
            knots = knots[taken:]
            if knots:
                if self._begun_cycle is None:
                    await self._begin()
                await self._link.core.timing.sleep(ROOM_POLL_S)
                self._check_open()

    def _check_open(self) -> None:
        """Raises RefusedError with the reason if the stream has ended, LeaseError if the lease has."""
        self._link.core.lease.check(self._activity.holder)
        if self._begun_cycle is not None and not self._ended:
            self._link.look(self._activity)
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
