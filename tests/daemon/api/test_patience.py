"""Clients that stall are disconnected after a time-out, shortened here."""

import logging
import socket

import pytest
from support.api import served
from support.fake_bridge import FakeBridge
from support.patience import until

from hdbridge.client.messages import ControlState
from hdbridge.daemon.api import guard, server


@pytest.fixture(scope="module")
def hasty(tmp_path_factory):
    """A server with a time-out of a fifth of a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "HEAD_S", 0.2)
        patch.setattr(guard, "BODY_S", 0.2)
        with served(FakeBridge(), tmp_path_factory.mktemp("api")) as place:
            yield place


def said(place, sent: bytes) -> bytes:
    """Returns the bytes received until the server closes the connection; the client never closes it first."""
    with socket.socket(socket.AF_UNIX) as raw:
        raw.connect(str(place.socket))
        raw.sendall(sent)
        received = b""
        while part := raw.recv(65536):
            received += part
    return received


def test_silent_and_half_finished_requests_are_closed(hasty):
    assert said(hasty, b"") == b""
    assert said(hasty, b"GET /healthz HTTP/1.1\r\nHost: local") == b""


def test_half_a_second_request_is_closed_after_the_first_was_answered(hasty):
    whole = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
    answer = said(hasty, whole + b"GET /heal")
    assert answer.count(b"HTTP/1.1 200") == 1


def test_a_request_cut_off_by_the_end_of_the_server_is_not_an_error(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(server, "ENDING_S", 0)
    bridge = FakeBridge()
    with served(bridge, tmp_path) as place, place.over_socket() as client:
        lease = client.post("/lease", json={"client": "test"}).json()["token"]
        axis = bridge.axes["joint-1"]
        axis.at, axis.moving_s = ControlState.ENABLED, 1e6
        with socket.socket(socket.AF_UNIX) as raw:
            raw.connect(str(place.socket))
            raw.sendall(
                f"POST /api/v1/axes/{axis.name}/move HTTP/1.1\r\nHost: localhost\r\nX-Lease: {lease}\r\n"
                'Content-Type: application/json\r\nContent-Length: 16\r\n\r\n{"target_deg":1}'.encode()
            )
            until(lambda: bridge.moved)
            place.server.stop()
            assert raw.recv(1000) == b""
    assert not [each for each in caplog.records if each.levelno >= logging.WARNING]


def test_a_missing_body_is_reported(hasty):
    head = b"POST /api/v1/mark HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
    assert b"HTTP/1.1 408" in said(hasty, head + b"{")


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(100),
        b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"X: " + b"a" * 30_000,
        b"POST /api/v1/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n{}",
        b"POST /api/v1/stop HTTP/1.1\r\nHost: a\r\nHost: localhost\r\n\r\n",
        b"GET /api/v1/live HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n",
    ],
    ids=["tls", "long head", "two lengths", "two hosts", "half an upgrade"],
)
def test_an_invalid_request_is_refused_and_the_next_served(hasty, sent):
    assert said(hasty, sent)[:12] in {b"HTTP/1.1 400", b"HTTP/1.1 421", b"HTTP/1.1 426"}
    assert hasty.bridge.stopped == []
    with hasty.over_socket() as client:
        assert client.get("/state").status_code == 200
