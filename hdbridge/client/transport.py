"""Errors of HTTP and WebSocket connections to a daemon as errors of hdbridge, and the TLS settings."""

import ssl
from typing import Final, TypeVar

import httpx
from pydantic import BaseModel, ValidationError
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from hdbridge.client.address import Address
from hdbridge.client.messages import CONTENT_TYPE, Problem
from hdbridge.errors import DaemonError, HdbridgeError

M = TypeVar("M", bound=BaseModel)
PREFIX: Final = "/api/v1"
FAILURES: Final = (OSError, EOFError, ConnectionClosed, InvalidHandshake)
"""Exceptions of a WebSocket."""


def tls_context(address: Address) -> ssl.SSLContext | None:
    """Returns the TLS context for HTTPS, with the certificates of the system or ``$SSL_CERT_FILE``."""
    https = address.socket is None and address.url.startswith("https")
    return ssl.create_default_context() if https else None


def check(address: Address) -> None:
    """Raises DaemonError if the socket does not exist, with the same message for all requests."""
    if address.socket is not None and not address.socket.is_socket():
        raise DaemonError(f"{address}: there is no such socket; start the daemon with 'hdbridge run'")


def read(kind: type[M], content: str | bytes, what: str) -> M:
    """Parses an answer to ``what``; raises DaemonError if it is another message."""
    try:
        return kind.model_validate_json(content)
    except ValidationError as problem:
        first = problem.errors(include_input=False, include_url=False)[0]
        raise DaemonError(
            f"{what}: the answer is not what this version of hdbridge expects "
            f"({'.'.join(map(str, first['loc']))}: {first['msg']}); use the same version at both ends"
        ) from None


def refused(status: int, kind: str, content: bytes) -> HdbridgeError:
    """Returns the daemon's error from an answer of status 400 or above."""
    if kind.startswith(CONTENT_TYPE):
        try:
            return Problem.model_validate_json(content).error()
        except ValidationError:
            pass
    return DaemonError(
        f"HTTP {status}, which is not an answer of hdbridge: is another server at this address?"
    )


def unreachable(address: Address, problem: Exception) -> DaemonError:
    """Returns the error for a daemon that cannot be reached or has disconnected."""
    if isinstance(problem, httpx.ConnectError):
        return DaemonError(f"{address}: no daemon answers ({problem}); start it with 'hdbridge run'")
    what = "did not answer in time" if isinstance(problem, httpx.TimeoutException) else "went away"
    return DaemonError(
        f"{address}: the daemon {what} ({problem or type(problem).__name__}); whether it was done is not "
        "known: look at the state first"
    )


def disconnected(address: Address, problem: Exception) -> HdbridgeError:
    """Returns the error for a failure of a WebSocket."""
    if isinstance(problem, InvalidStatus):
        response = problem.response
        kind = response.headers.get("Content-Type", "")
        return refused(response.status_code, kind, bytes(response.body or b""))
    if isinstance(problem, ConnectionClosed) and problem.rcvd is not None and problem.rcvd.reason:
        return DaemonError(problem.rcvd.reason)
    return DaemonError(f"{address}: the connection is gone ({problem or type(problem).__name__})")
