"""Way points, streams and coordinated moves."""

import asyncio
import math

import numpy as np
import pytest
from support.service import Service, until

from hdbridge.client.messages import QueueItem, StreamPoint
from hdbridge.errors import InputError, LeaseError, RefusedError


def way_point(target_deg: float, **more: float) -> QueueItem:
    return QueueItem(target_deg=target_deg, **more)


def point(time_s: float, position_deg: float, velocity_deg_s: float | None = None) -> StreamPoint:
    return StreamPoint(time_s=time_s, position_deg=position_deg, velocity_deg_s=velocity_deg_s)


async def test_way_points_are_visited_in_order(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        reader = service.daemon.memory.reader()
        await axis.motion.queue(token, [way_point(2.0, dwell_s=0.3), way_point(-1.0)])
        assert axis.motion.queued == 2
        await axis.motion.queue(token, [way_point(1.0)])
        assert axis.motion.queued >= 2
        await until(bridge, lambda: axis.motion.activity.over != "")
        samples, lost = reader.read()
        assert lost == 0
        stands = samples["axes"][:, 0]
        standing = stands["load_target_deg"][stands["velocity_deg_s"] == 0.0]
        order = [value for value, before in zip(standing[1:], standing, strict=False) if value != before]
        assert order == pytest.approx([2.0, -1.0, 1.0])
        assert np.count_nonzero(np.isclose(standing, 2.0)) * service.daemon.period_s >= 0.3


async def test_a_move_replaces_the_queue(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.queue(token, [way_point(20.0), way_point(-20.0)])
        await bridge.core.timing.sleep(0.2)
        await axis.motion.move(token, 1.0)
        assert axis.state().queued == 0
        await bridge.core.timing.sleep(1.0)
        assert axis.state().load_target_deg == pytest.approx(1.0)


async def test_an_invalid_way_point_rejects_all(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        with pytest.raises(InputError, match="position limits"):
            await axis.motion.queue(token, [way_point(2.0), way_point(1e6)])
        await bridge.core.timing.sleep(0.5)
        assert axis.state().load_target_deg == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("steps", range(3))
async def test_a_queue_may_be_cleared_while_its_move_starts(service: Service, steps: int) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.queue(token, [way_point(4.0)])
        for _ in range(steps):
            await asyncio.sleep(0)
        await axis.motion.clear_queue(token)
        await until(bridge, lambda: axis.motion.activity.over != "")
        state = axis.state()
        assert state.load_target_deg == pytest.approx(4.0 if state.load_target_deg > 1.0 else 0.0)
        assert state.at_rest


async def test_a_cleared_queue_ends_after_the_present_move(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.queue(token, [way_point(4.0), way_point(-20.0), way_point(20.0)])
        await bridge.core.timing.sleep(0.1)
        assert axis.motion.queued == 2
        await axis.motion.clear_queue(token)
        await until(bridge, lambda: axis.motion.activity.over != "")
        assert axis.state().load_target_deg == pytest.approx(4.0)


@pytest.mark.parametrize("service", [{"lease_s": 1.0}], indirect=True)
async def test_the_end_of_a_lease_stops_a_queue_and_not_a_move(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        timing = bridge.core.timing
        await axis.motion.move(token, 60.0, velocity_deg_s=15.0, wait=False)
        await until(bridge, lambda: bridge.lease.holder is None)
        assert not axis.state().at_rest
        await until(bridge, lambda: axis.state().at_rest)
        assert axis.state().load_target_deg == pytest.approx(60.0)

        again = bridge.lease.take("test")
        await axis.motion.queue(again, [way_point(0.0, velocity_deg_s=10.0), way_point(60.0)])
        await timing.sleep(1.5)
        await until(bridge, lambda: axis.state().at_rest, 2.0)
        stopped_deg = axis.state().load_target_deg
        assert 10.0 < stopped_deg < 55.0
        await timing.sleep(2.0)
        assert axis.state().load_target_deg == stopped_deg
        assert axis.state().state == "enabled"
        texts = [each.text for each in bridge.events().events if each.kind == "note"]
        assert "a queue of moves was stopped: the lease of its client has ended" in texts


async def test_a_lease_taken_by_force_stops_the_jog_of_the_other(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.jog(token, 10.0, timeout_s=5.0)
        await bridge.core.timing.sleep(0.2)
        bridge.lease.take("other", force=True)
        await until(bridge, lambda: axis.state().at_rest, 1.0)
        with pytest.raises(LeaseError, match="'other'"):
            await axis.motion.jog(token, 10.0)


def sine(count: int, period_s: float = 0.05, amplitude_deg: float = 3.0) -> list[StreamPoint]:
    times = [period_s * number for number in range(count)]
    whole = times[-1]
    return [
        point(time_s, 0.5 * amplitude_deg * (1.0 - math.cos(2.0 * math.pi * time_s / whole)))
        for time_s in times
    ]


async def test_a_stream_follows_its_set_points(service: Service) -> None:
    async with service.enabled() as (_, axis, token):
        await axis.motion.move(token, 0.0)
        reader = service.daemon.memory.reader()
        points = sine(41)
        async with await axis.motion.stream(token) as stream:
            for place in range(0, len(points), 7):
                await stream.put(points[place : place + 7])
        state = axis.state()
        assert state.at_rest
        assert state.mode == "hold"
        samples, _ = reader.read()
        target = samples["axes"][:, 0]["load_target_deg"]
        moving = target[np.flatnonzero(np.diff(target))[0] :]
        times = service.daemon.period_s * np.arange(len(moving))
        wanted = np.interp(times, [each.time_s for each in points], [each.position_deg for each in points])
        assert np.max(np.abs(moving - wanted)) < 0.01  # the cubic is not the chord
        with pytest.raises(RefusedError, match="ended"):
            await stream.put([point(9.0, 0.0)])


async def test_a_starved_stream_brakes_and_reports_it(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 0.0)
        stream = await axis.motion.stream(token)
        await stream.put([point(0.1 * number, 0.05 * number * number) for number in range(6)])
        await until(bridge, lambda: axis.state().underrun, 2.0)
        await until(bridge, lambda: axis.state().at_rest, 2.0)
        with pytest.raises(RefusedError, match="ran out"):
            await stream.put([point(1.0, 2.0)])


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([point(0.0, 5.0)], "begins at 5 deg"),
        ([point(0.1, 0.0), point(0.1, 0.1)], "later"),
        ([point(0.0, 0.0, 1.0)], "begin at rest"),
    ],
)
async def test_bad_set_points_are_refused_before_anything_moves(service, points, words):
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 0.0)
        stream = await axis.motion.stream(token)
        with pytest.raises(InputError, match=words):
            await stream.put(points)
        await bridge.core.timing.sleep(0.5)
        assert axis.state().load_target_deg == 0.0


async def test_set_points_beyond_the_limits_end_the_stream_braking(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.move(token, 0.0)
        stream = await axis.motion.stream(token)
        await stream.put([point(0.2, 0.5), point(0.4, 1.0), point(0.41, 300.0)])
        with pytest.raises((InputError, RefusedError), match="deg/s"):
            await stream.end()
        await until(bridge, lambda: axis.state().at_rest, 2.0)
        assert axis.state().state == "enabled"
        assert axis.state().load_target_deg < 10.0


@pytest.mark.parametrize("service", [{"axes": 2}], indirect=True)
async def test_coordinated_axes_arrive_together(service: Service) -> None:
    async with service.enabled() as (bridge, _, token):
        reader = service.daemon.memory.reader()
        before = [each.state().load_target_deg for each in bridge.axes.values()]
        await bridge.coordinated(token, {"axis1": 20.0, "axis2": -5.0})
        assert [each.state().load_target_deg for each in bridge.axes.values()] == pytest.approx([20.0, -5.0])
        samples, _ = reader.read()
        targets = samples["axes"]["load_target_deg"]
        way = (targets - before) / (np.array([20.0, -5.0]) - before)
        assert np.max(np.abs(way[:, 0] - way[:, 1])) < 1e-6
        with pytest.raises(InputError, match="'axis3'"):
            await bridge.coordinated(token, {"axis1": 0.0, "axis3": 1.0})
        with pytest.raises(InputError, match="limits"):
            await bridge.coordinated(token, {"axis1": 0.0, "axis2": 1e5})


async def test_a_queue_is_accepted_once_a_jog_has_timed_out(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        await axis.motion.jog(token, 5.0, 0.1)
        await until(bridge, lambda: axis.state().mode == "hold")
        await axis.motion.queue(token, [way_point(2.0)])
        await until(bridge, lambda: axis.state().load_target_deg == 2.0)
