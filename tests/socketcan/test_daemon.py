"""The whole daemon on a real Linux CAN stack: a disturbed or lost bus, and killed processes."""

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.command import run_apart
from support.daemon_bench import OURS, THEIRS, Cable, DaemonBench, DaemonRow, Witness, try_out
from support.daemon_faults import DAEMON_ROWS
from support.running import folders_in, running

from hdbridge.axis import AxisConfig
from tests.socketcan.conftest import unhurried_profile

NAME = "unhurried"
DISK_MB = 4


class Benches:
    """A daemon that is reused for as many rows as it survives."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, 0
        self._stack = ExitStack()
        self._bench: DaemonBench | None = None

    def bench(self) -> DaemonBench:
        if self._bench is None:
            self._bench = self._begin()
        return self._bench

    def _begin(self) -> DaemonBench:
        profile = unhurried_profile()
        axis = AxisConfig.load(profile)
        self._number += 1
        folder = self._folder / str(self._number)
        disk = self._stack.enter_context(small_disk(folder / "disk"))
        (folder / "machine.yaml").write_text(
            f"schema: hdbridge.machine/1\nname: {NAME}\naxes: [{{profile: {profile}}}]\n"
            f"bus: {{interface: socketcan, channel: {OURS}}}\nrecorder: {{folder: {disk}, free_mb: 0}}\n",
            encoding="utf-8",
        )
        cable = Cable(profile)
        self._stack.callback(cable.unplug)
        cable.plug()
        daemon = self._stack.enter_context(running(folder, folder, name=NAME))
        daemon.until_notified("READY=1")
        self._bench = DaemonBench(
            daemon, cable, disk, axis.drive.cycle_s, 2e-3 * axis.drive.heartbeat_ms,
            Witness.on(THEIRS, axis.drive.cycle_s),
        )  # fmt: skip
        return self._bench

    def end(self) -> None:
        if self._bench is not None:
            self._bench.witness.close()
            self._bench = None
        self._stack.close()


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A small file system."""
    folder.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("needs the right to mount a small disk and to configure network interfaces")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Benches]:
    made = Benches(tmp_path_factory.mktemp("daemon"))
    yield made
    made.end()


def test_a_borrowed_step_completes_and_the_axis_moves_again_when_enabled(benches: Benches) -> None:
    daemon = benches.bench().daemon
    command = ("step", unhurried_profile(), "--interface", "socketcan", "--channel", OURS, "--count", 3)
    options = ("--scheme", "both", "--borrow", "--json", "-")
    done = run_apart(daemon.folder, *command, *options, env=folders_in(daemon.folder))
    assert len(json.loads(done.stdout)["both"]["steps"]["cw"]["error_arcsec"]) == 3
    daemon.until(
        lambda: (state := daemon.state())
        and state["bus"]["lent_to"] is None and daemon.axis()["state"] == "disabled",
        "the axis is back, disabled",
    )  # fmt: skip
    benches.bench().under_way()


@pytest.mark.parametrize(
    "row",
    [pytest.param(row, id=row.name, marks=[pytest.mark.slow] if row.slow else []) for row in DAEMON_ROWS],
)
def test_the_daemon_survives(benches: Benches, row: DaemonRow) -> None:
    ended = True
    try:
        try_out(row, benches.bench())
        ended = row.last
    except pytest.skip.Exception:
        ended = False
        raise
    finally:
        if ended:
            benches.end()
