"""Remote access through a reverse proxy: nginx as documented, and one that only terminates TLS."""

import asyncio
import re
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from support.api import TOKEN, Served, running
from support.fake_bridge import FakeBridge
from support.patience import until

from hdbridge import Client, DaemonError
from hdbridge.daemon.api.guard import Policy
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import tcp_socket

DOCS = Path(__file__).parents[3] / "docs" / "daemon-api.md"
NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")
pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``cell.pem`` and ``cell.key``."""
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
         "-keyout", "cell.key", "-out", "cell.pem", "-days", "2", "-subj", "/CN=cell",
         "-addext", "subjectAltName=IP:127.0.0.1,DNS:cell.example"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return folder


@contextmanager
def behind() -> Iterator[Served]:
    """The API at a TCP port for a proxy that is called cell.example."""
    bridge, listener = FakeBridge(), tcp_socket(0)
    server = ApiServer(bridge, [Listener(listener, Policy(TOKEN, frozenset({"cell.example"})))])
    with running(server):
        yield Served(bridge, Path(), listener.getsockname()[1], server)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def nginx(daemon_port: int, certificate: Path, folder: Path) -> Iterator[int]:
    """The server that the docs describe, with other ports and paths."""
    block = re.search(r"```nginx\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None
    port, text = free_port(), block[1]
    for wanted, given in (
        ("listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
        ("http://127.0.0.1:8402", f"http://127.0.0.1:{daemon_port}"),
        ("/etc/ssl/", f"{certificate}/"),
    ):
        assert wanted in text
        text = text.replace(wanted, given)
    temporary = "".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"daemon off; master_process off; pid {folder}/pid; error_log {folder}/error.log;\n"
        f"events {{}}\nhttp {{ access_log off; {temporary}\n{text}}}\n"
    )
    assert NGINX is not None
    command = [NGINX, "-p", str(folder), "-e", str(folder / "error.log"), "-c", str(folder / "nginx.conf")]
    with subprocess.Popen(command) as process:
        try:
            until_listening(port, process)
            yield port
        finally:
            process.terminate()


def until_listening(port: int, process: subprocess.Popen[bytes]) -> None:
    def listening() -> bool:
        assert process.poll() is None, "nginx has ended"
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    until(listening, lambda: "nginx does not listen")


@contextmanager
def tls_only(daemon_port: int, certificate: Path, folder: Path) -> Iterator[int]:
    """A proxy that terminates TLS and forwards every byte."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate / "cell.pem", certificate / "cell.key")
    listening: list[int] = []
    loop = asyncio.new_event_loop()
    ended = asyncio.Event()

    async def copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()

    async def accepted(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", daemon_port)
        await asyncio.gather(copy(reader, inner_writer), copy(inner_reader, writer))

    async def serve() -> None:
        async with await asyncio.start_server(accepted, "127.0.0.1", 0, ssl=context) as server:
            listening.append(server.sockets[0].getsockname()[1])
            await ended.wait()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        if left:
            await asyncio.wait(left)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()), daemon=True)
    thread.start()
    while not listening:
        assert thread.is_alive()
        time.sleep(0.005)
    try:
        yield listening[0]
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join(30)
        loop.close()


@pytest.fixture(scope="module")
def place() -> Iterator[Served]:
    with behind() as served:
        yield served


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(nginx, marks=pytest.mark.skipif(NGINX is None, reason="nginx is not installed")),
        tls_only,
    ],
    ids=["nginx", "tls only"],
)
def url(request, place: Served, certificate: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with request.param(place.port, certificate, tmp_path_factory.mktemp("proxy")) as port:
        yield f"https://127.0.0.1:{port}"


@pytest.fixture
def api(place: Served) -> Served:
    place.bridge.__init__()
    return place


def test_clients_work_through_the_proxy(url, api, certificate, monkeypatch):
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate / "cell.pem"))
    with Client(url, token=TOKEN, name="elsewhere") as client:
        axis = client.axis("joint-1")
        axis.enable()
        assert axis.move(3).load_target_deg == 3.0
        with axis.stream() as stream:
            stream.put([(0.0, 3.0)])
        assert next(iter(client.live(axes=["joint-1"]))).cycle
        client.stop()
    assert len(api.bridge.stopped) == 2


def test_no_token_is_sent_over_an_untrusted_certificate(url):
    with Client(url, token=TOKEN) as client, pytest.raises(DaemonError, match="certificate"):
        client.state()


def over(url: str, certificate: Path, **headers: str) -> httpx.Client:
    context = ssl.create_default_context(cafile=certificate / "cell.pem")
    return httpx.Client(base_url=url, verify=context, headers=headers, trust_env=False)


def test_every_request_needs_the_token(url, api, certificate):
    with over(url, certificate) as client:
        assert client.get("/").status_code == 200  # the page without data
        assert client.get("/api/v1/state").status_code == 401
        assert client.post("/api/v1/stop").status_code == 401
    assert api.bridge.stopped == []


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("cell.example", "https://cell.example", 200),
        ("cell.example:8443", "https://cell.example:8443", 200),
        ("cell.example", None, 200),
        ("cell.example", "https://evil.example", 403),
        ("cell.example", "null", 403),
        ("evil.example", "https://evil.example", 421),
    ],
)
def test_only_the_proxys_origin_may_send_requests(url, api, certificate, host, origin, status):
    headers = {"Host": host, "Authorization": f"Bearer {TOKEN}"}
    if origin is not None:
        headers["Origin"] = origin
    with over(url, certificate, **headers) as client:
        assert client.post("/api/v1/stop").status_code == status
    assert bool(api.bridge.stopped) is (status == 200)
