"""The client for asyncio: the same names, awaited."""

import asyncio
import inspect

import pytest
from support.api import TOKEN

from hdbridge import AsyncClient, InputError, LeaseError
from hdbridge.client import aioaxis, axis, messages, sync


def test_moves_and_leases(api):
    async def use() -> None:
        async with AsyncClient(api.socket, name="one") as client, AsyncClient(api.socket, name="two") as two:
            one = client.axis("joint-1")
            assert (await one.move(30)).load_target_deg == 30.0
            assert not (await client.lease_state()).held
            async with client.lease():
                with pytest.raises(LeaseError, match="'one \\("):
                    await two.axis("joint-1").move(1)
                await client.axis("joint-2").enable()
                await asyncio.gather(one.move(5), client.axis("joint-2").move(6))
            assert list(await client.axes()) == ["joint-1", "joint-2"]
            with pytest.raises(InputError, match="-180 to 180"):
                await one.move(181)

    asyncio.run(use())
    assert [each.target_deg for each in api.bridge.axes.values()] == [5.0, 6.0]
    assert not api.bridge.state().lease.held


def test_the_lease_is_renewed_while_the_loop_turns(api):
    api.bridge.lease = type(api.bridge.lease)(0.3, api.bridge.lease._now)

    async def use() -> None:
        async with AsyncClient(api.socket) as client, client.lease():
            await asyncio.sleep(1.0)
            assert api.bridge.lease.ended() == ()

    asyncio.run(use())


@pytest.mark.parametrize("over", ["socket", "tcp"])
def test_a_path_is_streamed_while_samples_are_read(api, over):
    async def use() -> int:
        address = api.socket if over == "socket" else f"http://127.0.0.1:{api.port}"
        async with AsyncClient(address, token=TOKEN) as client:

            async def watch() -> int:
                async for samples in client.live(every=5):
                    return len(samples.cycle)
                raise AssertionError

            watching = asyncio.ensure_future(watch())
            async with client.axis("joint-1").stream() as stream:
                await stream.put([(0.0, 0.0), (0.1, 0.5)])
            await client.axis("joint-1").jog(1.0, duration_s=0.1)
            return await watching

    assert asyncio.run(use()) > 0
    (given,) = api.bridge.streams
    assert len(given.points) == 2


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
