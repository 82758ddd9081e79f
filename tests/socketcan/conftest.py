"""A real SocketCAN interface and the simulated drive in a process of its own.

Run by ``tools/socketcan.sh`` if the kernel has no vcan; without an interface these tests are skipped.
"""

import atexit
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can
import pytest
from support.command import started

from hdbridge.axis import AxisConfig
from hdbridge.clock import MonotonicClock
from hdbridge.control.cycle import Cycle, Feedback
from hdbridge.drive.drive import Drive
from hdbridge.drive.link import open_bus
from hdbridge.drive.objects import Mode
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import HdbridgeError, SafetyStop

ARTICLE = Path(__file__).resolve().parents[2] / "profiles" / "article"
CHANNEL = "vcan0"
STEP_COUNTS = 10

UNHURRIED = {"cycle_ms": 20, "heartbeat_ms": 200, "following_error_time_ms": 100}
"""The article's axis for a machine that may stall for some milliseconds: no test assumes a fast one."""


@cache
def unhurried_profile() -> Path:
    """The article's profile with a longer cycle, for as long as this process lives."""
    folder = Path(tempfile.mkdtemp(prefix="hdbridge-test-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for each in ARTICLE.glob("*.yaml"):
        shutil.copy(each, folder)
    axis = folder / "axis.yaml"
    text = axis.read_text(encoding="utf-8")
    for key, value in UNHURRIED.items():
        text, found = re.subn(rf"^(  {key}: ).*$", rf"\g<1>{value}", text, flags=re.MULTILINE)
        assert found == 1, key
    axis.write_text(f"{text}\nrealtime: {{priority: 7, cpus: [0]}}\n", encoding="utf-8")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    missing = not Path(f"/sys/class/net/{CHANNEL}").exists()
    for item in items:
        if "socketcan" not in str(item.path.parent.name):
            continue
        item.add_marker(pytest.mark.socketcan)
        if missing:
            item.add_marker(
                pytest.mark.skip(
                    reason=f"no interface {CHANNEL}: run tools/socketcan.sh, or make test-socketcan"
                )
            )


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def interface() -> Iterator[str]:
    """The interface, restored afterwards whatever a test has done to it."""
    yield CHANNEL
    if not Path(f"/sys/class/net/{CHANNEL}").exists():
        ip("link", "add", "dev", CHANNEL, "type", "vcan")
    ip("link", "set", "up", CHANNEL)


@pytest.fixture(scope="session")
def profile() -> Path:
    return unhurried_profile()


@pytest.fixture
def may_configure(interface: str) -> Callable[..., None]:
    """``ip`` for tests that take the interface away; skipped if that is not permitted."""
    if (
        shutil.which("ip") is None
        or subprocess.run(["ip", "link", "set", "up", interface], check=False, capture_output=True).returncode
    ):
        pytest.skip("needs the right to configure network interfaces")
    return ip


@contextmanager
def drive_process(channel: str) -> Iterator[subprocess.Popen[str]]:
    """``hdbridge simulate`` on the interface, ended on exit."""
    command = ("simulate", unhurried_profile(), "--interface", "socketcan", "--channel", channel)
    process = started(Path.cwd(), *command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@dataclass
class Master:
    """The master's side on one bus."""

    bus: can.BusABC
    drive: Drive
    supervision: Supervision
    cycle: Cycle
    target: int = 0

    def boot(self) -> None:
        """Boots the drive, waiting for its process to come up."""
        for attempt in range(40):
            try:
                self.drive.boot()
            except HdbridgeError:
                if attempt == 39:
                    raise
                time.sleep(0.5)
            else:
                return

    def run(self, cycles: int) -> list[Feedback]:
        """Enables and moves at constant speed; starts again if a busy machine has stopped the axis."""
        for attempt in range(4):
            try:
                if attempt:
                    self.boot()
                    self.supervision.reset(verified=True)
                return self._run(cycles)
            except SafetyStop:
                if attempt == 3:
                    raise
        raise AssertionError

    def _run(self, cycles: int) -> list[Feedback]:
        self.drive.enable(Mode.CSP)
        self.cycle.restart()
        power = self.drive.image.power
        while power.state is not State.OPERATION_ENABLED:
            feedback = self.cycle.tick()
        self.target = feedback.motor_counts
        return [self.move() for _ in range(cycles)]

    def move(self) -> Feedback:
        self.target += STEP_COUNTS
        return self.cycle.tick(self.target)


@contextmanager
def master_on(channel: str, profile: Path | None = None) -> Iterator[Master]:
    axis = AxisConfig.load(profile or unhurried_profile())
    settings = axis.bus.model_copy(update={"interface": "socketcan", "channel": channel})
    with open_bus(settings) as bus:
        drive = Drive(bus, axis, MonotonicClock())
        supervision = Supervision()
        cycle = Cycle(
            drive.link,
            drive.link.clock,
            drive.image,
            supervision,
            axis.drive.cycle_s,
            monitor=drive.monitor,
            stop_timeout_s=0.3,
        )
        try:
            yield Master(bus, drive, supervision, cycle)
        finally:
            drive.close()


class Drives:
    """The simulated drive in a process, which is reused while it lives because its start takes 3 s."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._process: subprocess.Popen[str] | None = None

    def running(self, channel: str) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self.end()
            self._process = self._stack.enter_context(drive_process(channel))
        return self._process

    def end(self) -> None:
        self._stack.close()
        self._process = None


@pytest.fixture(scope="module")
def drives() -> Iterator[Drives]:
    made = Drives()
    yield made
    made.end()


@pytest.fixture
def simulated(interface, drives, request):
    yield drives.running(interface)
    if "may_configure" in request.fixturenames:  # the interface has been taken away from it
        drives.end()


@pytest.fixture
def master(interface: str, simulated: subprocess.Popen[str]) -> Iterator[Master]:
    """Provides a booted master on the interface; the simulated drive is at the other end."""
    with master_on(interface) as made:
        made.boot()
        yield made


@pytest.fixture
def intruder(interface: str) -> Iterator[can.BusABC]:
    """Provides the bus end of another node."""
    with can.Bus(interface="socketcan", channel=interface, ignore_config=True) as bus:
        yield bus
