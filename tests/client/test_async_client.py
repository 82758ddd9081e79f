"""The client for asyncio: the same names, awaited."""

import asyncio
import inspect

import pytest

from hdbridge import AsyncClient
from hdbridge.client import aioaxis, axis, messages, sync


def test_a_task_that_is_cancelled_gives_the_lease_back(api):
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


def public(kind) -> dict[str, inspect.Signature]:
    return {
        name: [each.replace(annotation="") for each in inspect.signature(found).parameters.values()]
        for name, found in vars(kind).items()
        if inspect.isfunction(found) and not name.startswith("_")
    }


@pytest.mark.parametrize(
    ("one", "other"), [(axis.Axis, aioaxis.AsyncAxis), (axis.Stream, aioaxis.AsyncStream)]
)
def test_both_clients_have_the_same_methods(one, other):
    assert public(one) == public(other)


def test_both_clients_themselves_have_the_same_methods():
    mine = public(sync.Client)
    assert {**mine, "axes": [*public(AsyncClient)["axes"]]} == public(AsyncClient)
    assert messages.Move.__doc__
