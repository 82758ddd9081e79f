"""`hdbridge ctl` against the API, served over a machine without drives."""

import json
import os
import pwd
import re
import signal

import pytest
from support.command import started
from support.patience import PATIENCE_S, until

from hdbridge import Client
from hdbridge.client import messages


@pytest.fixture
def machine(place, monkeypatch):
    """A machine after start-up with its first axis enabled; the environment has its address."""
    monkeypatch.setenv("HDBRIDGE_SOCKET", str(place.socket))
    place.bridge.__init__()
    place.bridge.axes["joint-1"].at = messages.ControlState.ENABLED
    return place.bridge


@pytest.fixture
def ctl(hdbridge, machine):
    """Runs `hdbridge ctl ARGS...`, checks that it succeeds, and returns its output."""

    def run(*arguments: object, status: int = 0) -> str:
        done = hdbridge("ctl", *arguments, status=status)
        return done.stdout if status == 0 else done.stderr

    return run


@pytest.mark.parametrize(
    ("line", "asked"),
    [
        ("enable joint-2", ("joint-2", "enable")),
        ("disable joint-1", ("joint-1", "disable")),
        ("reset joint-2", ("joint-2", "reset")),
        ("home joint-2 --method 37", ("joint-2", "home", 37)),
        ("move joint-1 -30 --velocity 20", ("joint-1", "move", -30.0, 20.0)),
        ("jog joint-1 -5 --for 0.05", ("joint-1", "jog", -5.0, 0.5)),
        ("queue joint-1 --clear", ("joint-1", "clear queue")),
        ("compensate joint-1 both", ("joint-1", "compensate", "both")),
        ("model joint-1 4", ("joint-1", "model", 4)),
        ("model joint-1 pending", ("joint-1", "model", "pending")),
        ("adapt joint-1 observe", ("joint-1", "adapt", "observe")),
        ("adapt joint-1 --back", ("joint-1", "adaptation back")),
        ("load-loop joint-1 --on", ("joint-1", "load loop", True)),
        ("set joint-1 6041h 1", ("joint-1", "write", "6041h", "1")),
    ],
)
def test_each_command_sends_its_request(ctl, machine, line, asked):
    ctl(*line.split())
    assert machine.moved[0] == asked
    assert not machine.state().lease.held


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("jog", "joint-1", "1e9"), "SPEED: found 1000000000.0; expected less than or equal to 100000"),
        (
            ("move", "joint-1", "3", "--velocity", "1e9"),
            "--velocity: found 1000000000.0; expected less than or equal to 100000",
        ),
        (("mark", "two\nlines"), "TEXT: found 'two\\nlines'"),
    ],
)
def test_a_refused_value_is_named_as_on_the_command_line(ctl, machine, words, complaint):
    said = ctl(*words, status=2)
    assert complaint in said
    assert "is used" not in said
    assert not machine.moved


def test_status_prints_a_table_or_json(ctl, machine, tmp_path):
    machine.axes["joint-2"].at = messages.ControlState.QUICK_STOPPED
    doubt = "the load encoder moved by 19.0 arcsec without the motor"
    machine.axes["joint-1"].load_loop = messages.LoadLoopState(configured=True, on=True, doubt=doubt)
    said = ctl("status", "--json", "state.json")
    assert f"the load loop of axis 'joint-1' does not act: {doubt}" in said
    assert "machine 'cell', simulated; virtual hdbridge is up, load 31 %; cycle of 4 ms" in said
    assert "nobody has the right to move" in said
    assert "axis 'joint-2' stopped: a TPDO is missing; check the cable" in said
    raw = json.loads((tmp_path / "state.json").read_text())
    assert raw["schema"] == "hdbridge.ctl-status/1"
    assert messages.MachineState.model_validate(raw).axes[1].fault.name == "LOST_TPDO"


def test_the_only_axis_needs_no_name(ctl, machine):
    assert "expected one of: joint-1, joint-2" in ctl("enable", status=2)
    del machine.axes["joint-2"]
    ctl("disable")
    ctl("home", "--method", 37)
    assert machine.moved == [("joint-1", "disable"), ("joint-1", "home", 37)]


def test_stops_go_to_all_or_named_axes_without_the_lease(ctl, machine):
    machine.lease.take("another")
    ctl("stop")
    ctl("stop", "joint-2")
    ctl("quick-stop", "joint-2", "joint-1")
    ctl("quick-stop")
    assert [each[0] for each in machine.stopped] == [
        *("joint-1", "joint-2"), "joint-2", *("joint-2", "joint-1"), *("joint-1", "joint-2"),
    ]  # fmt: skip


def test_the_lease_holder_is_named_and_can_be_overruled(ctl, machine):
    machine.lease.take("cell controller")
    assert "'cell controller' has the right to move" in ctl("lease")
    _, said = ctl("move", "joint-1", 1, status=7).splitlines()
    assert "'cell controller'" in said
    assert machine.moved == []
    ctl("move", "joint-1", 1, "--force")
    assert machine.moved == [("joint-1", "move", 1.0, None)]
    machine.lease.take("cell controller")
    assert "nobody" in ctl("lease", "--force")


@pytest.mark.parametrize(
    ("line", "status", "words"),
    [
        ("move joint-1 181", 2, "-180 to 180"),
        ("move joint-1 nan", 2, "ANGLE: found 'nan'; expected a finite number"),
        ("move joint-2 1", 7, "enable it first"),
        ("move joint-9 1", 2, "joint-1, joint-2"),
        ("move joint-1 1 2 --no-wait", 2, "queue"),
        ("queue joint-1", 2, "--clear"),
        ("adapt joint-1", 2, "--back"),
        ("adapt joint-1 onn", 2, "did you mean on?"),
        ("compensate joint-1 bth", 2, "did you mean both?"),
        ("model joint-1 newest", 2, "pending or active"),
        ("get joint-1 9999h", 2, "no such object"),
        ("status --at http://", 2, "expected"),
        ("status --at /nowhere/cell.sock", 7, "hdbridge run"),
    ],
)
def test_refusals_are_one_line_with_a_documented_exit_status(ctl, machine, line, status, words):
    *named, said = ctl(*line.split(), status=status).splitlines()
    assert words in said
    assert all(each.startswith("machine 'cell' at ") for each in named)
    assert len(named) <= 1
    assert machine.moved == []


def test_events_and_marks_are_listed(ctl, tmp_path):
    ctl("mark", "coupling tightened")
    assert "and once more" in ctl("mark", "and once more")
    assert "coupling tightened" in ctl("events", "--json", "all.json")
    assert "coupling tightened" not in ctl("events", "--since", 1)
    assert [each["sequence"] for each in json.loads((tmp_path / "all.json").read_text())["events"]] == [1, 2]


def test_watch_refreshes_repeatedly(ctl):
    lines = ctl("watch", "--lines", "--count", 3, "--every", 0.05).splitlines()
    assert [messages.MachineState.model_validate_json(each).name for each in lines] == ["cell"] * 3
    assert ctl("watch", "--count", 2, "--every", 0.05).count("joint-2") == 2


@pytest.mark.parametrize("line", ["watch", "watch --lines", "events --follow"])
def test_what_runs_until_ctrl_c_ends_with_its_reader(ctl, unread, line):
    """As in `hdbridge ctl watch | head`."""
    ctl("mark", "an event to print")
    assert "Traceback" not in unread("ctl", *line.split())


def test_a_refusal_names_client_user_and_process_with_working_advice(ctl, machine, place):
    user = pwd.getpwuid(os.getuid()).pw_name
    with Client(place.socket, name="cell controller") as other, other.lease():
        said = ctl("move", "joint-1", 1, status=7)
        assert f"'cell controller ({user}, process {os.getpid()})' holds the lease" in said
        assert "repeat the command with --force" in said
        ctl("move", "joint-1", 1, "--force")
    assert machine.moved == [("joint-1", "move", 1.0, None)]


@pytest.mark.parametrize("line", ["enable joint-1", "stop", "get joint-1 6041h", "lease", "mark words"])
def test_the_machine_is_named_if_not_given(hdbridge, machine, place, monkeypatch, line):
    done = hdbridge("ctl", *line.split())
    assert done.stderr == f"machine 'cell' at {place.socket} (from HDBRIDGE_SOCKET)\n"
    monkeypatch.delenv("HDBRIDGE_SOCKET")
    assert hdbridge("ctl", *line.split(), "--at", place.socket).stderr == ""
    (place.socket.parent / "hdbridge").mkdir(exist_ok=True)
    found = place.socket.parent / "hdbridge" / "cell.sock"
    found.symlink_to(place.socket)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place.socket.parent))
    done = hdbridge("ctl", *line.split())
    found.unlink()
    assert done.stderr == f"machine 'cell' at {found}\n"


@pytest.mark.parametrize(("line", "width"), [("status", 120), ("status", 60), ("watch --count 1", 60)])
def test_tables_are_complete_at_any_width(ctl, process, machine, monkeypatch, line, width):
    shown = (
        machine.axes["joint-2"]
        .state()
        .model_copy(
            update={
                "load_target_deg": -1234.5678,
                "load_position_deg": -1234.5679,
                "error_arcsec": -98765.43,
                "correction_arcsec": 12345.67,
                "queued": 17,
                "mode": messages.MotionMode.GOTO,
                "scheme": messages.Scheme.EXTENDED,
            }
        )
    )
    monkeypatch.setattr(machine.axes["joint-2"], "state", lambda: shown)
    for name, value in (("COLUMNS", str(width)), ("FORCE_COLOR", "1"), ("TERM", "xterm")):
        monkeypatch.setenv(name, value)
    lines = (
        re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", process("ctl", *line.split()).stdout)
        .replace("\r", "\n")
        .splitlines()
    )
    rows = [each for each in lines if each[:1] in tuple("┏┃┡│└")]
    assert rows
    assert max(map(len, rows)) <= width
    cells = {cell.strip() for row in rows for cell in re.split("[│┃]", row)}
    whole = {
        "joint-2", "-1234.5678", "-1234.5679", "-98765.43", "12345.67", "extended",
        "disabled, goto, 17 wait", "correction, arcsec",
    }  # fmt: skip
    assert whole <= cells
    assert "…" not in "".join(lines)


@pytest.mark.usefixtures("at_a_terminal")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_moving_axis(machine, tmp_path, number):
    machine.axes["joint-1"].moving_s = 2 * PATIENCE_S
    with started(tmp_path, "ctl", "move", "joint-1", 30) as moving:
        until(lambda: machine.moved)
        moving.send_signal(number)
        _, said = moving.communicate()
    assert moving.returncode == 130
    assert "axis 'joint-1' is stopped; it stays enabled" in said
    assert "Traceback" not in said
    assert machine.stopped == [("joint-1", "stop")]
    assert not machine.state().lease.held
