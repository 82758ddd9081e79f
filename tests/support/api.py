"""API for clients: served by uvicorn in a thread, over a Unix socket and TCP."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from hdbridge.daemon.api.guard import Policy
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import tcp_socket, unix_socket
from support.fake_bridge import FakeBridge
from support.patience import until

TOKEN = "a-token-that-nobody-guesses"


@dataclass(frozen=True)
class Served:
    """Served API: its bridge, its addresses and its server."""

    bridge: FakeBridge
    socket: Path
    port: int
    server: ApiServer

    # Without TLS, because loading the system's certificates takes longer than most of these tests.
    def over_socket(self, **headers: str) -> httpx.Client:
        transport = httpx.HTTPTransport(uds=str(self.socket), verify=False)
        return httpx.Client(
            transport=transport, base_url="http://hdbridge/api/v1", headers=headers, timeout=None
        )

    def over_tcp(self, token: str | None = TOKEN, **headers: str) -> httpx.Client:
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        return httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}/api/v1",
            headers=headers,
            trust_env=False,
            verify=False,
            timeout=None,
        )


@contextmanager
def served(bridge: FakeBridge, folder: Path) -> Iterator[Served]:
    """Serves the API of a machine until the end of the block."""
    tcp = tcp_socket(0)
    port = tcp.getsockname()[1]
    path = folder / "cell.sock"
    server = ApiServer(bridge, [Listener(unix_socket(path), Policy()), Listener(tcp, Policy(token=TOKEN))])
    with running(server):
        yield Served(bridge, path, port, server)


@contextmanager
def running(server: ApiServer) -> Iterator[None]:
    """Runs a server in a thread until the end of the block."""
    thread = threading.Thread(target=lambda: asyncio.run(server.run()), daemon=True)
    thread.start()
    try:

        def begun() -> bool:
            assert thread.is_alive(), "the server has ended"
            return server.started

        until(begun, lambda: "the server has not begun")
        yield
    finally:
        server.stop()
        thread.join()
        assert not thread.is_alive(), "the server has not ended"
