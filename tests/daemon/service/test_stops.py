"""Every kind of stop: report to clients, and recovery without power unless requested."""

import pytest
from support.service import Service, until

from hdbridge.cli.ctl import _event_line as printed
from hdbridge.client import messages
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.drive.supervision import Fault
from hdbridge.errors import HdbridgeError, RefusedError, SafetyStop


def said_once(bridge: ServiceBridge, fault: messages.Fault | None, *more: str) -> None:
    """Checks that each text about a stop states the remedy exactly once."""
    assert fault is not None
    (event,) = [each for each in bridge.events().events if each.kind == "stopped"]
    assert event.hint == fault.hint
    for words in (str(fault), printed(event), *more):
        assert words.count(fault.hint) == 1, words
        assert fault.hint not in fault.text


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda daemon: daemon.nodes[0].faults.raise_error(0x3210), Fault.DRIVE_FAULT),
        (lambda daemon: daemon.interfere(0x080), Fault.FOREIGN_SYNC),
    ],
    ids=["of the drive", "on the bus"],
)
async def test_a_quick_stop_is_latched_until_a_reset(service, spoil, fault):
    """`daemon.loop.test_reliability` has each fault."""
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 100.0, wait=False)
        await bridge.core.timing.sleep(1.0)
        spoil(service.daemon)
        with pytest.raises(SafetyStop, match=fault.value) as raised:
            await axis.motion.move(token, 150.0)
        state = axis.state()
        assert state.state == "quick-stopped"
        said_once(bridge, state.fault, str(raised.value))
        assert state.fault is not None
        assert state.fault.name == fault.name
        assert state.fault.hint
        assert not state.fault.needs_verification
        with pytest.raises(RefusedError, match="reset"):
            await axis.motion.move(token, 0.0)
        with pytest.raises(RefusedError, match="reset"):
            await axis.enable(token)
        await axis.reset(token)
        state = axis.state()
        assert state.state == "disabled"
        assert state.fault is None
        place_deg = state.load_position_deg
        await bridge.core.timing.sleep(1.0)
        assert axis.state().load_position_deg == pytest.approx(place_deg, abs=0.01)
        await axis.enable(token)
        await axis.motion.move(token, place_deg + 1.0)


async def test_a_drive_that_restarts_is_verified_again_and_stays_disabled(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 100.0, wait=False)
        await bridge.core.timing.sleep(1.0)
        service.daemon.nodes[0].faults.boot_up()
        with pytest.raises(SafetyStop):
            await axis.motion.move(token, 150.0)
        await until(bridge, lambda: axis.state().state == "disabled")
        texts = [each.text for each in bridge.events().events if each.kind == "note"]
        assert "the drive was verified; the axis is disabled" in texts
        await bridge.core.timing.sleep(1.0)
        assert axis.state().power == "switch on disabled"
        with pytest.raises(RefusedError, match="enable it first"):
            await axis.motion.move(token, 0.0)
        await axis.enable(token)
        await axis.motion.move(token, axis.state().load_target_deg + 1.0)


async def test_an_absent_drive_is_awaited(service: Service) -> None:
    service.daemon.nodes[0].faults.silent = True
    async with service.bridge() as bridge:
        axis = bridge.axes["axis1"]
        await until(bridge, lambda: any("does not answer" in each.text for each in bridge.events().events))
        assert axis.state().state == "unverified"
        service.daemon.nodes[0].faults.silent = False
        await until(bridge, lambda: axis.state().state == "disabled", 60.0)


async def test_an_expired_jog_does_not_affect_the_next_client(service: Service) -> None:
    async with service.leased() as (bridge, axis, token):
        await axis.enable(token)
        await axis.motion.jog(token, 5.0, 0.2)
        await bridge.core.timing.sleep(1.0)
        await axis.motion.move(bridge.lease.take("second", force=True), 8.0)
        assert axis.state().load_target_deg == 8.0
        notes = [each.text for each in bridge.events(0).events if each.kind == "note"]
        assert not [each for each in notes if "lease of its client has ended" in each]


async def test_homes_and_stays_disabled(service: Service) -> None:
    async with service.leased() as (bridge, axis, token):
        await axis.enable(token)
        await axis.motion.move(token, 5.0)
        await axis.disable(token)
        await axis.home(token, messages.Home(method=35))
        assert axis.state().state == "disabled"
        await bridge.core.timing.sleep(0.1)
        assert axis.state().motor_position_deg == pytest.approx(0.0, abs=1.0)
        await axis.enable(token)
        await axis.motion.move(token, 1.0)
        with pytest.raises(RefusedError):
            await axis.home(token, messages.Home(method=35))


async def test_a_homing_that_fails_leaves_the_axis_disabled(service: Service) -> None:
    async with service.leased() as (bridge, axis, token):
        with pytest.raises(HdbridgeError):
            await axis.home(token, messages.Home(method=1))
        await until(bridge, lambda: axis.state().state == "disabled")
        assert axis.state().power == "switch on disabled"
        await axis.enable(token)
        await axis.motion.move(token, 1.0)


@pytest.mark.parametrize("obeys", [True, False])
async def test_a_quick_stop_by_a_client_says_once_how_to_release_it(service: Service, obeys: bool) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 100.0, wait=False)
        await bridge.core.timing.sleep(1.0)
        if not obeys:
            service.daemon.nodes[0].dictionary[0x605A, 0].put(0)  # a quick stop does nothing
        await axis.quick_stop()
        await until(bridge, lambda: any(each.kind == "stopped" for each in bridge.events().events))
        fault = axis.state().fault
        assert fault is not None
        assert fault.text.startswith("quick stop by command: latched")
        assert fault.hint.endswith("hdbridge ctl reset axis1")
        said_once(bridge, fault)
