"""HTTP transport of both clients: settings, requests, and the errors for its failures."""

from __future__ import annotations

import asyncio
import ssl
from typing import Any

import httpx

from hdbridge.client.address import Address
from hdbridge.client.calls import PREFIX, A, Call
from hdbridge.client.messages import LeaseGrant
from hdbridge.errors import DaemonError


def tls_context(address: Address) -> ssl.SSLContext | None:
    """Returns the TLS context for HTTPS, with the certificates of the system or ``$SSL_CERT_FILE``."""
    https = address.socket is None and address.url.startswith("https")
    return ssl.create_default_context() if https else None


def settings(address: Address) -> dict[str, Any]:
    """Returns the settings of the httpx client, which ignores the environment."""
    return {"base_url": address.url + PREFIX, "headers": address.headers, "trust_env": False}


def under(address: Address, tls: ssl.SSLContext | None) -> dict[str, Any]:
    """Returns the settings of the httpx transport."""
    uds = None if address.socket is None else str(address.socket)
    return {"uds": uds, "verify": False if tls is None else tls}  # without TLS it loads no certificates


def socket_of(address: Address) -> str | None:
    """Returns the path of the Unix socket for a WebSocket; None over TCP."""
    return None if address.socket is None else str(address.socket)


def request(call: Call[A], grant: LeaseGrant | None, timeout_s: float) -> dict[str, Any]:
    """Returns the arguments of an httpx request for a call."""
    headers = {"Content-Type": "application/json"} if call.body is not None else {}
    if grant is not None:
        headers["X-Lease"] = grant.token
    return {
        "method": call.method,
        "url": call.path,
        "content": call.content,
        "headers": headers,
        "params": call.query,
        "timeout": httpx.Timeout(timeout_s, read=None if call.waits else timeout_s),
    }


def answer(call: Call[A], response: httpx.Response) -> A:
    """Returns the parsed answer, or raises the daemon's error."""
    return call.read(response.status_code, response.headers.get("content-type", ""), response.content)


def check(address: Address) -> None:
    """Raises DaemonError if the socket does not exist, with the same message for all requests."""
    if address.socket is not None and not address.socket.is_socket():
        raise DaemonError(f"{address}: there is no such socket; start the daemon with 'hdbridge run'")


def unreachable(address: Address, problem: Exception) -> DaemonError:
    """Returns the error for a daemon that cannot be reached or has disconnected."""
    if isinstance(problem, httpx.ConnectError):
        return DaemonError(f"{address}: no daemon answers ({problem}); start it with 'hdbridge run'")
    what = "did not answer in time" if isinstance(problem, httpx.TimeoutException) else "went away"
    return DaemonError(
        f"{address}: the daemon {what} ({problem or type(problem).__name__}); whether it was done is not "
        "known: look at the state first"
    )


async def waited(event: asyncio.Event, timeout_s: float) -> bool:
    """Waits for an event as `threading.Event.wait` does: returns False at the time-out."""
    try:
        async with asyncio.timeout(timeout_s):
            return await event.wait()
    except TimeoutError:
        return False
