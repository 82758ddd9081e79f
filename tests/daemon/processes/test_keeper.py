"""The keeper with stand-ins for its children: dead, hanging and ending processes."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.running import Keeper, gone

from hdbridge.drive.interfacelock import InterfaceLock

PROGRAM = Path(__file__).with_name("standin_keeper.py")


class Kept(Keeper):
    """Keeper with stand-ins for its children, and their output."""

    def __init__(self, folder: Path, **environment: str) -> None:
        passed = {"WATCHDOG_USEC": "1000000", "HDBRIDGE_TEST_LOCKS": str(folder), **environment}
        super().__init__(folder, lambda notify: subprocess.Popen(
            [sys.executable, str(PROGRAM)], env={**os.environ, **passed, **notify},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ))  # fmt: skip
        self.said: list[str] = []
        self._said_reader = threading.Thread(target=self._read_said, daemon=True)
        self._said_reader.start()

    def _read_said(self) -> None:
        assert self.process.stdout is not None
        self.said.extend(line.strip() for line in self.process.stdout)

    def _last_words(self) -> str:
        return f"{self.said}\n{super()._last_words()}"

    def pids(self, kind: str) -> list[int]:
        """Returns all processes of a kind that have started, oldest first."""
        found = [line.split() for line in self.said]
        return [int(words[1]) for words in found if words[0] == kind and words[1] != "ends"]

    def until_begun(self, kind: str, times: int = 1) -> int:
        self.until(lambda: len(self.pids(kind)) == times, f"{kind} begins {times} times")
        return self.pids(kind)[-1]

    def ended(self) -> int:
        self._said_reader.join()
        return super().ended()


@pytest.fixture
def keeper(tmp_path: Path) -> Iterator[Callable[..., Kept]]:
    with ExitStack() as stack:

        def make(**environment: str) -> Kept:
            kept = Kept(tmp_path, **environment)
            stack.callback(kept.close)
            return kept

        yield make


def test_reports_readiness_and_ends_in_order(keeper: Callable[..., Kept]) -> None:
    kept = keeper()
    kept.until_notified("READY=1")
    kept.process.send_signal(signal.SIGTERM)
    kept.until_notified("STOPPING=1")
    assert kept.ended() == 0
    assert kept.said[-2:] == ["control ends", "service ends"]
    assert [name for name in kept.names() if name in {"ready", "stopping"}] == ["ready", "stopping"]


def test_a_dead_or_hanging_process_is_replaced_and_the_other_continues(keeper: Callable[..., Kept]) -> None:
    kept = keeper()
    kept.until_notified("READY=1")
    kept.until_notified("WATCHDOG=1")
    for times, number in ((1, signal.SIGKILL), (2, signal.SIGSTOP)):
        os.kill(kept.until_begun("service", times), number)
    kept.until_begun("service", times=3)
    assert len(kept.pids("control")) == 1
    kept.until_notified("STATUS=holds article; service restarted 2 times")

    os.kill(kept.until_begun("control"), signal.SIGSTOP)
    kept.until_begun("control", times=2)
    assert kept.names().count("process hangs") == 2
    assert len(kept.pids("service")) == 3
    kept.until_notified("STATUS=holds article; control restarted 1 times, service restarted 2 times")

    last = [kept.pids("control")[-1], kept.pids("service")[-1]]
    kept.process.kill()
    kept.until(lambda: all(gone(pid) for pid in last), "the children end with their keeper")
    kept.until(lambda: set(kept.said[-2:]) == {"control ends", "service ends"}, "they end in order")


BORROWER = """
import sys, time
from pathlib import Path
from hdbridge.drive.interfacelock import InterfaceLock
with InterfaceLock("socketcan", "can0", Path(sys.argv[1])):
    print("has it", flush=True)
    time.sleep(600)
"""


def test_a_lent_bus_returns_however_its_borrower_ends(keeper: Callable[..., Kept], tmp_path: Path) -> None:
    """The borrower is killed, and meanwhile the service as well; no other program uses the bus."""
    kept = keeper(HDBRIDGE_TEST_COLLECTED_S="inf")  # a busy computer may start the borrower late
    kept.until_notified("READY=1")
    os.kill(kept.until_begun("service"), signal.SIGUSR1)
    kept.until(lambda: "bus is lent" in kept.said, "the bus is lent")
    assert kept.said.index("control ends") < kept.said.index("bus is lent")
    with subprocess.Popen(
        [sys.executable, "-c", BORROWER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as borrower:
        assert borrower.stdout is not None
        assert borrower.stdout.readline() == "has it\n"
        os.kill(kept.until_begun("service"), signal.SIGKILL)
        kept.until_begun("service", times=2)
        assert len(kept.pids("control")) == 1
        borrower.kill()
    kept.until_begun("control", times=2)
    assert kept.names().count("control process died") == 0
    kept.process.send_signal(signal.SIGTERM)
    assert kept.ended() == 0


def test_a_bus_that_was_used_for_an_instant_returns_at_once(
    keeper: Callable[..., Kept], tmp_path: Path
) -> None:
    """The keeper waits for a borrower that has not come yet, but not for one that is gone already."""
    kept = keeper(HDBRIDGE_TEST_COLLECTED_S="inf")
    kept.until_notified("READY=1")
    for times in range(1, 4):
        os.kill(kept.until_begun("service"), signal.SIGUSR1)
        kept.until(lambda: kept.said.count("bus is lent") == times, "the bus is lent")  # noqa: B023
        with InterfaceLock("socketcan", "can0", tmp_path):
            pass
        kept.until_begun("control", times + 1)


def test_an_unused_lent_bus_returns_and_the_daemon_may_end_meanwhile(keeper: Callable[..., Kept]) -> None:
    kept = keeper()
    kept.until_notified("READY=1")
    os.kill(kept.until_begun("service"), signal.SIGUSR1)
    kept.until_begun("control", times=2)
    assert [name for name in kept.names() if "bus" in str(name)] == [
        "the bus is lent",
        "the bus is taken back",
    ]
    os.kill(kept.until_begun("service"), signal.SIGUSR1)
    kept.until(lambda: kept.said.count("bus is lent") == 2, "the bus is lent again")
    kept.process.send_signal(signal.SIGTERM)
    assert kept.ended() == 0


def test_a_dead_or_hanging_gateway_is_replaced(keeper: Callable[..., Kept]) -> None:
    kept = keeper(HDBRIDGE_TEST_WITH_GATEWAY="1")
    kept.until_notified("READY=1")
    for times, number in ((1, signal.SIGKILL), (2, signal.SIGSTOP)):
        os.kill(kept.until_begun("gateway", times), number)
    kept.until_begun("gateway", times=3)
    assert len(kept.pids("control")) == len(kept.pids("service")) == 1
    kept.process.send_signal(signal.SIGTERM)
    assert kept.ended() == 0
    assert kept.said[-3] == "control ends"
    assert {*kept.said[-2:]} == {"service ends", "gateway ends"}


@pytest.mark.parametrize(
    ("number", "how"), [(signal.SIGKILL, "ended by SIGKILL"), (signal.SIGTERM, "exit status 0")]
)
def test_a_repeatedly_dying_control_process_ends_the_daemon(keeper, number, how):
    """SIGTERM to the control process alone counts as a crash, because only the keeper ends the daemon."""
    kept = keeper()
    kept.until_notified("READY=1")
    for times in range(1, 5):
        os.kill(kept.until_begun("control", times), number)
    assert kept.ended() == 1
    assert len(kept.pids("control")) == 4
    assert len(kept.pids("service")) == 1
    assert kept.names().count("control process died") == 4
    died = [event["how"] for event in kept.events if event["event"] == "control process died"]
    assert died == [how] * 4


@pytest.mark.parametrize(("kind", "status"), [("CONTROL", 3), ("SERVICE", 2), ("SERVICE", 1)])
def test_a_child_that_cannot_start_ends_the_daemon(keeper, kind, status):
    kept = keeper(**{f"HDBRIDGE_TEST_{kind}": str(status)})
    assert kept.ended() == status
    assert "ready" not in kept.names()
