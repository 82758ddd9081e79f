"""The whole daemon on simulated drives: start, requests, killed processes, end."""

import os
import signal
import stat
import subprocess
import time
from pathlib import Path

import httpx
import pytest
from support.command import run_apart, run_here
from support.running import folders_in, gone, running

TRUTH = Path(__file__).parents[3] / "profiles" / "article" / "truth.yaml"


@pytest.mark.usefixtures("at_a_terminal")
def test_a_whole_daemon_session(tmp_path: Path) -> None:
    """Start, move, kill of the service, kill of the control process, and end by a closed terminal."""
    arguments = ("article", "--simulate", "--speed", 4, "--page", "--port", 0)
    with running(tmp_path, *arguments, name="article") as daemon:
        daemon.until_notified("READY=1")
        state = daemon.state()
        assert state is not None  # it answers at once
        assert state["simulated"]
        assert stat.S_IMODE(daemon.socket.stat().st_mode) == 0o660
        assert stat.S_IMODE(daemon.socket.parent.stat().st_mode) == 0o700
        second = run_to_its_end(tmp_path, "run", "article", "--simulate", status=7)
        keeper = daemon.process.pid
        assert f"another daemon listens there (process {keeper} of " in second.stderr
        assert f"end it with 'kill {keeper}'" in second.stderr

        page, token = next(each for each in daemon.names() if each.startswith("page: ")).split("#token=")
        state_of = page.removeprefix("page: ") + "api/v1/state"
        assert httpx.get(page.removeprefix("page: ")).status_code == 200
        assert httpx.get(state_of).status_code == 401
        assert httpx.get(state_of, headers={"Authorization": f"Bearer {token}"}).status_code == 200

        daemon.until_axis("disabled")
        daemon.ask("enable")
        daemon.ask("move", target_deg=3.0)
        assert daemon.ask("adaptation", mode="observe").json()["adaptation"]["mode"] == "observe"
        recorder = (daemon.state() or {})["recorder"]
        assert recorder["on"]
        assert daemon.axis()["load_target_deg"] == pytest.approx(3.0, abs=1e-9)

        daemon.ask("compensate", scheme="hysteresis")
        (control,), (service,) = daemon.pids("control"), daemon.pids("service")

        os.kill(service, signal.SIGSTOP)
        stop = run_to_its_end(tmp_path, "ctl", "stop", status=7)
        os.kill(service, signal.SIGCONT)
        assert f"the daemon is process {daemon.process.pid} of " in stop.stderr
        assert f"'kill {daemon.process.pid}' stops its axes in order" in stop.stderr

        before = daemon.cycle()
        os.kill(service, signal.SIGKILL)
        daemon.until(lambda: len(daemon.pids("service")) == 2, "the service returns")
        daemon.until(lambda: daemon.cycle() > before, "and finds the loop where it is")
        assert daemon.pids("control") == [control]
        daemon.forget_lease()
        assert daemon.until_axis("enabled")["load_target_deg"] == pytest.approx(3.0, abs=1e-9)
        daemon.ask("move", target_deg=1.0)
        assert daemon.axis()["scheme"] == "hysteresis"

        os.kill(control, signal.SIGKILL)
        daemon.until(lambda: len(daemon.pids("control")) == 2, "the control process returns")
        assert daemon.until_axis("disabled")["power"] != "operation enabled"
        daemon.until(lambda: daemon.axis()["scheme"] == "hysteresis", "its compensation returns")
        daemon.ask("enable")
        assert daemon.ask("move", target_deg=2.0).json()["correction_arcsec"] != 0.0
        assert len(daemon.pids("service")) == 2

        daemon.socket.unlink()
        daemon.until(daemon.socket.exists, "the socket file is bound again")
        assert stat.S_IMODE(daemon.socket.stat().st_mode) == 0o660
        with httpx.Client(transport=httpx.HTTPTransport(uds=str(daemon.socket), verify=False)) as new:
            assert new.get("http://hdbridge/api/v1/state").status_code == 200

        daemon.process.send_signal(signal.SIGHUP)
        assert daemon.ended() == 0
        assert not daemon.socket.exists()
        assert len(list(Path(recorder["folder"]).glob("*.mcap"))) == 2  # one of each service
        assert all(gone(pid) for pid in (*daemon.pids("control"), *daemon.pids("service")))


def test_full_disk_then_killed_keeper(tmp_path: Path) -> None:
    """The daemon reports that nothing is recorded and continues to work; then it stops the axes and ends."""
    (tmp_path / "machine.yaml").write_text(
        "schema: hdbridge.machine/1\nname: full\naxes: [{profile: article}]\nrecorder: {free_mb: 1e7}\n",
        encoding="utf-8",
    )
    with running(tmp_path, tmp_path, "--simulate", name="full") as daemon:
        daemon.until_notified("READY=1")
        daemon.until_axis("disabled")
        daemon.ask("enable")
        recorder = daemon.until(
            lambda: (found := (daemon.state() or {}).get("recorder", {})).get("dropped") and found, "dropped"
        )
        assert recorder["note"]
        daemon.ask("move", target_deg=90.0, wait=False)
        daemon.process.kill()
        daemon.process.wait()
        children = (*daemon.pids("control"), *daemon.pids("service"))
        while not all(gone(pid) for pid in children):
            time.sleep(0.1)
        assert "ending" in daemon.names()


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("nowhere",), 2, "no such file or folder, nor a bundled profile"),
        (("article",), 2, "the bus 'virtual' reaches nothing outside this process"),
        (("article", "--speed", "2", "--interface", "socketcan"), 2, "--simulate"),
        (("cell", "--simulate", "--truth", str(TRUTH)), 2, "expected once for each of the axes base, arm"),
        (("article", "--interface", "socketcan", "--channel", "can99"), 3, "can99"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path, arguments, status, said, monkeypatch):
    if status == 2:  # before it begins any process, and so in this one
        for each in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
            monkeypatch.setenv(each, str(tmp_path))
        done = run_here(tmp_path, "run", *arguments, status=status)
    else:
        done = run_to_its_end(tmp_path, "run", *arguments, status=status)
    assert said in done.stderr
    assert not list(tmp_path.glob("hdbridge/*.sock"))


def run_to_its_end(folder: Path, *arguments: str, status: int) -> subprocess.CompletedProcess[str]:
    return run_apart(folder, *arguments, env=folders_in(folder), status=status)
