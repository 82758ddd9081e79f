"""Policy of a listener, and the guard that rejects requests that violate it.

A web page from elsewhere can send requests to a server on the user's own machine. A request is therefore
refused if its ``Host`` is not a name of this machine (DNS rebinding), or if its ``Origin`` is not the address
of the request (a foreign page). A token alone prevents neither.

The guard checks host and origin, token, number of requests in progress, and the size and duration of a body.
A stop from an authorised client is never refused: it is not counted, and the guard does not wait for its
body. A refusal closes the connection, so the rest of a refused body is not read.
"""

import asyncio
import ipaddress
import logging
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from hmac import compare_digest
from typing import Any, Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from hdbridge.client.messages import Problem
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.problems import answer, refusal

BODY_MAXIMUM: Final = 256 << 10
"""Maximum size of a request's body and of a WebSocket message, bytes."""
SUBPROTOCOL: Final = "hdbridge.v1"
TOKEN_SUBPROTOCOL: Final = "bearer."
"""Prefix of the subprotocol that contains the token, because a browser cannot set headers on a WebSocket."""
OWN_NAMES: Final = frozenset({"localhost", "hdbridge"})
_HOST: Final = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^:/@?#\s\[\]]+)(?::(\d{1,5}))?")
BODY_S: Final = 10.0
"""Time-out for receiving a body."""
REQUESTS_MAXIMUM: Final = 64
WEBSOCKETS_MAXIMUM: Final = 32
STOPS: Final = ("/stop", "/quick-stop")
_HEADERS: Final = {
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-store",
    b"content-security-policy": b"default-src 'none'; frame-ancestors 'none'",
}
_CLOSE: Final = (b"connection", b"close")
_PATH_LOGGED: Final = 200
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Policy:
    """Requirements of a listener."""

    token: str | None = None
    """Token required for the API; None on a Unix socket, where the file mode decides."""
    names: frozenset[str] = frozenset()
    """Host names of a reverse proxy, lower case."""

    def knows_host(self, host: str | None) -> bool:
        """Returns True if a ``Host`` header is an address or a name of this machine."""
        match = _HOST.fullmatch(host or "")
        if match is None:
            return False
        name = match[1].strip("[]").lower()
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in OWN_NAMES or name in self.names
        return True

    def knows_origin(self, origin: str | None, host: str, scheme: str) -> bool:
        """Returns True if a request does not come from a web page, or comes from a page loaded from here.

        A page loaded through a reverse proxy has HTTPS and one of `names` as its origin.
        """
        if origin is None or origin.lower() == f"{scheme}://{host}".lower():
            return True
        kind, _, place = origin.lower().partition("://")
        match = _HOST.fullmatch(place)
        return kind == "https" and match is not None and match[1] in self.names

    def needs_token(self, path: str) -> bool:
        """Returns True if a path returns data or has an effect; static pages require no token."""
        return self.token is not None and (path == "/metrics" or path.startswith("/api/"))

    def admits(self, authorization: str | None, subprotocols: str | None) -> bool:
        """Returns True if the token is correct; compares in constant time."""
        if self.token is None:
            return True
        kind, _, shown = (authorization or "").partition(" ")
        candidates = [shown.strip()] if kind.lower() == "bearer" else []
        for each in (subprotocols or "").split(","):
            offered = each.strip()
            if offered.startswith(TOKEN_SUBPROTOCOL):
                candidates.append(offered.removeprefix(TOKEN_SUBPROTOCOL))
        expected = self.token.encode()
        return any(compare_digest(each.encode("utf-8", "replace"), expected) for each in candidates)


class Guard:
    """ASGI middleware that applies a policy."""

    def __init__(self, app: ASGIApp, policy: Policy, metrics: Metrics) -> None:
        self._app = app
        self._policy = policy
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles a request, a WebSocket, or the application's start and end."""
        if scope["type"] == "http":
            await self._http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        began = time.monotonic()
        status = 0
        stops = scope["path"].endswith(STOPS)

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                present = {name.lower() for name, _ in message["headers"]}
                more = [each for each in _HEADERS.items() if each[0] not in present]
                if stops:
                    more.append(_CLOSE)  # its body may still be arriving
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        problem = self._refused(scope)
        body = b""
        if problem is None and not stops:
            body, problem = await _read(scope, receive)
        try:
            if problem is not None:
                await _answer(problem, scope, receive, sending)
            else:
                with self._metrics.in_progress("http"):
                    await self._app(scope, receive if stops else _replayed(body, receive), sending)
        finally:
            self._metrics.count(scope["method"], status)
            is_read = scope["method"] in {"GET", "HEAD"} and status < 400
            about = {**_about(scope), "status": status, "ms": round(1e3 * (time.monotonic() - began), 1)}
            _log.log(logging.DEBUG if is_read else logging.INFO, "request", about)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        problem = self._refused(scope)
        if problem is None:
            _log.info("websocket", _about(scope))
            # A client may disconnect at any moment, even while it receives the reason for a close.
            with self._metrics.in_progress("websocket"), suppress(WebSocketDisconnect):
                await self._app(scope, receive, send)
            _log.info("websocket ended", _about(scope))
            return
        _log.info("websocket", {**_about(scope), "status": problem.status})
        self._metrics.count("GET", problem.status)
        await receive()  # websocket.connect
        await _answer(problem, scope, receive, send)

    def _refused(self, scope: Scope) -> Problem | None:
        """Returns the reason for refusing a request or WebSocket; None if it is accepted."""
        policy, host = self._policy, _header(scope, "host") or ""
        scheme = {"ws": "http", "wss": "https"}.get(scope["scheme"], str(scope["scheme"]))
        if not policy.knows_host(host):
            return refusal(
                421, f"{host[:100]!a} is not a name of this machine; expected an address, localhost, or one "
                "of api.tcp.names in the machine file",
            )  # fmt: skip
        if not policy.knows_origin(_header(scope, "origin"), host, scheme):
            return refusal(403, "request from a foreign web page; expected none, or the daemon's own page")
        shown = _header(scope, "authorization"), _header(scope, "sec-websocket-protocol")
        if policy.needs_token(scope["path"]) and not policy.admits(*shown):
            return refusal(
                401, "the token is missing or wrong; expected the header Authorization: Bearer TOKEN (a "
                "browser's WebSocket: the subprotocol bearer.TOKEN)",
            )  # fmt: skip
        if scope["path"].endswith(STOPS):
            return None
        kind, most = ("http", REQUESTS_MAXIMUM) if scope["type"] == "http" else (
            "websocket", WEBSOCKETS_MAXIMUM
        )  # fmt: skip
        if self._metrics.open[kind] >= most:
            return refusal(503, f"too many requests ({most}) in progress; close some, or try again later")
        return None


async def _read(scope: Scope, receive: Receive) -> tuple[bytes, Problem | None]:
    """Reads the body; returns it, or the reason for refusing it."""
    length = _header(scope, "content-length") or "0"
    too_large = refusal(413, f"the body is larger than {BODY_MAXIMUM >> 10} KiB; send less at a time")
    if not length.isascii() or not length.isdigit() or int(length[:20]) > BODY_MAXIMUM:
        return b"", too_large
    parts, size = [], 0
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return b"", refusal(400, "the client disconnected before its request was complete")
                parts.append(message.get("body", b""))
                size += len(parts[-1])
                if size > BODY_MAXIMUM:
                    return b"", too_large
                if not message.get("more_body", False):
                    break
    except TimeoutError:
        return b"", refusal(408, f"the body was not there within {BODY_S:g} s")
    return b"".join(parts), None


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Returns a `Receive` that first returns a body that was already read."""
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay


async def _answer(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """Sends a refusal and closes the connection."""
    response = answer(problem)
    response.headers["connection"] = "close"
    await response(scope, receive, send)


def _header(scope: Scope, name: str) -> str | None:
    """Returns a header; a repeated header is joined, so that two hosts match no host."""
    values = Headers(scope=scope).getlist(name)
    return ", ".join(values) if values else None


def _about(scope: Scope) -> dict[str, Any]:
    """Returns peer, method and path for the log, but neither headers nor the query."""
    client = scope.get("client") or ("unknown", 0)
    path = scope.get("raw_path") or scope["path"].encode()
    return {
        "peer": f"{client[0]}:{client[1]}",
        "method": scope.get("method", "WEBSOCKET"),
        "path": path.decode("ascii", "backslashreplace").partition("?")[0][:_PATH_LOGGED],
    }
