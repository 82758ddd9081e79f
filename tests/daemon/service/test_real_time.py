"""The service in real time: event loop, worker threads, and the control loop in a thread."""

import asyncio
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.service import Service, stepped_service

from hdbridge.client.messages import QueueItem, StreamPoint
from hdbridge.daemon.memory import Cell
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.timing import SimulatedClock, Timing
from hdbridge.errors import RefusedError


@contextmanager
def turning(service: Service) -> Iterator[None]:
    """Runs the loop in a thread, faster than its nominal period: the loop's clock is virtual, the service's
    is real.
    """
    ended = threading.Event()

    def turn() -> None:
        while not ended.wait(0.001):
            service.daemon.turn()

    thread = threading.Thread(target=turn)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


async def verified(bridge: ServiceBridge) -> None:
    while any(each.state().state != "disabled" for each in bridge.axes.values()):
        await asyncio.sleep(0.02)


@pytest.mark.parametrize("slower", [1, 5000], ids=["idle", "busy"])
def test_many_concurrent_requests(tmp_path: Path, slower: int) -> None:
    """Requests must also succeed on a computer that is this many times slower."""

    async def story(service: Service) -> None:
        memory = service.daemon.memory
        clock = SimulatedClock(
            lambda: memory.status[Cell.LOOP_COUNT],
            memory.period_s,
            lambda: slower * time.monotonic(),
            math.inf,
        )
        timing = Timing(8, clock)
        async with ServiceBridge(service.machine, memory, timing) as bridge:
            await verified(bridge)
            token = bridge.lease.take("test")
            await asyncio.gather(*(each.enable(token) for each in bridge.axes.values()))
            first, second = bridge.axes.values()
            await asyncio.gather(first.motion.move(token, 3.0), second.motion.move(token, -2.0))
            assert first.state().load_target_deg == pytest.approx(3.0)
            assert second.state().load_target_deg == pytest.approx(-2.0)

            # One client waits for a move, others read states and objects, and finally replace the move.
            waiting = asyncio.create_task(first.motion.move(token, 60.0))
            await asyncio.sleep(0.05)
            read = await asyncio.gather(
                *(first.sdo_read("6064h") for _ in range(5)), second.sdo_read("1018h:01")
            )
            assert len(read) == 6
            await first.motion.move(token, 0.0)
            with pytest.raises(RefusedError, match="another move"):
                await waiting
            await first.motion.queue(token, [QueueItem(target_deg=1.0), QueueItem(target_deg=0.0)])
            async with await second.motion.stream(token) as stream:
                for number in range(1, 40):
                    await stream.put([StreamPoint(time_s=0.02 * number, position_deg=-2.0 + 0.001 * number)])
            await bridge.coordinated(token, {"axis1": 2.0, "axis2": 0.0})

            await second.disable(token)
        timing.close()

    with stepped_service(tmp_path, axes=2, lease_s=60.0) as service, turning(service):
        asyncio.run(story(service))
