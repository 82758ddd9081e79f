"""Shared parts of the routes: machine, axis and lease of a request, descriptions of errors."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated, Any, Final

from fastapi import Depends, Header, Path, Request
from starlette.requests import HTTPConnection

from hdbridge.client.messages import Problem
from hdbridge.daemon.api.problems import UnknownError
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.errors import LeaseError

RENEWALS: Final = 3
"""Lease renewals per time-out while a request of the lease holder is in progress."""


async def _bridge(connection: HTTPConnection) -> ServiceBridge:
    bridge: ServiceBridge = connection.app.state.bridge
    return bridge


Bridge = Annotated[ServiceBridge, Depends(_bridge)]
"""Service of the machine, from the state of the application."""
Holder = Annotated[
    str,
    Header(
        alias="X-Lease",
        max_length=200,
        description="token of the lease (POST /api/v1/lease)",
        examples=["mZ3sWJx0b0lq"],
    ),
]
"""Lease token; empty if missing, which is never valid."""
AxisName = Annotated[str, Path(description="name of the axis, as in its file", examples=["joint-3"])]

_WORDS: Final = {
    400: "The body is not JSON, or nests too deeply",
    404: "There is no such axis or object",
    409: "Not possible in this state: not enabled, busy, or stopped by the supervision",
    422: "A value is missing, not a number or outside its range or the axis's limits; nothing moved",
    423: "Another client holds the lease, or nobody does; the answer names the holder",
    502: "The drive refused the request or does not answer",
    503: "The bus is not available",
}
LOOKING: Final = (404, 422)
MOVING: Final = (400, 404, 409, 422, 423, 502, 503)
STOPPING: Final = (404, 409, 422, 502, 503)


def refusals(statuses: tuple[int, ...]) -> dict[int | str, dict[str, Any]]:
    """Returns the documentation of a route's errors."""
    return {each: {"model": Problem, "description": _WORDS[each]} for each in statuses}


def port(bridge: ServiceBridge, axis: str) -> ServiceAxis:
    """Returns the axis of this name; raises UnknownError (404) if it does not exist."""
    found = bridge.axes.get(axis)
    if found is None:
        raise UnknownError(f"there is no axis {axis[:80]!a}; expected one of: {', '.join(bridge.axes)}")
    return found


async def _found(bridge: Bridge, axis: AxisName) -> ServiceAxis:
    return port(bridge, axis)


FoundAxis = Annotated[ServiceAxis, Depends(_found)]
"""Axis named in the path of the request."""


async def _kept(bridge: Bridge, request: Request, holder: Holder = "") -> AsyncIterator[str]:
    """Renews the lease while the request is in progress, until the client disconnects."""

    async def renew() -> None:
        with suppress(LeaseError):
            while True:
                await asyncio.sleep(bridge.lease.timeout_s / RENEWALS)
                if await request.is_disconnected():
                    return
                bridge.lease.check(holder)

    renewing = asyncio.ensure_future(renew())
    try:
        yield holder
    finally:
        renewing.cancel()


KeptHolder = Annotated[str, Depends(_kept)]
"""Lease token of a request that waits for a motion, which completes in any case."""
