"""One axis through the service: power, moves, jogs and refusals."""

import pytest
from support.service import Service

from hdbridge.client import messages
from hdbridge.errors import InputError, LeaseError, RefusedError


async def test_nothing_moves_without_the_lease(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        before = axis.state().load_target_deg
        for attempt in (axis.enable, axis.disable, axis.reset):
            with pytest.raises(LeaseError):
                await attempt("guessed")
        with pytest.raises(LeaseError):
            await axis.motion.move("guessed", 5.0)
        with pytest.raises(LeaseError):
            await axis.motion.jog("guessed", 5.0)
        with pytest.raises(LeaseError):
            await axis.motion.stream("guessed")
        bridge.lease.release(token)
        with pytest.raises(LeaseError):
            await axis.motion.move(token, 5.0)
        await bridge.core.timing.sleep(0.5)
        assert axis.state().load_target_deg == before


async def test_impossible_requests_are_refused_with_the_loops_text(service: Service) -> None:
    async with service.leased() as (_, axis, token):
        with pytest.raises(RefusedError, match="enable it first"):
            await axis.motion.move(token, 5.0)
        await axis.enable(token)
        with pytest.raises(InputError, match="position limits"):
            await axis.motion.move(token, 1e6)
        with pytest.raises(RefusedError, match="disable it first"):
            await axis.home(token, messages.Home(method=35))
        with pytest.raises(RefusedError, match="disable it first"):
            await axis.sdo_write(token, "6081h", "100")
        assert axis.state().at_rest
        _, value = await axis.sdo_read("6064h")
        assert isinstance(value, int)
        with pytest.raises(InputError):
            await axis.sdo_read("no such object")


async def test_a_prepared_drive_is_prepared_again_after_a_write(service: Service) -> None:
    async with service.leased() as (_, axis, token):
        await axis.prepare()
        _, cyclic = await axis.sdo_read("6060h")
        await axis.sdo_write(token, "6060h", "1")
        await axis.enable(token)
        _, mode = await axis.sdo_read("6060h")
        assert mode == cyclic
