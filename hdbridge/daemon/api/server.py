"""Server: uvicorn on open sockets, with one guard per socket.

Limits in uvicorn itself: number of connections, time for a request's head, message size, silence of a
WebSocket. A connection beyond the limit replaces the connection that has been idle longest, so idle
connections do not block others.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from hdbridge.daemon.api.app import create_app
from hdbridge.daemon.api.guard import BODY_MAXIMUM, Guard, Policy
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.sockets import BACKLOG, peer_of
from hdbridge.daemon.service.bridge import ServiceBridge

CONNECTIONS_MAXIMUM: Final = 256
"""Maximum number of connections per listener. It exceeds the limits of requests and WebSockets in progress,
whose connections are never closed for others."""
ACCEPTED_AT_ONCE: Final = 64
"""Number of connections accepted at once. It is less than `CONNECTIONS_MAXIMUM`, so that a request that
arrives with its connection is read before the connection can be closed in favour of others."""
HEAD_S: Final = 10.0
"""Time-out for receiving the head of a request."""
HEAD_BYTES: Final = 16 << 10
IDLE_S: Final = 30
"""Time after which an idle connection is closed."""
PING_S: Final = 20.0
ENDING_S: Final = 2
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Listener:
    """A listening socket and its policy."""

    socket: socket.socket
    policy: Policy


class ApiServer:
    """Serves a `Bridge` until `stop`."""

    def __init__(
        self, bridge: ServiceBridge, listeners: Sequence[Listener], metrics: Metrics | None = None
    ) -> None:
        self.metrics = metrics or Metrics(bridge)
        self._app = create_app(bridge, self.metrics)
        self._servers = [(self._server(each), each) for each in listeners]
        self._group = asyncio.TaskGroup()

    @property
    def started(self) -> bool:
        """True if every listener is served."""
        return all(server.started for server, _ in self._servers)

    async def run(self) -> None:
        """Serves until `stop` or cancellation; open requests are given a short time to complete."""
        # At DEBUG the server's libraries log headers, including the token.
        for name in ("uvicorn", "uvicorn.error", "websockets"):
            logging.getLogger(name).setLevel(logging.WARNING)
        logging.getLogger("uvicorn.error").addFilter(_worth_logging)
        async with self._group as group:
            for server, listener in self._servers:
                group.create_task(server.serve(sockets=[listener.socket]))

    def add(self, listener: Listener) -> None:
        """Serves another listener while running."""
        server = self._server(listener)
        self._servers.append((server, listener))
        self._group.create_task(server.serve(sockets=[listener.socket]))

    def _server(self, listener: Listener) -> _Server:
        return _Server(_config(self._app, listener, self.metrics))

    def stop(self) -> None:
        """Ends the server soon. May be called from a signal handler or another thread."""
        for server, _ in self._servers:
            server.should_exit = True


class _Server(uvicorn.Server):
    """uvicorn server that leaves the process's signals to the service."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts to serve; the kernel queues more connections than are accepted at once."""
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(BACKLOG)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Ends, aborting connections that clients have left open."""
        await super().shutdown(sockets)
        for each in tuple(self.server_state.connections):
            each.transport.abort()


class _CheckedConnection(asyncio.Protocol):
    """Connection that is checked every `HEAD_S`; the kernel identifies the peer of a Unix socket."""

    client: tuple[str, int] | None
    loop: asyncio.AbstractEventLoop
    _watch: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.client = _client(transport) or self.client
        self._watch = self.loop.call_later(HEAD_S, self._check)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._watch is not None:
            self._watch.cancel()
        super().connection_lost(exc)

    def _check(self) -> None:
        """Closes a stalled connection."""
        self._watch = self.loop.call_later(HEAD_S, self._check)


class _Connection(_CheckedConnection, H11Protocol):
    """HTTP connection, limited to `CONNECTIONS_MAXIMUM`."""

    _idle_since_s = 0.0
    _unsent = 0
    """Unsent bytes at the last check."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._idle_since_s = self.loop.time()
        others = [
            each
            for each in self.connections
            if isinstance(each, _Connection) and each is not self and not each.transport.is_closing()
        ]
        idle = [each for each in others if each.idle]
        if len(others) >= CONNECTIONS_MAXIMUM and idle:
            min(idle, key=lambda each: each._idle_since_s).transport.abort()

    @property
    def idle(self) -> bool:
        """True while no completely received request is being answered."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def on_response_complete(self) -> None:
        self._idle_since_s = self.loop.time()
        super().on_response_complete()

    def _check(self) -> None:
        """Closes a connection that sends no complete head in time, or whose peer does not read."""
        if self.transport.get_protocol() is not self:  # upgraded to a WebSocket, which has pings
            return
        unsent, self._unsent = self._unsent, self.transport.get_write_buffer_size()
        if self.transport.is_closing() or (unsent and unsent == self._unsent):
            self.transport.abort()
            return
        idle = self.cycle is None or self.cycle.response_complete
        if idle and (self.cycle is None or self.conn.trailing_data[0]):
            self.transport.close()
        super()._check()


class _WebSocket(_CheckedConnection, WebSocketsSansIOProtocol):
    """WebSocket connection; its pings detect dead peers."""

    def _check(self) -> None:
        """Aborts a closing connection whose peer does not read."""
        if self.transport.is_closing():
            self.transport.abort()
        else:
            super()._check()


_NOT_LOGGED: Final = ("without completing handshake", "Invalid UTF-8", "timeout graceful shutdown")


def _worth_logging(record: logging.LogRecord) -> bool:
    """Returns False for errors of a client (a refused WebSocket, a message that is not UTF-8), and for
    requests that the end of the server cuts off.
    """
    words, error = record.getMessage(), record.exc_info[1] if record.exc_info else None
    return not isinstance(error, asyncio.CancelledError) and not any(each in words for each in _NOT_LOGGED)


def _client(transport: asyncio.BaseTransport) -> tuple[str, int] | None:
    connected = transport.get_extra_info("socket")
    peer = peer_of(connected) if connected is not None else None
    return (f"uid={peer.uid}", peer.pid) if peer is not None else None


def _config(app: Any, listener: Listener, metrics: Metrics) -> uvicorn.Config:
    return uvicorn.Config(
        Guard(app, listener.policy, metrics),
        http=_Connection,
        ws=cast(Any, _WebSocket),
        loop="asyncio",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        backlog=ACCEPTED_AT_ONCE,
        timeout_keep_alive=IDLE_S,
        timeout_graceful_shutdown=ENDING_S,
        h11_max_incomplete_event_size=HEAD_BYTES,
        ws_max_size=BODY_MAXIMUM,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_per_message_deflate=False,
    )
