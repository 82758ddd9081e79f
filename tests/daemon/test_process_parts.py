"""Parts of the daemon's processes: runtime folder, start, notification, patience, log."""

import json
import logging
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from hdbridge.daemon.keeper import BackOff, Budget, Notifier
from hdbridge.daemon.logs import LogSettings, RateLimit, begin_log, log_once
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.start import Start, runtime_folder
from hdbridge.errors import InputError

_log = logging.getLogger("hdbridge.test")


def test_the_service_manager_s_folder_comes_first(tmp_path: Path) -> None:
    session = {"XDG_RUNTIME_DIR": str(tmp_path)}
    assert runtime_folder({"RUNTIME_DIRECTORY": "/run/hdbridge:/run/other", **session}) == Path(
        "/run/hdbridge"
    )
    folder = runtime_folder(session)
    assert folder == tmp_path / "hdbridge"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert runtime_folder(session) == folder


def test_a_folder_open_to_others_is_refused(tmp_path: Path) -> None:
    session = {"XDG_RUNTIME_DIR": str(tmp_path)}
    runtime_folder(session).chmod(0o755)
    with pytest.raises(InputError, match="not a folder of this user alone"):
        runtime_folder(session)
    (tmp_path / "hdbridge").rmdir()
    (tmp_path / "hdbridge").symlink_to(tmp_path)
    with pytest.raises(InputError, match="not a folder of this user alone"):
        runtime_folder(session)


def test_a_child_reads_its_start_data() -> None:
    start = Start(Machine.find("article"), memory_fd=7, keeper=os.getpid())
    fd = start.hand_over(api_fds=(8, 9))
    inherited = Start.inherited([str(fd)])
    assert (inherited.machine, inherited.api_fds) == (start.machine, (8, 9))
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


@pytest.mark.parametrize("arguments", [[], ["x"], ["0", "1"], ["9999"]])
def test_a_child_is_not_started_by_hand(arguments: list[str]) -> None:
    with pytest.raises(InputError, match="use 'hdbridge run'"):
        Start.inherited(arguments)


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The service manager's end of the notifications."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        yield made


def test_the_service_manager_is_notified(manager: socket.socket) -> None:
    environment = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "3000000"}
    notifier = Notifier.of_environment(environment)
    assert environment == {}
    assert notifier.watchdog_s == 3.0
    notifier.ready()
    notifier.status("one")
    notifier.status("one")
    notifier.alive()
    notifier.stopping()
    said = [manager.recv(100).decode() for _ in range(4)]
    assert said == ["READY=1", "STATUS=one", "WATCHDOG=1", "STOPPING=1"]


def test_a_watchdog_for_another_process_is_not_fed(manager: socket.socket) -> None:
    environment = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    notifier = Notifier.of_environment(environment)
    notifier.alive()
    notifier.stopping()
    assert manager.recv(100) == b"STOPPING=1"


def test_without_a_service_manager_notifications_are_dropped(tmp_path: Path) -> None:
    for notifier in (Notifier.of_environment({}), Notifier(str(tmp_path / "nobody"), 1.0)):
        notifier.ready()
        notifier.alive()


def test_a_budget_covers_a_sliding_window() -> None:
    budget = Budget(2, 60.0)
    assert [budget.spend(at) for at in (0.0, 10.0, 59.0, 60.0, 65.0, 70.0)] == [
        True, True, False, True, False, True,
    ]  # fmt: skip
    assert not Budget(0, 60.0).spend(0.0)


def test_delays_double_until_a_process_stays_alive() -> None:
    back_off = BackOff(0.5, 3.0, 60.0)
    assert [back_off.delay_s(lived) for lived in (0.1, 0.1, 0.1, 0.1, 61.0, 0.1)] == [0.5, 1, 2, 3, 0.5, 1]


@pytest.fixture
def log() -> Iterator[logging.Logger]:
    """The project's logger, restored afterwards, as is that of all libraries."""
    root, others = logging.getLogger("hdbridge"), logging.getLogger()
    before = root.handlers[:], root.level, root.propagate
    yield root
    for handler in set(root.handlers) - set(before[0]):
        root.removeHandler(handler)
        others.removeHandler(handler)
        handler.close()
    root.setLevel(before[1])
    root.propagate = before[2]


def test_the_log_is_json_without_a_terminal(log, tmp_path, capsys):
    begin_log(LogSettings(file=tmp_path / "log"))
    _log.info("begun", {"axes": 2})
    _log.debug("detail", {})
    (line,) = capsys.readouterr().err.splitlines()
    event = json.loads(line)
    assert (event["level"], event["event"], event["axes"]) == ("info", "begun", 2)
    assert [json.loads(each)["event"] for each in (tmp_path / "log").read_text().splitlines()] == [
        "begun", "detail",
    ]  # fmt: skip


def test_an_error_of_a_library_is_one_line_of_json_as_well(log, tmp_path, capsys):
    begin_log(LogSettings(file=tmp_path / "log"))
    try:
        raise ValueError("odd")
    except ValueError:
        logging.getLogger("some.library").exception("Exception in %s", "application")
    (line,) = capsys.readouterr().err.splitlines()
    event = json.loads(line)
    assert (event["where"], event["level"], event["event"]) == (
        "some.library", "error", "Exception in application",
    )  # fmt: skip
    assert "ValueError: odd" in event["traceback"]
    assert (tmp_path / "log").read_text() == line + "\n"


def test_the_control_process_logs_once(log: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    log_once(LogSettings(), "hdbridge.test", "begun", {"conditions": "none"})
    _log.error("later", {})
    (line,) = capsys.readouterr().err.splitlines()
    assert json.loads(line)["conditions"] == "none"


def test_the_journal_gets_the_priority(log, monkeypatch, capsys):
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    begin_log(LogSettings())
    _log.warning("odd", {})
    assert capsys.readouterr().err.startswith('<4>{"date": ')


def test_too_frequent_events_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr("hdbridge.daemon.logs.time.monotonic", lambda: now_s)
    limit = RateLimit(burst=2, window_s=10.0)

    def record(event: str) -> logging.LogRecord:
        return logging.LogRecord("hdbridge.test", logging.INFO, "", 0, event, ({"axis": "a"},), None)

    assert [limit.filter(record("often")) for _ in range(5)] == [True, True, False, False, False]
    assert limit.filter(record("other"))
    now_s = 11.0
    later = record("often")
    assert limit.filter(later)
    assert later.args == {"axis": "a", "left_out_before": 3}
