"""Permissions: sockets, token, host and origin, sizes, the log."""

import grp
import logging
import os
import signal
import stat
import subprocess
import sys

import httpx
import pytest
from support.api import TOKEN

from hdbridge.daemon.api.guard import Policy
from hdbridge.daemon.api.sockets import unix_socket
from hdbridge.errors import DaemonError, InputError


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_the_socket_is_open_to_owner_and_group_only(tmp_path, umask):
    before = os.umask(umask)
    try:
        with unix_socket(tmp_path / "cell.sock"):
            assert stat.S_IMODE((tmp_path / "cell.sock").stat().st_mode) == 0o660
    finally:
        os.umask(before)


def test_only_a_dead_socket_is_replaced(tmp_path):
    path = tmp_path / "cell.sock"
    with unix_socket(path), pytest.raises(DaemonError, match="another daemon"):
        unix_socket(path)
    assert path.exists()
    with unix_socket(path):
        pass
    path.unlink()
    path.write_text("precious")
    with pytest.raises(InputError, match="not a socket"):
        unix_socket(path)
    assert path.read_text() == "precious"


ORPHAN = """
import os, sys, time
from pathlib import Path
from hdbridge.daemon.api.sockets import unix_socket
if os.fork():
    os._exit(0)
with unix_socket(Path(sys.argv[1])):
    print(os.getpid(), flush=True)
    time.sleep(600)
"""


def test_the_service_of_a_killed_daemon_is_named_itself(tmp_path):
    """It takes a moment to end. Its parent by then, process 1, is no daemon and must not be ended."""
    path = tmp_path / "cell.sock"
    asked = [sys.executable, "-c", ORPHAN, path, "hdbridge.daemon.serve"]
    with subprocess.Popen(asked, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        number = int(process.stdout.readline())
        try:
            with pytest.raises(DaemonError, match=rf"end it with 'kill {number}'"):
                unix_socket(path)
        finally:
            os.kill(number, signal.SIGKILL)


@pytest.mark.parametrize(
    ("path", "words"), [("x" * 120, "longer than"), ("absent/cell.sock", "folder must exist")]
)
def test_an_impossible_socket_path_is_refused_in_one_line(tmp_path, path, words):
    with pytest.raises(InputError, match=words):
        unix_socket(tmp_path / path)


def test_an_unknown_group_is_refused_and_a_known_one_owns_the_socket(tmp_path):
    path = tmp_path / "cell.sock"
    with pytest.raises(InputError, match="no group 'nobodys'"):
        unix_socket(path, group="nobodys")
    own = grp.getgrgid(os.getgid())
    with unix_socket(path, group=own.gr_name):
        assert path.stat().st_gid == own.gr_gid


@pytest.mark.parametrize(
    "authorization",
    [None, "", "Bearer", "Bearer wrong", f"Basic {TOKEN}", TOKEN, f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}"],
)
def test_tcp_requests_need_the_token(api, authorization):
    headers = {} if authorization is None else {"Authorization": authorization}
    with api.over_tcp(token=None, **headers) as client:
        paths = {
            path: [each.upper() for each in methods] for path, methods in client_schema(api)["paths"].items()
        }
        for path, methods in {**paths, "/metrics": ["GET"], "/api/v1/openapi.json": ["GET"]}.items():
            url = str(client.base_url).replace("/api/v1/", path.format(axis="joint-1", name="x"))
            for method in methods:
                answer = client.request(method, url, json={"target_deg": 1.0})
                assert answer.status_code == 401, (method, path)
                assert answer.headers["www-authenticate"] == "Bearer"
    assert api.bridge.moved == []
    assert api.bridge.stopped == []


def client_schema(api):
    with api.over_socket() as client:
        return client.get("/openapi.json").json()


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8402", "localhost.evil.example", "127.0.0.1.nip.io", "", "localhost@evil",
     "127.0.0.1, evil.example", "[::1", "hdbridge:x"],
)  # fmt: skip
@pytest.mark.parametrize("over", ["over_tcp", "over_socket"])
def test_a_foreign_host_name_is_refused(api, host, over):
    """A page whose host name was rebound to this machine's address sends that name as its host."""
    with getattr(api, over)(Host=host) as client:
        assert client.post("/stop").status_code == 421
    assert api.bridge.stopped == []


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8402", "[::1]:8402", "192.168.1.5", "hdbridge"])
def test_local_addresses_and_names_are_accepted(host):
    assert Policy().knows_host(host)
    assert Policy(names=frozenset({"cell.example"})).knows_host("Cell.Example:8402")


@pytest.mark.parametrize(
    ("origin", "known"),
    [
        ("https://cell.example", True),
        ("https://Cell.Example:8443", True),
        ("http://127.0.0.1:8402", True),
        (None, True),
        ("http://cell.example", False),
        ("https://evil.example", False),
        ("https://cell.example.evil", False),
        ("https://cell.example@evil", False),
        ("null", False),
    ],
)
def test_a_page_from_the_reverse_proxy_is_accepted_by_name(origin, known):
    policy = Policy(names=frozenset({"cell.example"}))
    assert policy.knows_origin(origin, "127.0.0.1:8402", "http") is known
    assert Policy().knows_origin("https://cell.example", "127.0.0.1:8402", "http") is False


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "http://localhost:1", "null", "http://127.0.0.1", "", "file://"]
)
def test_a_page_of_another_origin_is_refused(api, origin):
    lease = api.bridge.lease.take("page")
    with api.over_tcp(Origin=origin, **{"X-Lease": lease}) as client:
        assert client.post("/axes/joint-1/enable").status_code == 403
        assert client.post("/quick-stop").status_code == 403
        assert client.get("/state").status_code == 403
    assert api.bridge.moved == []


def test_the_daemons_own_page_is_accepted(api):
    with api.over_tcp(Origin=f"http://127.0.0.1:{api.port}") as client:
        assert client.get("/state").status_code == 200
        assert "access-control-allow-origin" not in client.get("/state").headers


def test_a_foreign_form_is_not_parsed_as_json(api):
    """An old browser sends no Origin, so only the content type identifies the form."""
    lease = api.bridge.lease.take("form")
    with api.over_socket(**{"X-Lease": lease}) as client:
        client.post("/axes/joint-1/enable")
        for kind in ("text/plain", "application/x-www-form-urlencoded"):
            answer = client.post(
                "/axes/joint-1/move", content=b'{"target_deg": 3}', headers={"Content-Type": kind}
            )
            assert answer.status_code == 422
    assert api.bridge.moved == [("joint-1", "enable")]


def test_neither_token_nor_lease_is_logged(api, caplog, capfd):
    caplog.set_level(logging.DEBUG)
    with api.over_tcp() as client:
        lease = client.post("/lease", json={"client": "quiet"}).json()["token"]
        client.post("/axes/joint-1/enable", headers={"X-Lease": lease})
        client.get("/state", params={"token": TOKEN})
        client.get("/lease")
    with httpx.Client(trust_env=False, verify=False) as bad:
        bad.get(f"http://127.0.0.1:{api.port}/api/v1/state", headers={"Authorization": f"Bearer {TOKEN}x"})
    own = [each for each in caplog.records if each.name.startswith(("hdbridge", "uvicorn", "websockets"))]
    logged = "\n".join(f"{each.getMessage()} {each.args} {each.__dict__}" for each in own)
    logged += "".join(capfd.readouterr())
    assert "enable" in logged, "motion is logged with its client"
    assert f"{lease}" not in logged
    assert TOKEN not in logged


def test_peers_on_the_unix_socket_are_logged(api, caplog):
    caplog.set_level(logging.INFO)
    with api.over_socket() as client:
        client.post("/stop")
        client.post("/stop")  # requests are logged after the answer; the first one has been by now
    about = next(each.args for each in caplog.records if each.args and "path" in each.args)
    assert about["peer"] == f"uid={os.getuid()}:{os.getpid()}"
    assert about["status"] == 200


@pytest.mark.parametrize("depth", [17, 900, 100_000])
@pytest.mark.parametrize("opening", ["[", '{"a":'])
def test_a_deeply_nested_body_is_refused(api, depth, opening):
    lease = api.bridge.lease.take("nester")
    with api.over_socket(**{"X-Lease": lease}) as client:
        closing = {"[": "]", '{"a":': "}"}[opening]
        for body in (opening * depth, opening * depth + "1" + closing * depth):
            answer = client.post(
                "/coordinated",
                content=f'{{"targets_deg": {body}}}'[: 256 << 10],
                headers={"Content-Type": "application/json"},
            )
            assert answer.status_code in {400, 413, 422}
            assert answer.json()["type"] == "urn:hdbridge:problem:InputError"
    assert api.bridge.moved == []
