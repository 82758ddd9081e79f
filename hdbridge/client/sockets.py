"""WebSockets of both clients: settings, messages, and the errors for their failures."""

import ssl
from collections.abc import Iterable
from typing import Any, Final

from pydantic import BaseModel, ValidationError
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from hdbridge.client.address import Address
from hdbridge.client.calls import PREFIX, Call, M, given
from hdbridge.client.messages import StreamPoint, StreamPoints
from hdbridge.errors import DaemonError, HdbridgeError

MESSAGE_MAXIMUM: Final = 32 << 20
"""Maximum message size in bytes, enough for the largest batch of samples of many axes."""
CLOSE_S: Final = 1.0
FAILURES: Final = (OSError, EOFError, ConnectionClosed, InvalidHandshake)
"""Exceptions of a connection."""
POINTS_AT_A_TIME: Final = 200
Point = StreamPoint | tuple[float, float] | tuple[float, float, float]
"""Time in seconds, load angle in degrees, and optionally speed in deg/s."""


def options(address: Address, tls: ssl.SSLContext | None) -> dict[str, Any]:
    """Returns the arguments of either ``connect``."""
    known: dict[str, Any] = {
        "additional_headers": address.headers,
        "max_size": MESSAGE_MAXIMUM,
        "close_timeout": CLOSE_S,
        "compression": None,
    }
    return known if address.socket is not None else {**known, "ssl": tls, "proxy": None}


def url(address: Address, path: str) -> str:
    """Returns the URL of a WebSocket of the API."""
    return f"{address.websocket_url}{PREFIX}{path}"


def read(kind: type[M], text: str | bytes) -> M:
    """Parses a message of the daemon."""
    try:
        return kind.model_validate_json(text)
    except ValidationError:
        raise DaemonError(
            f"found another message than {kind.__name__}; use the same version of hdbridge at both ends"
        ) from None


def error_of(problem: Exception, address: Address) -> HdbridgeError:
    """Returns the hdbridge error for a failure of the connection."""
    if isinstance(problem, HdbridgeError):
        return problem
    if isinstance(problem, InvalidStatus):
        response = problem.response
        try:
            Call("GET", "", BaseModel).read(
                response.status_code, response.headers.get("Content-Type", ""), bytes(response.body or b"")
            )
        except HdbridgeError as refused:
            return refused
    if isinstance(problem, ConnectionClosed) and problem.rcvd is not None and problem.rcvd.reason:
        return DaemonError(problem.rcvd.reason)
    return DaemonError(f"{address}: the connection is gone ({problem or type(problem).__name__})")


def parts(points: Iterable[Point], end: bool) -> list[StreamPoints]:
    """Splits points into messages of bounded size; ``end`` adds the last. InputError for invalid points."""
    items = [
        each
        if isinstance(each, StreamPoint)
        else given(StreamPoint, **dict(zip(("time_s", "position_deg", "velocity_deg_s"), each, strict=False)))
        for each in points
    ]
    found = [
        StreamPoints(points=items[first : first + POINTS_AT_A_TIME])
        for first in range(0, len(items), POINTS_AT_A_TIME)
    ]
    return [*found, StreamPoints(points=[], end=True)] if end else found
