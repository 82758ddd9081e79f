"""HTTP transport of both clients: settings, requests, and the errors for its failures."""

import asyncio
import select
import ssl
import threading
import time
from collections.abc import Callable
from typing import Any, Self, TypeVar

import httpx

from hdbridge.client.address import Address
from hdbridge.client.calls import PREFIX, A, Call
from hdbridge.client.messages import LeaseGrant
from hdbridge.errors import DaemonError

T = TypeVar("T")


class TlsSocket(ssl.SSLSocket):
    """TLS socket that one thread can read while another writes.

    OpenSSL allows one call at a time on a connection (https://github.com/openssl/openssl/issues/20446), and
    a WebSocket has a thread of its own that reads. Each call is made under a lock and does not block. The
    lock is free while a thread waits for the peer.
    """

    _calls: threading.Lock
    _timeout_s: float | None

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        made = super().__new__(cls, *arguments, **options)
        made._calls, made._timeout_s = threading.Lock(), None
        return made

    def settimeout(self, value: float | None) -> None:
        self._timeout_s = value

    def gettimeout(self) -> float | None:
        return self._timeout_s

    def do_handshake(self, block: bool = False) -> None:
        super().settimeout(self._timeout_s)
        super().do_handshake(block)
        super().settimeout(0)

    def recv(self, buflen: int = 1024, flags: int = 0) -> bytes:
        return self._in_turn(lambda: super(TlsSocket, self).recv(buflen, flags))

    def send(self, data: Any, flags: int = 0) -> int:
        return self._in_turn(lambda: super(TlsSocket, self).send(data, flags))

    def _in_turn(self, call: Callable[[], T]) -> T:
        """Repeats a call until it does not have to wait. Raises TimeoutError."""
        until_s = None if self._timeout_s is None else time.monotonic() + self._timeout_s
        while True:
            try:
                with self._calls:
                    return call()
            except ssl.SSLWantReadError:
                event = select.POLLIN
            except ssl.SSLWantWriteError:
                event = select.POLLOUT
            waiting = select.poll()
            waiting.register(self, event)
            if not waiting.poll(None if until_s is None else max(0.0, 1e3 * (until_s - time.monotonic()))):
                raise TimeoutError("timed out")


def tls_context(address: Address) -> ssl.SSLContext | None:
    """Returns the TLS context for HTTPS, with the certificates of the system or ``$SSL_CERT_FILE``."""
    if address.socket is not None or not address.url.startswith("https"):
        return None
    context = ssl.create_default_context()
    context.sslsocket_class = TlsSocket
    return context


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
