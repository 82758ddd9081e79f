"""A restart of the service or the control process leaves every axis in its state."""

import pytest
from support.service import Service, until

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Cell, CommandKind
from hdbridge.enums import Scheme
from hdbridge.errors import LeaseError, RefusedError


async def test_a_new_service_finds_the_axis_where_it_is(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.compensate(token, Scheme.SYNCHRONOUS)
        await axis.motion.move(token, 30.0, wait=False)
        await bridge.core.timing.sleep(0.3)
    service.daemon.run(3.0)  # without a service, the move still finishes
    assert service.daemon.states == [AxisState.ENABLED]
    async with service.bridge() as bridge:
        axis = bridge.axes["axis1"]
        await until(bridge, lambda: axis.commissioning.drive.report is not None)
        state = axis.state()
        assert state.state == "enabled"
        assert state.load_target_deg == pytest.approx(30.0)
        assert state.scheme == "synchronous"
        with pytest.raises(LeaseError):
            await axis.motion.move(token, 0.0)
        own = bridge.lease.take("another")
        await axis.motion.move(own, 31.0)
        await axis.disable(own)


async def test_no_request_is_made_before_the_axis_state_is_known(service: Service) -> None:
    """A drive that still holds its axis after a quick stop is not booted by a newly started service."""
    daemon = service.daemon
    daemon.verify()
    daemon.enable()
    daemon.move(30.0)
    daemon.run(0.5)
    daemon.done(CommandKind.QUICK_STOP)
    daemon.run(0.5)
    sent: set[int] = set()
    daemon.bus.spy = lambda can_id, _: sent.add(can_id)
    async with service.bridge() as bridge:
        axis = bridge.axes["axis1"]
        token = bridge.lease.take("at once")
        await axis.reset(token)  # waits until the state is known
        assert axis.commissioning.drive.report is not None
        assert daemon.states == [AxisState.DISABLED]
        assert 0x000 not in sent  # no NMT command has been sent


async def test_without_a_control_process_nothing_is_sent(service: Service) -> None:
    """A request between two control processes is refused, and the next process does not receive it."""
    async with service.leased() as (_, axis, token):
        status = service.daemon.memory.status
        pid = status[Cell.LOOP_PID]
        status[Cell.LOOP_PID] = 0
        with pytest.raises(RefusedError, match="there is no control process"):
            await axis.enable(token)
        status[Cell.LOOP_PID] = pid
        assert axis.state().state == "disabled"
        await axis.enable(token)


async def test_a_lent_axis_is_taken_back(service: Service) -> None:
    async with service.ready() as bridge:
        await bridge.axes["axis1"].link.do(CommandKind.HOME)
    async with service.bridge() as bridge:
        axis = bridge.axes["axis1"]
        await until(bridge, lambda: axis.state().state == "disabled")
        token = bridge.lease.take("test")
        await axis.enable(token)
        await axis.motion.move(token, 1.0)
