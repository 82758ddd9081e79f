"""Clients of a running daemon, in one process: pollers, readers of the live samples, a page, one that moves.

    python tools/bench/clients.py SOCKET

  4 poll    the machine's state five times a second
  5 watch   every sample of every axis, over a WebSocket
  1 page    like the live page: a WebSocket with as many samples as a screen shows, and once a second the
            state and the events
  1 story   repeats moves, a new target in motion, jogs, a queue, a stream, compensation off and on, and
            sometimes a quick stop and a reset

They run until standard input ends; then their observations are printed as JSON: samples received and lost,
requests, longest response time, errors.
"""

from __future__ import annotations

import asyncio
import json
import math
import random
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, Final

from hdbridge.client import AsyncClient
from hdbridge.client.aio import AsyncAxis
from hdbridge.errors import HdbridgeError

POLL_S: Final = 0.2
PAGE_HZ: Final = 50.0
KNOTS_HZ: Final = 100.0
AT_A_TIME: Final = 20
"""Number of streamed set-points per message."""
AHEAD_S: Final = 1.0
"""Time by which streamed set-points are sent ahead, s."""
QUICK_STOP_EVERY: Final = 20
"""Number of rounds of the story between two quick stops."""


class Seen:
    """Observations of all clients in this process."""

    def __init__(self) -> None:
        self.samples = self.lost = self.requests = self.points = self.rounds = 0
        self.longest_s = 0.0
        self.errors: Counter[str] = Counter()

    @asynccontextmanager
    async def request(self) -> AsyncIterator[None]:
        """Counts the request in the block and records the longest duration."""
        begin_s = time.monotonic()
        yield
        self.requests += 1
        self.longest_s = max(self.longest_s, time.monotonic() - begin_s)

    def report(self) -> dict[str, Any]:
        """Returns the JSON object."""
        return {**vars(self), "errors": dict(self.errors.most_common(20))}


async def poll(client: AsyncClient, seen: Seen) -> None:
    """Polls the machine's state periodically."""
    while True:
        async with seen.request():
            await client.state()
        await asyncio.sleep(POLL_S)


async def watch(client: AsyncClient, seen: Seen, every: int = 1) -> None:
    """Reads the live samples."""
    async for samples in client.live(every=every):
        seen.samples += len(samples.cycle)
        seen.lost += samples.lost


async def page(client: AsyncClient, seen: Seen) -> None:
    """Sends the requests that the live page sends."""
    state = await client.state()
    every = max(1, round(1.0 / (PAGE_HZ * state.cycle.period_s)))

    async def ask() -> None:
        newest = 0
        while True:
            async with seen.request():
                await client.state()
            async with seen.request():
                events = (await client.events(newest)).events
            newest = events[-1].sequence if events else newest
            await asyncio.sleep(1.0)

    async with asyncio.TaskGroup() as group:
        group.create_task(ask())
        group.create_task(watch(client, seen, every))


async def ready(axis: AsyncAxis) -> None:
    """Enables the axis from any state, after a reset if necessary."""
    state = await axis.state()
    if state.state in ("quick-stopped", "latched"):
        await axis.reset()
    if (await axis.state()).state != "enabled":
        await axis.enable()


async def sine(axis: AsyncAxis, seen: Seen, knots: int) -> None:
    """Streams ``knots`` set-points of a sine with an amplitude of 1 deg about the current position."""
    middle_deg = (await axis.state()).load_target_deg
    assert middle_deg is not None
    async with axis.stream() as stream:
        place, begin_s = 0, time.monotonic()
        while place < knots:
            points = []
            for _ in range(min(AT_A_TIME, knots - place)):
                time_s, phase = place / KNOTS_HZ, math.pi * place / KNOTS_HZ
                points.append((time_s, middle_deg + math.sin(phase) ** 2, math.pi * math.sin(2.0 * phase)))
                place += 1
            await stream.put(points)
            seen.points += len(points)
            await asyncio.sleep(max(begin_s + place / KNOTS_HZ - AHEAD_S - time.monotonic(), 0.0))


async def story(client: AsyncClient, seen: Seen) -> None:
    """Requests every kind of motion of an axis, repeatedly."""
    chance = random.Random(1)
    async with client.lease(force=True):
        axis = next(iter((await client.axes()).values()))
        while True:
            await ready(axis)
            await axis.move(chance.uniform(-10.0, 10.0))
            await axis.move(chance.uniform(-10.0, 10.0), wait=False)
            await asyncio.sleep(0.2)
            await axis.move(chance.uniform(-10.0, 10.0))
            await axis.jog(chance.uniform(-3.0, 3.0), 0.5)
            await axis.rest()
            await axis.queue([chance.uniform(-10.0, 10.0) for _ in range(3)])
            await axis.compensate("none")
            await axis.move(chance.uniform(-10.0, 10.0), wait=False)
            await axis.compensate("extended")
            await axis.rest()
            await sine(axis, seen, 301)  # whole periods, so that it ends at rest
            seen.rounds += 1
            if seen.rounds % QUICK_STOP_EVERY == 0:
                await axis.quick_stop()
                await asyncio.sleep(0.5)
                await axis.reset()
            elif seen.rounds % 3 == 0:
                await axis.activate_model("active")


async def persistent(
    socket: str, seen: Seen, what: Callable[[AsyncClient, Seen], Coroutine[Any, Any, None]]
) -> None:
    """Runs a client; after an error, which is counted, the client starts again."""
    while True:
        try:
            async with AsyncClient(socket, name=what.__name__, timeout_s=60.0) as client:
                await what(client, seen)
        except* (HdbridgeError, OSError) as group:
            for error in group.exceptions:
                seen.errors[f"{what.__name__}: {error}"] += 1
            await asyncio.sleep(0.5)


async def serve(socket: str) -> None:
    """Runs the clients until standard input ends."""
    seen = Seen()
    async with asyncio.TaskGroup() as group:
        wanted = [poll] * 4 + [watch] * 5 + [page, story]
        tasks = [group.create_task(persistent(socket, seen, each)) for each in wanted]
        await asyncio.to_thread(sys.stdin.read)
        for task in tasks:
            task.cancel()
    print(json.dumps(seen.report()), flush=True)


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1]))
