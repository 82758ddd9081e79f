"""One axis, for the client with asyncio."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from hdbridge.client import sockets
from hdbridge.client.axis import JOG_S, POLL_S
from hdbridge.client.calls import AxisCalls, given
from hdbridge.client.messages import (
    AdaptationMode,
    AxisState,
    Job,
    JobKind,
    QueueItem,
    Scheme,
    SdoValue,
    StreamAnswer,
    StreamBegin,
)
from hdbridge.errors import LeaseError, SafetyStop

if TYPE_CHECKING:
    from hdbridge.client.aio import AsyncClient, AsyncLink


class AsyncAxis:
    """One axis. What moves returns when the axis rests again, unless it is told not to wait."""

    def __init__(self, client: AsyncClient, name: str) -> None:
        self.client = client
        self.name = name
        self._calls = AxisCalls(name)

    async def state(self) -> AxisState:
        """Everything about it."""
        return await self.client.do(self._calls.state())

    async def enable(self) -> AxisState:
        """Switch power on, standing still; the drive is booted and verified first where it is not."""
        return await self.client.do(self._calls.enable())

    async def disable(self) -> AxisState:
        """Brake to rest, then switch power off."""
        return await self.client.do(self._calls.disable())

    async def reset(self) -> AxisState:
        """Release a latched stop; it stays disabled."""
        return await self.client.do(self._calls.reset())

    async def stop(self) -> AxisState:
        """Brake to rest and stay enabled; needs no lease."""
        return await self.client.do(self._calls.stop())

    async def quick_stop(self) -> AxisState:
        """Stop at once, latched until a reset; needs no lease."""
        return await self.client.do(self._calls.quick_stop())

    async def home(self, method: int, **values: float | None) -> AxisState:
        """Home by a method of the drive's own; ``values`` are those of `messages.Home`."""
        return await self.client.do(self._calls.home(method, **values))

    async def move(
        self,
        target_deg: float,
        *,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> AxisState:
        """Go to a load angle, degrees; an axis in motion is re-targeted without a stop."""
        return await self.client.do(self._calls.move(target_deg, velocity_deg_s, acceleration_deg_s2, wait))

    async def jog(self, velocity_deg_s: float, duration_s: float | None = None) -> AxisState:
        """Turn at a speed for a time, then brake; without a time it has to be called again within `JOG_S`.

        LeaseError without a time where the lease is not held: it would end with this call.
        """
        call = self._calls.jog(velocity_deg_s, JOG_S)
        if duration_s is None:
            self._need_lease("jog without a duration")
            return await self.client.do(call)
        until = time.monotonic() + duration_s
        async with self.client.lease():
            while (left_s := until - time.monotonic()) > 0:
                await self.client.do(call)
                await asyncio.sleep(min(left_s, JOG_S / 3))
            return await self.stop()

    async def queue(self, points: Sequence[QueueItem | float], *, wait: bool = True) -> AxisState:
        """Append way points (load angles, or with their limits) and wait until the last is reached."""
        call = self._calls.queue(points)
        if not wait:
            self._need_lease("a queue that is not waited for")
            return await self.client.do(call)
        async with self.client.lease():
            await self.client.do(call)
            return await self.rest()

    async def clear_queue(self) -> AxisState:
        """Forget the way points that have not begun."""
        return await self.client.do(self._calls.clear_queue())

    async def rest(self) -> AxisState:
        """Wait until it rests and nothing waits; SafetyStop where it was stopped."""
        while True:
            found = await self.state()
            if found.fault is not None:
                raise SafetyStop(f"axis '{self.name}': {found.fault}")
            if found.at_rest and found.queued == 0 and found.mode == "hold":
                return found
            await asyncio.sleep(POLL_S)

    @asynccontextmanager
    async def stream(self, timeout_s: float = JOG_S) -> AsyncIterator[AsyncStream]:
        """Follow set-points that are put within the block, and rest at the last one when it ends.

        The first one is where the axis stands. It brakes when no point is left for ``timeout_s``, and when an
        error leaves the block.
        """
        begin = given(StreamBegin, lease="", timeout_s=timeout_s)
        async with self.client.lease() as grant, self.client.connected(f"{self._calls.path}/stream") as link:
            stream = AsyncStream(link)
            await stream.exchange(begin.model_copy(update={"lease": grant.token}))
            yield stream
            await stream.end()

    async def compensate(self, scheme: Scheme | str) -> AxisState:
        """Compensate by this part of the model; ``none`` switches it off."""
        return await self.client.do(self._calls.compensate(scheme))

    async def activate_model(self, version: int | str) -> AxisState:
        """Use another model: its number in the history, ``pending`` or ``active``."""
        return await self.client.do(self._calls.activate_model(version))

    async def load_loop(self, on: bool) -> AxisState:
        """Switch the slow integral of the measured error on or off."""
        return await self.client.do(self._calls.load_loop(on))

    async def adapt(self, mode: AdaptationMode | str) -> AxisState:
        """``off``, ``observe`` or ``on``."""
        return await self.client.do(self._calls.adapt(mode))

    async def adaptation_back(self) -> AxisState:
        """Take back what the adaptation changed."""
        return await self.client.do(self._calls.adaptation_back())

    async def read(self, object_: str) -> SdoValue:
        """An object of the drive: its number (6064h, 0x1018:4) or its name in the EDS."""
        return await self.client.do(self._calls.read(object_))

    async def write(self, object_: str, value: int | float | str) -> SdoValue:
        """Write one; refused while the axis is enabled."""
        return await self.client.do(self._calls.write(object_, str(value)))

    async def job(self, kind: JobKind | str, *, wait: bool = True, **options: Any) -> Job:
        """Run a procedure: ``step``, ``calibrate``, ``improve``, with the options of that command."""
        begun = await self.client.do(self._calls.job(kind, options))
        return await self.client.wait_for_job(begun.id) if wait else begun

    def _need_lease(self, what: str) -> None:
        if not self.client.holds_lease:
            raise LeaseError(f"{what} ends with the lease: use it within 'async with client.lease():'")


class AsyncStream:
    """Set-points under way."""

    def __init__(self, link: AsyncLink) -> None:
        self._link = link
        self._ended = False

    async def put(self, points: Iterable[sockets.Point]) -> None:
        """Hand over points: (time s, load angle deg) or (time, angle, speed deg/s), times since the begin.

        Waits while the daemon has enough of them. InputError where one is refused: the axis brakes.
        """
        for each in sockets.parts(points, end=False):
            await self.exchange(each)

    async def end(self) -> None:
        """No more points come; returns when the axis rests at the last one."""
        if not self._ended:
            self._ended = True
            (last,) = sockets.parts((), end=True)
            await self.exchange(last)

    async def exchange(self, message: BaseModel) -> None:
        """Send a message and take its answer."""
        await self._link.send(message)
        answer = await self._link.receive(StreamAnswer)
        if answer.problem is not None:
            self._ended = True
            raise answer.problem.error()
