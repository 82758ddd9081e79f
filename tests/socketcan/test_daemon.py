"""The whole daemon on a real Linux CAN stack: the bus taken away, its processes killed and stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from hdbridge.axis import AxisConfig
from tests.socketcan.conftest import CHANNEL, drive_process, ip, unhurried_profile
from tests.support.daemon_faults import DAEMON_ROWS, DaemonBench, DaemonRow, Witness, try_out
from tests.support.running import running


class Benches:
    """A daemon that is used for as many rows as it survives."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, 0
        self._stack = ExitStack()
        self._drive = ExitStack()
        self._bench: DaemonBench | None = None

    def bench(self) -> DaemonBench:
        if self._bench is None:
            self._bench = self._begin()
        return self._bench

    def _begin(self) -> DaemonBench:
        profile = unhurried_profile()
        axis = AxisConfig.load(profile)
        self._start_drive()
        self._number += 1
        daemon = self._stack.enter_context(
            running(
                self._folder / str(self._number),
                profile, "--interface", "socketcan", "--channel", CHANNEL, name=axis.name,
            )
        )  # fmt: skip
        daemon.until_told("READY=1")
        period_s = axis.drive.cycle_s
        return DaemonBench(
            daemon, CHANNEL, ip, self._start_drive, period_s, 2e-3 * axis.drive.heartbeat_ms,
            Witness(CHANNEL, period_s),
        )  # fmt: skip

    def _start_drive(self) -> None:
        self._drive.close()
        self._drive.enter_context(drive_process(CHANNEL))

    def end(self) -> None:
        if self._bench is not None:
            self._bench.witness.close()
            self._bench = None
        self._stack.close()
        self._drive.close()


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Benches]:
    made = Benches(tmp_path_factory.mktemp("daemon"))
    yield made
    made.end()


@pytest.mark.parametrize("row", DAEMON_ROWS, ids=lambda row: row.name)
def test_the_daemon_survives(benches: Benches, row: DaemonRow, may_configure: Callable[..., None]) -> None:
    ended = True
    try:
        try_out(row, benches.bench())
        ended = row.last
    finally:
        if ended:
            benches.end()
