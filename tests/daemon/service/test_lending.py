"""The service's part of a loan of the bus; the keeper's is in `processes/test_lending`."""

import asyncio
import time

from support.service import Service

from hdbridge.daemon.memory import Cell


async def test_the_request_stands_until_the_keeper_lends_the_bus(service: Service) -> None:
    """The keeper waits for axes at rest, five minutes with simulated drives."""
    async with service.ready() as bridge:
        status = service.daemon.memory.status
        lent = asyncio.ensure_future(bridge.lend_bus(bridge.lease.take("test")))
        await service.timing.sleep(60.0)
        assert not lent.done()
        assert status[Cell.BUS_REQUESTED] == 1
        status[Cell.BUS_LENT] = time.monotonic_ns()
        await lent
        assert bridge.state().bus.lent_to is not None
        assert status[Cell.BUS_REQUESTED] == 0
