"""Coordinated moves: several axes follow one plan, as streams that begin in the same cycle."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Final

from hdbridge.control.bench import axis_view
from hdbridge.daemon.memory import CommandKind, Knot
from hdbridge.daemon.service.axislink import Activity, Kind
from hdbridge.errors import HdbridgeError
from hdbridge.motion import coordinated

if TYPE_CHECKING:
    from hdbridge.daemon.service.axis import ServiceAxis

STREAM_TIMEOUT_S: Final = 5.0
ROOM_POLL_S: Final = 0.05


async def run_together(
    holder: str, axes: Sequence[ServiceAxis], targets_deg: Mapping[str, float], share: float, *, wait: bool
) -> None:
    """Plans a move from the present targets and begins it on all axes in one cycle; ``wait`` awaits its end.

    Raises InputError for targets outside the limits, and RefusedError for an axis that is in motion or not
    enabled; none has moved then.
    """
    for axis in axes:
        axis.check_may(holder)
    core = axes[0].core
    async with AsyncExitStack() as stack:
        for axis in sorted(axes, key=lambda each: each.link.index):
            await stack.enter_async_context(axis.motion.commanding)
        core.observer.poll()
        plan = await core.timing.work(
            coordinated,
            {axis.name: axis.link.value("load_target_deg") for axis in axes},
            [dict(targets_deg)],
            {axis.name: axis_view(axis.axis.config).limits for axis in axes},
            core.memory.period_s,
            share,
        )
        stream = core.next_stream()
        waiting = {axis: [Knot(stream, *row) for row in plan.knots[axis.name].tolist()] for axis in axes}
        activities = {axis: Activity(Kind.COORDINATED, holder, since=core.log.newest) for axis in axes}
        _hand_over(waiting)
        mask = sum(1 << axis.link.index for axis in axes)
        answer = await axes[0].link.do(CommandKind.STREAM_BEGIN, a=STREAM_TIMEOUT_S, i=mask, j=stream)
        for axis, activity in activities.items():
            activity.command_id = answer.id
            axis.motion.replace(activity, "a coordinated move took its place")
    following = asyncio.ensure_future(_follow(waiting, activities))
    if wait:
        await asyncio.shield(following)  # the move is supervised even if its client disconnects
    else:
        following.add_done_callback(_heard)


def _heard(future: asyncio.Future[None]) -> None:
    """Retrieves the result of a move that nobody waits for; the event log contains it."""
    if not future.cancelled():
        future.exception()


async def _follow(waiting: dict[ServiceAxis, list[Knot]], activities: Mapping[ServiceAxis, Activity]) -> None:
    """Waits until all axes have arrived. If one fails, stops the others and raises its error."""
    arrivals = [axis.link.arrival(activity) for axis, activity in activities.items()]
    try:
        await asyncio.gather(_feed(waiting, activities), *arrivals)
    except BaseException:
        for axis, activity in activities.items():
            if not activity.over:
                activity.end("another axis of a coordinated move did not go on")
                with suppress(HdbridgeError):
                    await axis.link.do(CommandKind.STOP)
        raise


async def _feed(waiting: dict[ServiceAxis, list[Knot]], activities: Mapping[ServiceAxis, Activity]) -> None:
    """Hands over the remaining knots as the queues empty, then ends the streams."""
    core = next(iter(waiting)).core
    while any(waiting.values()):
        await core.timing.sleep(ROOM_POLL_S)
        if any(each.over for each in activities.values()):
            return
        _hand_over(waiting)
    for axis, activity in activities.items():
        if not activity.over:
            try:
                await axis.link.do(CommandKind.STREAM_END)
            except HdbridgeError:
                if not activity.over:
                    raise


def _hand_over(waiting: dict[ServiceAxis, list[Knot]]) -> None:
    for axis, knots in waiting.items():
        del knots[: axis.core.memory.knots[axis.link.index].put(knots)]
