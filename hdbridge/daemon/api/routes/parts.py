"""What several routes share: the lease's header, how errors are described, a request that is waited for."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Annotated, Any, Final, TypeVar

from fastapi import Header, Path, Request

from hdbridge.client.messages import ControlState, Problem
from hdbridge.daemon.api.problems import UnknownError
from hdbridge.daemon.service.interface import AxisPort, Bridge
from hdbridge.errors import LeaseError

T = TypeVar("T")
RENEWALS: Final = 3
"""How often a lease is renewed within its time-out while a request of its holder is waited for."""

STOP_LOOKS: Final = 25
STOP_LOOK_S: Final = 0.01
_ON: Final = frozenset({ControlState.ENABLING, ControlState.ENABLED, ControlState.STOPPING})

Holder = Annotated[
    str,
    Header(
        alias="X-Lease",
        max_length=200,
        description="token of the lease (POST /api/v1/lease)",
        examples=["mZ3sWJx0b0lq"],
    ),
]
"""Missing it is empty, which is nobody's token."""
AxisName = Annotated[str, Path(description="name of the axis, as in its file", examples=["joint-3"])]

_WORDS: Final = {
    400: "The body is no JSON, or nests too deep",
    404: "There is no such axis, job or object",
    409: "Not in this state: not enabled, busy, or stopped by the supervision",
    422: "A value is missing, not a number, out of its range or outside the axis's limits; nothing moved",
    423: "The right to move is not yours; who has it is said",
    502: "The drive refused, or does not answer",
    503: "The bus is not there",
}
LOOKING: Final = (404, 422)
MOVING: Final = (400, 404, 409, 422, 423, 502, 503)
STOPPING: Final = (404, 409, 422, 502, 503)


def refusals(statuses: tuple[int, ...]) -> dict[int | str, dict[str, Any]]:
    """The errors that a route documents."""
    return {each: {"model": Problem, "description": _WORDS[each]} for each in statuses}


def port(bridge: Bridge, axis: str) -> AxisPort:
    """The axis of that name; 404 where there is none."""
    found = bridge.axes.get(axis)
    if found is None:
        raise UnknownError(f"there is no axis {axis[:80]!a}; expected one of: {', '.join(bridge.axes)}")
    return found


async def stopped(*axes: AxisPort) -> None:
    """Wait for a quick stop to show in the axes' states, for a moment: their samples come in batches."""
    for _ in range(STOP_LOOKS):
        if all(each.state().state not in _ON for each in axes):
            return
        await asyncio.sleep(STOP_LOOK_S)


async def kept(bridge: Bridge, holder: str, request: Request, motion: Awaitable[T]) -> T:
    """Wait for a motion; its holder keeps the lease meanwhile, unless the client goes away.

    The motion itself goes to its end in any case.
    """

    async def renew() -> None:
        while True:
            await asyncio.sleep(bridge.lease.timeout_s / RENEWALS)
            if await request.is_disconnected():
                return
            try:
                bridge.lease.renew(holder)
            except LeaseError:
                return

    renewing = asyncio.ensure_future(renew())
    try:
        return await motion
    finally:
        renewing.cancel()
