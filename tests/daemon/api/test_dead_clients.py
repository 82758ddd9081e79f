"""WebSocket clients that die or send garbage cause no traceback and do not stop the server."""

import base64
import logging
import os
import socket
import struct
import time
from collections.abc import Callable
from functools import partial

import pytest
from support.api import TOKEN
from support.patience import until

from hdbridge.daemon.api.routes import sockets

LIVE, STREAM = "/api/v1/live", "/api/v1/axes/joint-1/stream"
TEXT, BINARY, CLOSE = 1, 2, 8


def frame(kind: int, data: bytes, masked: bool = True) -> bytes:
    return bytes([0x80 | kind, (0x80 if masked else 0) | len(data)]) + (bytes(4) if masked else b"") + data


def gone(raw: socket.socket) -> None:
    raw.close()


def reset(raw: socket.socket) -> None:
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    raw.close()


def half_closed(raw: socket.socket, how: int) -> None:
    raw.shutdown(how)
    time.sleep(0.05)


def answered(raw: socket.socket, *then: Callable[[socket.socket], object]) -> None:
    raw.recv(4096)
    for each in then:
        each(raw)


def sends(data: bytes) -> Callable[[socket.socket], None]:
    return lambda raw: raw.sendall(data)


DEATHS: dict[str, Callable[[socket.socket], object]] = {
    "closed before the answer": gone,
    "reset before the answer": reset,
    "closed": lambda raw: answered(raw, gone),
    "reset": lambda raw: answered(raw, reset),
    "reset after a batch": lambda raw: answered(raw, lambda one: one.recv(10), reset),
    "write side closed": lambda raw: answered(raw, partial(half_closed, how=socket.SHUT_WR)),
    "both sides closed": lambda raw: answered(raw, partial(half_closed, how=socket.SHUT_RDWR)),
    "close frame and reset": lambda raw: answered(raw, sends(frame(CLOSE, b"\x03\xe8")), reset),
    "nonsense and reset": lambda raw: answered(raw, sends(frame(TEXT, b"{nonsense")), reset),
    "nonsense and closed": lambda raw: answered(raw, sends(frame(TEXT, b"{nonsense")), gone),
    "not masked": lambda raw: answered(raw, sends(frame(TEXT, b"{}", masked=False))),
    "half a frame": lambda raw: answered(raw, sends(frame(TEXT, b"{}" * 30)[:20])),
    "bytes": lambda raw: answered(raw, sends(frame(BINARY, b"{}"))),
    "not UTF-8": lambda raw: answered(raw, sends(frame(TEXT, b"\xff\xfe"))),
    "never reads": lambda raw: time.sleep(0.5),
}


@pytest.mark.parametrize("path", [LIVE, STREAM])
@pytest.mark.parametrize("over", ["socket", "tcp"])
def test_a_client_that_dies_leaves_no_traceback(api, path, over, caplog, monkeypatch):
    monkeypatch.setattr(sockets, "SEND_S", 0.2)
    monkeypatch.setattr(sockets, "BEGIN_S", 0.2)
    api.bridge.rows = 400
    for death in DEATHS.values():
        for _ in range(2):
            with socket.socket(socket.AF_UNIX if over == "socket" else socket.AF_INET) as raw:
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                raw.connect(str(api.socket) if over == "socket" else ("127.0.0.1", api.port))
                raw.sendall(
                    f"GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                    f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}\r\n"
                    f"Sec-WebSocket-Version: 13\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode()
                )
                death(raw)
    until(lambda: not api.server.metrics.open["websocket"], lambda: "a dead client is still there")
    bad = [each for each in caplog.records if each.exc_info or each.levelno >= logging.ERROR]
    assert [each.getMessage() for each in bad] == []
    with api.over_socket() as client:
        assert client.get("/state").status_code == 200
