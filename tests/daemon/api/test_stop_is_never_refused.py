"""Stop requests get through despite other connections, half requests and unread answers."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from support.api import TOKEN

from hdbridge.client import Client

HELD = 400
HEAD = f"Host: localhost\r\nAuthorization: Bearer {TOKEN}\r\n"
SENT = {
    "half a head": "POST /api/v1/stop HTTP/1.1\r\nHost: loc",
    "half a body": f"POST /api/v1/mark HTTP/1.1\r\n{HEAD}Content-Length: 100\r\n\r\n{{",
    "large answers that are not read": f"GET /api/v1/openapi.json HTTP/1.1\r\n{HEAD}\r\n",
    "half an upgrade": f"GET /api/v1/live HTTP/1.1\r\n{HEAD}Upgrade: websocket\r\nConnection: upgrade\r\n",
}


def connected(api, over: str) -> socket.socket:
    raw = socket.socket(socket.AF_INET if over == "tcp" else socket.AF_UNIX)
    raw.connect(("127.0.0.1", api.port) if over == "tcp" else str(api.socket))
    return raw


@contextmanager
def held(api, over: str, sent: str) -> Iterator[None]:
    """Opens this number of connections, which send these bytes and stay open."""
    with ExitStack() as stack:
        for _ in range(HELD):
            raw = stack.enter_context(connected(api, over))
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            raw.sendall(sent.encode())
        yield


@pytest.mark.parametrize("over", ["tcp", "socket"])
@pytest.mark.parametrize("sent", SENT.values(), ids=SENT)
def test_a_stop_gets_through_despite_other_connections(api, over, sent):
    with held(api, over, sent):
        for client in (api.over_tcp(), api.over_socket()):
            with client:
                for path in ("/stop", "/quick-stop", "/axes/joint-1/stop", "/axes/joint-2/quick-stop"):
                    assert client.post(path).status_code == 200, path
    assert len(api.bridge.stopped) == 12
    with api.over_socket() as client:
        assert client.get("/state").status_code == 200


FLOOD = """
import collections, socket, sys
held = collections.deque(maxlen=500)
print("begun", flush=True)
while True:
    try:
        raw = socket.socket()
        raw.settimeout(0.1)
        raw.connect(("127.0.0.1", int(sys.argv[1])))
        held.append(raw)
    except OSError:
        pass
"""


def test_a_stop_gets_through_a_flood_of_new_connections(api):
    """The flood is over TCP, to which every process of the machine may connect.

    On a busy computer the daemon may close a connection before its request has arrived; the client then sends
    the stop again.
    """
    with subprocess.Popen(
        [sys.executable, "-c", FLOOD, str(api.port)], stdout=subprocess.PIPE, text=True
    ) as flood:
        try:
            assert flood.stdout is not None
            flood.stdout.readline()
            for _ in range(5):
                with Client(f"http://127.0.0.1:{api.port}", token=TOKEN, timeout_s=120.0) as client:
                    client.stop()
        finally:
            flood.kill()
    assert len(api.bridge.stopped) >= 10


def test_too_many_pending_requests_leave_room_for_a_stop(api):
    api.server.metrics.open["http"] += 64
    try:
        with api.over_socket() as client:
            assert client.get("/state").status_code == 503
            assert client.post("/quick-stop").status_code == 200
    finally:
        api.server.metrics.open["http"] -= 64


@pytest.mark.parametrize("length", ["9", "300000", "99999999999"])
def test_a_stop_does_not_wait_for_its_body(api, length):
    with connected(api, "socket") as raw:
        raw.sendall(f"POST /api/v1/stop HTTP/1.1\r\n{HEAD}Content-Length: {length}\r\n\r\n{{".encode())
        answer = raw.recv(65536)
    assert answer.startswith(b"HTTP/1.1 200")
    assert len(api.bridge.stopped) == 2


@pytest.mark.parametrize(
    ("over", "head", "status"),
    [
        ("socket", "POST /api/v1/mark HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999\r\n", b"413"),
        ("tcp", "POST /api/v1/mark HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999\r\n", b"401"),
        ("socket", "POST /api/v1/mark HTTP/1.1\r\nHost: evil.org\r\nContent-Length: 99999999\r\n", b"421"),
        ("socket", "POST /api/v1/mark HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n", b"413"),
    ],
)
def test_a_refused_body_closes_the_connection(api, over, head, status):
    """The rest of the body is not read."""
    with connected(api, over) as raw:
        raw.sendall(f"{head}\r\n".encode())
        chunk = b"4000\r\n" + b" " * 0x4000 + b"\r\n" if "chunked" in head else b" " * 0x4000
        sent = 0
        with pytest.raises(OSError, match=r"pipe|reset"):  # noqa: PT012
            for _ in range(2000):
                raw.sendall(chunk)
                sent += len(chunk)
        assert sent < 10_000_000
    with connected(api, over) as raw:
        raw.sendall(f"{head}\r\n".encode() + (chunk * 20 if "chunked" in head else b""))
        received = b""
        while True:
            try:
                part = raw.recv(65536)
            except ConnectionResetError:
                break
            if not part:
                break
            received += part
    assert received[9:12] in {status, b""}  # a reset may overtake the answer
    assert b"connection: close" in received.lower() or not received
