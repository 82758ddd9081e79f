"""One axis through the service: power, moves, jogs, what is refused and in which words."""

from pathlib import Path

import pytest
from support.service import Service, play, stepped_service, until

from hdbridge.daemon.service.commissioning import HomingRun
from hdbridge.errors import InputError, LeaseError, RefusedError


@pytest.fixture
def service(tmp_path: Path):
    with stepped_service(tmp_path) as made:
        yield made


def test_boots_enables_moves_and_disables(service: Service) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            axis = bridge.axes["axis1"]
            assert axis.commissioning.report is not None
            token = bridge.lease.take("test")
            await axis.enable(token)
            assert axis.state().state == "enabled"
            await axis.move(token, 5.0)
            state = axis.state()
            assert state.at_rest
            assert state.load_target_deg == pytest.approx(5.0, abs=1e-9)
            assert abs(state.error_arcsec) < 60.0
            await axis.disable(token)
            assert axis.state().state == "disabled"
            assert axis.state().power == "switch on disabled"

    play(story())


def test_nothing_moves_without_the_lease(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            before = axis.state().load_target_deg
            for attempt in (axis.enable, axis.disable, axis.reset):
                with pytest.raises(LeaseError):
                    await attempt("guessed")
            with pytest.raises(LeaseError):
                await axis.move("guessed", 5.0)
            with pytest.raises(LeaseError):
                await axis.jog("guessed", 5.0)
            with pytest.raises(LeaseError):
                await axis.stream("guessed")
            bridge.lease.release(token)
            with pytest.raises(LeaseError):
                await axis.move(token, 5.0)
            await bridge.core.timing.sleep(0.5)
            assert axis.state().load_target_deg == before

    play(story())


def test_what_cannot_be_is_refused_in_the_loops_words(service: Service) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            axis = bridge.axes["axis1"]
            token = bridge.lease.take("test")
            with pytest.raises(RefusedError, match="enable it first"):
                await axis.move(token, 5.0)
            await axis.enable(token)
            with pytest.raises(InputError, match="position limits"):
                await axis.move(token, 1e6)
            with pytest.raises(RefusedError, match="disable it first"):
                await axis.home(token, HomingRun(35))
            with pytest.raises(RefusedError, match="disable it first"):
                await axis.sdo_write(token, "6081h", "100")
            assert axis.state().at_rest
            _, value = await axis.sdo_read("6064h")
            assert isinstance(value, int)
            with pytest.raises(InputError):
                await axis.sdo_read("no such object")

    play(story())


def test_a_move_is_sent_elsewhere_in_motion(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            await axis.move(token, 40.0, wait=False)
            await bridge.core.timing.sleep(0.2)
            assert not axis.state().at_rest
            await axis.move(token, -3.0)
            assert axis.state().load_target_deg == pytest.approx(-3.0)

    play(story())


def test_a_jog_ends_by_itself(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            for _ in range(4):
                await axis.jog(token, 10.0, timeout_s=0.3)
                await bridge.core.timing.sleep(0.1)
                assert not axis.state().at_rest
            await until(bridge, lambda: axis.state().at_rest, 2.0)
            assert 2.0 < axis.state().load_target_deg < 12.0

    play(story())
