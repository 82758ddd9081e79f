"""TLS where a certificate is given, with one that is made for the test."""

import asyncio
import shutil
import subprocess
import threading
import time

import pytest
from support.api import TOKEN
from support.fake_bridge import FakeBridge

from hdbridge import Client, DaemonError, InputError
from hdbridge.daemon.api.policy import Policy
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import tcp_socket

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
         "-keyout", "key.pem", "-out", "cert.pem", "-days", "2", "-subj", "/CN=cell",
         "-addext", "subjectAltName=IP:127.0.0.1"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def url(certificate):
    listener = tcp_socket("127.0.0.1", 0)
    address = f"https://127.0.0.1:{listener.getsockname()[1]}"
    listening = Listener(listener, Policy(TOKEN), certificate / "cert.pem", certificate / "key.pem")
    server = ApiServer(FakeBridge("joint-1"), [listening])
    thread = threading.Thread(target=lambda: asyncio.run(server.run()), daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.005)
    yield address
    server.stop()
    thread.join()


def test_a_client_that_trusts_the_certificate_asks_moves_and_watches(url, certificate):
    with Client(url, token=TOKEN, certificate=certificate / "cert.pem") as client:
        client.axis("joint-1").enable()
        assert client.axis("joint-1").move(3).load_target_deg == 3.0
        with client.axis("joint-1").stream() as stream:
            stream.put([(0.0, 3.0)])


def test_one_that_does_not_sends_nothing(url):
    with Client(url, token=TOKEN) as client, pytest.raises(DaemonError, match="certificate"):
        client.state()


def test_plain_text_is_refused(url):
    with Client(url.replace("https", "http"), token=TOKEN) as client, pytest.raises(DaemonError):
        client.state()


def test_the_environment_may_name_the_certificate(url, certificate, monkeypatch):
    monkeypatch.setenv("HDBRIDGE_CERTIFICATE", str(certificate / "cert.pem"))
    with Client(url, token=TOKEN) as client:
        assert client.state().name == "cell"


def test_a_certificate_that_is_none_is_said(url, tmp_path):
    wrong = tmp_path / "cert.pem"
    wrong.write_text("no certificate")
    for path in (wrong, tmp_path / "absent.pem"):
        with pytest.raises(InputError, match=r"\.pem: cannot be read as a certificate"):
            Client(url, token=TOKEN, certificate=path)
