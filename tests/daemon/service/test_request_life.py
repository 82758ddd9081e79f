"""A request for power or motion ends with a stop of the axis and with its lease, at whatever step it is."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

import pytest
from support.characters import RUDE
from support.rude import ENABLED, RudeDrive
from support.service import play, stepped_service, until

from hdbridge.client import messages
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.drive.objects import Mode
from hdbridge.errors import HdbridgeError, LeaseError, RefusedError

STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Numbers of steps of the event loop after which a request is stopped."""
Stop = Callable[[ServiceAxis], Awaitable[object]]


STOPS: dict[str, Stop] = {
    "stop": lambda axis: axis.stop(),
    "quick stop": lambda axis: axis.quick_stop(),
}


async def begun(request: Awaitable[object], steps: int) -> "asyncio.Future[object]":
    """Begins a request and lets it make this number of steps."""
    task = asyncio.ensure_future(request)
    for _ in range(steps):
        await asyncio.sleep(0)
    return task


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("is_home", [False, True], ids=["enable", "home"])
def test_no_power_after_a_stop(tmp_path: Path, is_home: bool, stop: str) -> None:
    stopped: list[int] = []

    async def powered_afterwards() -> None:
        async with service.leased() as (bridge, axis, _):
            for steps in STEPS:
                token = bridge.lease.take("test", force=True)
                run = messages.Home(method=35, timeout_s=0.2)
                task = await begun(axis.home(token, run) if is_home else axis.enable(token), steps)
                if task.done() or node.state == ENABLED:  # the stop would be too late
                    with suppress(HdbridgeError):
                        await task
                    break
                powered = node.powered
                await STOPS[stop](axis)
                with pytest.raises(HdbridgeError):
                    await task
                stopped.append(steps)
                assert node.powered == powered
                assert node.state != ENABLED
                token = bridge.lease.take("test", force=True)
                if axis.link.state is AxisState.QUICK_STOPPED:
                    await axis.core.timing.sleep(0.1)
                    await axis.reset(token)
                await until(bridge, lambda: axis.link.state is AxisState.DISABLED)

    with stepped_service(tmp_path, character=RUDE) as service:
        (node,) = service.daemon.nodes
        assert isinstance(node, RudeDrive)
        node.ways.reached = 0
        play(powered_afterwards())
        assert stopped, "no request was stopped"


def test_no_power_if_the_lease_ends_while_the_drive_is_prepared(tmp_path: Path) -> None:
    async def powered_afterwards() -> None:
        async with service.leased() as (bridge, axis, token):
            prepare = axis.commissioning.prepare

            def prepared() -> object:
                bridge.lease.take("other", force=True)
                return prepare()

            axis.commissioning.prepare = prepared  # type: ignore[method-assign, assignment]
            with pytest.raises(LeaseError):
                await axis.enable(token)
            await axis.core.timing.sleep(0.2)
            assert node.powered == 0

    with stepped_service(tmp_path, character=RUDE) as service:
        (node,) = service.daemon.nodes
        assert isinstance(node, RudeDrive)
        play(powered_afterwards())


@pytest.mark.parametrize("steps", STEPS)
def test_no_motion_of_a_coordinated_move_after_a_stop(tmp_path: Path, steps: int) -> None:
    async def moves_afterwards() -> None:
        async with service.enabled() as (bridge, axis, token):
            task = await begun(bridge.coordinated(token, {"axis1": 5.0, "axis2": -5.0}), steps)
            for each in bridge.axes.values():
                await each.stop()
            await axis.core.timing.sleep(0.5)
            before = [node.motor_counts for node in service.daemon.nodes]
            await axis.core.timing.sleep(0.5)
            assert [node.motor_counts for node in service.daemon.nodes] == before
            with pytest.raises(HdbridgeError):
                await task

    with stepped_service(tmp_path, 2, character=RUDE) as service:
        play(moves_afterwards())


def test_no_motion_of_a_move_that_waits_for_another_one(tmp_path: Path) -> None:
    async def moves_afterwards() -> None:
        async with service.enabled() as (_, axis, token):
            async with axis.motion.commanding:  # as during the planning of a coordinated move
                task = await begun(axis.motion.move(token, 5.0), 3)
                await axis.stop()
            with pytest.raises(HdbridgeError, match="it was stopped by a client"):
                await task
            await axis.core.timing.sleep(0.5)
            assert abs(service.daemon.motor_counts()) < 10

    with stepped_service(tmp_path, character=RUDE) as service:
        play(moves_afterwards())


def test_a_service_that_cannot_stop_a_lent_drive_has_it_booted_without_power(tmp_path: Path) -> None:
    """The service before it died while the axis was being homed."""

    async def taken_over() -> None:
        async with service.leased() as (bridge, axis, _):
            await axis.link.do(CommandKind.HOME)
            axis.commissioning.drive.enable(Mode.HM)
            assert node.state == ENABLED
        node.ways.mute_sdo.extend([True] * 6)
        async with service.bridge() as bridge:
            axis = bridge.axes["axis1"]
            await until(bridge, lambda: axis.link.state is AxisState.DISABLED)
            assert node.state != ENABLED

    with stepped_service(tmp_path, character=RUDE) as service:
        (node,) = service.daemon.nodes
        assert isinstance(node, RudeDrive)
        play(taken_over())


def test_two_clients_that_take_the_lease_from_each_other_move_the_axis_only_in_turn(tmp_path: Path) -> None:
    async def fight() -> None:
        async with service.enabled() as (bridge, axis, _):

            async def client(name: str, target_deg: float, pause_s: float) -> None:
                for _ in range(12):
                    token = bridge.lease.take(name, force=True)
                    with suppress(LeaseError, RefusedError):
                        await axis.motion.move(token, target_deg)
                        assert abs(axis.state().load_position_deg - target_deg) < 0.1
                        assert bridge.lease.holds(token)
                    await axis.core.timing.sleep(pause_s)
                    if not bridge.lease.holds(token):
                        with pytest.raises(LeaseError):
                            await axis.motion.move(token, 50.0)

            await asyncio.gather(client("one", 3.0, 0.05), client("two", -3.0, 0.07))
            bridge.lease.take("nobody", force=True)
            await axis.core.timing.sleep(1.0)
            before = node.motor_counts
            await axis.core.timing.sleep(1.0)
            assert node.motor_counts == before
            assert abs(axis.state().load_position_deg) < 3.1

    with stepped_service(tmp_path, character=RUDE) as service:
        (node,) = service.daemon.nodes
        assert isinstance(node, RudeDrive)
        play(fight())
