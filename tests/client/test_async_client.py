"""The client for asyncio: the same names, awaited."""

import asyncio

from hdbridge import AsyncClient


def test_a_cancelled_task_releases_the_lease(api):
    api.bridge.axes["joint-1"].moving_s = 30.0

    async def use() -> None:
        async with AsyncClient(api.socket) as client:
            moving = asyncio.ensure_future(client.axis("joint-1").move(30))
            while not api.bridge.moved:
                await asyncio.sleep(0.01)
            moving.cancel()
            await asyncio.wait([moving])
            assert not (await client.lease_state()).held

    asyncio.run(use())
