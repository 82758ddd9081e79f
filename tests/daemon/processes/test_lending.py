"""A bus that the daemon lends to a command, on a drive in another process."""

import json
import random
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from support.command import started
from support.patience import until
from support.running import Daemon, folders_in, running

from hdbridge.axis.model import TransmissionModel, store
from hdbridge.drive.interfacelock import InterfaceLock
from hdbridge.files.profile import bundled_profile

LISTENING = ("scan", "--listen", 600, "--borrow")
"""A command that has the bus for ten minutes and needs no real time."""


@contextmanager
def next_to_it(folder: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Runs ``hdbridge`` next to the daemon, with the daemon's runtime folder."""
    process = started(folder, *arguments, env=folders_in(folder))
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon on a bus of this computer that several processes share, with a simulated drive on it."""
    tmp_path = tmp_path_factory.mktemp("lending")
    channel = f"239.74.{random.randrange(256)}.{random.randrange(1, 255)}"
    source = bundled_profile("article")
    for each in source.iterdir():
        if each.is_file():
            (tmp_path / each.name).write_bytes(each.read_bytes())
    path = tmp_path / "axis.yaml"
    axis = yaml.safe_load(path.read_text())
    options = {
        "port": random.randrange(20_000, 32_000),
        "hop_limit": 0,
    }  # a multicast port receives the frames of all groups
    axis["bus"] = {"interface": "udp_multicast", "channel": channel, "options": options}
    path.write_text(yaml.safe_dump(axis))
    with next_to_it(tmp_path, "simulate", tmp_path), running(tmp_path, tmp_path, name="article") as daemon:
        daemon.until_notified("READY=1")
        until_off(daemon)
        yield daemon


def until_off(daemon: Daemon) -> None:
    """Waits until the loop runs without power. A busy machine may have stopped the axis for lost frames."""
    off = {"unverified", "disabled", "quick-stopped", "latched"}
    daemon.until(
        lambda: (found := daemon.state())
        and found["cycle"]["alive"] and found["bus"]["lent_to"] is None and found["axes"][0]["state"] in off,
        "the axis is off",
    )  # fmt: skip


def until_taken_back(daemon: Daemon, loops: int) -> None:
    daemon.until(lambda: len(daemon.pids("control")) == loops + 1, "the bus is taken back")
    until_off(daemon)


def model_in_use(daemon: Daemon) -> dict[str, Any]:
    """Returns the model in use; None while a newly started control process has no model."""
    return dict(daemon.until(lambda: (daemon.state() or {"axes": [{}]})["axes"][0].get("model"), "a model"))


def until_borrowed(daemon: Daemon, pid: int) -> None:
    bus = (daemon.state() or {})["bus"]
    until(lambda: InterfaceLock(bus["interface"], bus["channel"]).holder == pid, lambda: str(daemon.state()))


def test_a_command_borrows_the_bus_and_the_axis_returns_disabled(daemon: Daemon) -> None:
    folder, loops = daemon.folder, len(daemon.pids("control"))
    with next_to_it(folder, "sdo", "get", folder, "1000h", "--json", "-") as refused:
        _, error = refused.communicate()
        assert refused.returncode == 3
        assert "--borrow" in error
    with next_to_it(folder, "sdo", "get", folder, "1000h", "--borrow", "--json", "-") as command:
        output, error = command.communicate()
        assert command.returncode == 0, error
        assert json.loads(output)["value"] == 0x20192
        assert "lends the bus to this command" in error
    until_taken_back(daemon, loops)
    assert (daemon.state() or {})["bus"]["lent_to"] is None


def test_clients_see_the_borrower_and_can_stop_it(daemon: Daemon) -> None:
    folder, loops = daemon.folder, len(daemon.pids("control"))
    with next_to_it(folder, *LISTENING, folder) as borrower:
        until_borrowed(daemon, borrower.pid)
        state = daemon.state() or {}
        assert f"process {borrower.pid} of " in state["bus"]["lent_to"]
        assert state["cycle"]["pid"] == 0, "there is no control process while the bus is lent"
        assert f"the bus is lent to process {borrower.pid}" in state["warnings"][0]
        assert 0.0 < state["bus"]["lent_s"] <= (daemon.state() or {})["bus"]["lent_s"]
        lease = daemon.client.post("/lease", json={"client": "test", "force": True}).json()["token"]
        refused = daemon.client.post("/axes/article/enable", headers={"X-Lease": lease})
        assert refused.status_code == 409, refused.text
        assert "the bus is lent to" in refused.text
        daemon.client.delete("/lease", headers={"X-Lease": lease})
        stop = daemon.client.post("/quick-stop")
        assert "it was asked to stop its axis and to end" in stop.text
        assert borrower.wait() != 0
    until_taken_back(daemon, loops)


def test_the_daemon_commits_the_model_that_a_borrower_proposed(daemon: Daemon) -> None:
    folder, loops = daemon.folder, len(daemon.pids("control"))
    before = model_in_use(daemon)

    def committed() -> httpx.Response:
        lease = daemon.client.post("/lease", json={"client": "test", "force": True}).json()["token"]
        held = {"X-Lease": lease}
        done = daemon.client.post("/axes/article/model", json={"version": "pending"}, headers=held)
        daemon.client.delete("/lease", headers=held)
        return done

    with next_to_it(folder, *LISTENING, folder) as borrower:
        until_borrowed(daemon, borrower.pid)
        model = TransmissionModel.load(folder / "model.yaml")
        pending = store.propose(folder, model, "calibration", datetime(2026, 3, 1, tzinfo=UTC))
        assert committed().status_code == 409
        assert pending.exists()
        borrower.terminate()
        borrower.wait()
    until_taken_back(daemon, loops)
    assert model_in_use(daemon)["reason"] == before["reason"] != "calibration"
    # A request during the start of the control process is refused and has no effect.
    until(lambda: committed().status_code == 200, lambda: str(daemon.state()))
    in_use = model_in_use(daemon)
    assert (in_use["reason"], in_use["version"]) == ("calibration", store.find(folder, store.ACTIVE).number)
    assert not pending.exists()


def test_a_killed_borrower_leaves_a_disabled_axis(daemon: Daemon) -> None:
    folder, loops = daemon.folder, len(daemon.pids("control"))
    with next_to_it(folder, *LISTENING, folder) as borrower:
        until_borrowed(daemon, borrower.pid)
        borrower.send_signal(signal.SIGKILL)
        borrower.wait()
        until_taken_back(daemon, loops)
