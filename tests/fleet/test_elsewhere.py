"""Recordings in S3 and behind SFTP (on real servers), and in flight recordings."""

import asyncio
import gc
import re
import socket
import threading
from contextlib import suppress
from dataclasses import replace

import fsspec
import numpy as np
import pytest
from support.fleet import MODEL, record
from support.flight import flight_log, samples

from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.errors import InputError
from hdbridge.fleet.diagnosing import axes_of, diagnosed, model_in
from hdbridge.fleet.sources import Source, fetched, find_sources, with_axes
from hdbridge.records.recording import Recording

KNOWN = model_in(MODEL, "model.yaml")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the servers and clients


def check_fleet_at(url):
    """Checks a fleet at a URL: a folder with a recording, and a CSV file."""
    found = find_sources([url])
    assert [each.path.removeprefix(f"{url}/") for each in found] == ["a.csv.gz", "rec"]
    assert [each.joint for each in found] == [None, "J7"]
    with fetched(found[0].path) as path:
        assert path.is_file()
    assert not path.exists()
    rows = [diagnosed(replace(each, joint="J7", ratio=50.0), KNOWN) for each in found]
    assert [row.get("reason") for row in rows] == [None, None]
    assert rows[0]["samples_sha256"] == rows[1]["samples_sha256"]
    assert url in diagnosed(Source(f"{url}/none.csv", joint="J7"), KNOWN)["reason"]


@pytest.fixture(autouse=True)
def collected():
    """Closes the files that clients leave open within the test that opened them."""
    yield
    for protocol in ("s3", "sftp"):
        with suppress(ImportError):
            fsspec.get_filesystem_class(protocol).clear_instance_cache()
    gc.collect()


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "fleet"
    Recording(record(1), axis="J7", ratio=50.0).save(folder / "rec")
    record(1).write_csv(folder / "a.csv.gz")
    return folder


def test_recordings_in_s3(files, monkeypatch):
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        access = {"key": "k", "secret": "s", "endpoint_url": f"http://{host}:{port}"}
        monkeypatch.setitem(fsspec.config.conf, "s3", access)
        system = fsspec.filesystem("s3", skip_instance_cache=True)
        system.mkdir("bucket")
        system.put(f"{files}/", "bucket/fleet/", recursive=True)
        check_fleet_at("s3://bucket/fleet")
    finally:
        server.stop()


def test_recordings_behind_sftp(files, monkeypatch, tmp_path):
    pytest.importorskip("paramiko")
    asyncssh = pytest.importorskip("asyncssh")
    ready, where = threading.Event(), {}

    class AnyPassword(asyncssh.SSHServer):
        def password_auth_supported(self):
            return True

        def validate_password(self, username, password):
            return password == "p"

    async def serve():
        where.update(loop=asyncio.get_running_loop(), end=asyncio.Event())
        key = asyncssh.generate_private_key("ssh-ed25519")
        server = await asyncssh.listen(
            "127.0.0.1", 0, server_factory=AnyPassword, server_host_keys=[key], sftp_factory=True
        )
        where["port"] = server.get_port()
        ready.set()
        await where["end"].wait()
        server.close()
        await server.wait_closed()

    thread = threading.Thread(target=asyncio.run, args=(serve(),), daemon=True)
    thread.start()
    assert ready.wait(60)
    monkeypatch.setitem(fsspec.config.conf, "sftp", {"username": "u", "password": "p"})
    try:
        check_fleet_at(f"sftp://127.0.0.1:{where['port']}{files}")
    finally:
        fsspec.get_filesystem_class("sftp").clear_instance_cache()
        where["loop"].call_soon_threadsafe(where["end"].set)
        thread.join(60)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("s3://bucket/x", b"220 mail\r\n"),
        ("sftp://u:p@127.0.0.1:{}/x", b"220 mail\r\n"),
        ("http://127.0.0.1:{}/x/", b"220 mail\r\n"),
        ("s3://bucket/x", b""),
        ("http://127.0.0.1:{}/x/*.csv", b""),
    ],
)
def test_a_wrong_or_silent_server_is_a_one_line_error(place, words, monkeypatch):
    pytest.importorskip("s3fs")
    pytest.importorskip("paramiko")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            held = []
            with suppress(OSError):
                while True:
                    line, _ = server.accept()
                    if words:
                        with line:
                            line.sendall(words)
                    held.append(line)

        threading.Thread(target=answer, daemon=True).start()
        port = server.getsockname()[1]
        once = {"config_kwargs": {"retries": {"max_attempts": 0}}, "key": "k", "secret": "s"}
        monkeypatch.setitem(fsspec.config.conf, "s3", {"endpoint_url": f"http://127.0.0.1:{port}", **once})
        place = place.format(port)
        reason = ".+" if words else "no answer in 0.2 s; .+ --timeout"
        with pytest.raises(InputError, match=f"^{re.escape(place)}: cannot be listed: {reason}$"):
            find_sources([place], timeout_s=30.0 if words else 0.2)
        server.shutdown(socket.SHUT_RDWR)


def test_each_axis_of_a_flight_recording_is_a_joint(tmp_path):
    made = samples(5000, axes=2)
    known = record(3, samples=5000)
    for place, scale in ((0, 1.0), (1, 1.0)):
        for name, column in (
            ("motor_position_deg", known.motor_position_deg),
            ("motor_target_deg", known.motor_position_deg),
            ("load_position_deg", known.load_position_deg * scale + place),
        ):
            made["axes"][name][:, place] = column
    log, clock = flight_log(tmp_path, axes=2)
    for first in range(0, len(made), 250):
        log.put(Batch(made[first : first + 250]))
        clock.ns += 10**9
        log.flush()
    log.close()
    (source,) = find_sources([str(tmp_path)])
    axes = axes_of(source.path)
    assert axes == ["demo", "tilt"]
    rows = [diagnosed(each, KNOWN) for each in with_axes(source.path, axes, [source])]
    assert [row["joint"] for row in rows] == ["demo", "tilt"]
    assert [row.get("reason") for row in rows] == [None, None]
    assert rows[0]["date"]
    assert len({row["key"] for row in rows}) == 2
    assert np.isfinite([row["rms_arcsec"] for row in rows]).all()
