"""Invalid arguments and options of every command are refused in one line, without side effects.

Commands, parameters and their ranges are read from the command line itself.
"""

import inspect
import os
import resource
import shutil
import socket
import typing
from dataclasses import dataclass
from pathlib import Path

import command_reference
import numpy as np
import pytest
from support.command import run_apart, run_here
from typer.models import ArgumentInfo

from hdbridge.cli import PANELS, load
from hdbridge.files.outputs import Kind
from hdbridge.records.record import Record

PROFILES = Path(__file__).parents[2] / "profiles"
LONG = "x" * 300
UNREADABLE = (
    "",
    "b\udcfcro",
    "pipe",
    "nowhere/at/all",
    "circle",
    LONG,
    "junk",
    "empty",
    "/dev/zero",
    "/dev/null",
)
UNWRITABLE = {
    "file": ("", "b\udcfcro", "circle", LONG, "junk", "axis", "nowhere/at/all", "junk/new"),
    "folder": ("", "b\udcfcro", "circle", LONG, "junk", "axis", "junk/new", "pipe"),
}
RIGHT = {
    "PROFILE": "axis", "MACHINE": "axis", "NAME": "fresh", "RECORD": "record.csv", "RECORDING": "record.csv",
    "LOG": "bus.log", "OBJECT": "6064h", "VALUE": "1", "ANGLE": "1", "AXIS": "joint-1",
    "SPEED": "1",
    "TEXT": "words", "VERSION": "1", "FILE.mcap": "flight.mcap", "FILE.mcap|FOLDER": "flight.mcap",
    "SCHEME": "both", "KIND": "step", "BEFORE": "active", "AFTER": "active", "MODE": "on",
    "--method": "35", "--model": "axis/model.yaml", "--on": "", "--out": "out", "--manifest": "fleet.csv",
    "OUT": "axis", "FOLDER": "out",
}  # fmt: skip
"""Valid values for the other arguments of a command that is given one invalid value. The command is refused
before it uses them.
"""
NEEDED = {
    ("diagnose", "--model"), ("record", "export", "--out"), ("record", "import", "--out"),
    ("fleet", "run", "--out"), ("fleet", "run", "--manifest"),
    ("fleet", "watch", "--out"), ("fleet", "watch", "--manifest"),
}  # fmt: skip
"""Options that are required only in some uses of a command, among them the use tested here."""
PARENTS_MADE = {
    ("new", "NAME"), ("record", "export", "--out"), ("record", "import", "--out"),
    ("fleet", "run", "--out"), ("fleet", "watch", "--out"), ("fleet", "simulate", "FOLDER"),
}  # fmt: skip
"""Arguments for which a missing folder is valid, even if its parents are missing, too."""
BY_ANOTHER = {("setup", "NAME"), ("setup", "--eds")}
"""Arguments that are refused not by `setup` itself but by the command that it prints and runs."""
PRINTS = {("doctor",)}
"""Commands that print to standard output even if an argument is invalid: `doctor` lists the checks of the
axis file, which include it.
"""


@dataclass(frozen=True)
class Parameter:
    """Arguments for one parameter of a command, and its invalid values."""

    name: str
    option: str
    typed: str
    required: bool
    wrong: tuple[str, ...]


def wrong(kind, info, output):
    """Values that a parameter of this kind cannot have."""
    if kind in (int, float):
        beyond = [
            repr(kind(limit + sign * max(1, abs(limit)))) for limit, sign in ((info.min, -1), (info.max, 1))
            if limit is not None
        ]  # fmt: skip
        return ("", "soon", "nan", "inf", "-inf", "1e400", *beyond, *(("1.5",) if kind is int else ()))
    if output is not None:
        return UNWRITABLE["folder" if output is Kind.FOLDER else "file"]
    if kind is Path or info.metavar in ("PROFILE", "MACHINE"):
        return UNREADABLE
    return ("",) if kind is str else ()


def parameters(command, callback):
    hints = typing.get_type_hints(callback, include_extras=True)
    for name, each in inspect.signature(callback).parameters.items():
        kind, info, *more = typing.get_args(hints[name])
        kind, _ = command_reference._plain(kind)
        known = command_reference._parameter(name, hints[name], each.default)
        option = "" if isinstance(info, ArgumentInfo) else known.names[0]
        output = next((each for each in more if isinstance(each, Kind)), None)
        values = tuple(value for value in wrong(kind, info, output) if value or known.default != "``")
        if (*command, known.names[0]) in PARENTS_MADE:
            values = tuple(value for value in values if value != "nowhere/at/all")
        if (*command, known.names[0]) in BY_ANOTHER:
            values = ()
        yield Parameter(name, option, known.names[0], known.required, values)


def commands():
    for panel in PANELS.values():
        for name in panel:
            app = load(name)
            groups = [group.typer_instance for group in app.registered_groups]
            for each in (app, *groups):
                for registered in each.registered_commands:
                    own = registered.name or registered.callback.__name__.replace("_", "-")
                    words = (own,) if each is app else (name, own)
                    yield words, tuple(parameters(words, registered.callback))


COMMANDS = dict(commands())


def line(command, changed, value):
    """A whole command line with one value changed."""
    options, arguments = [], []
    for each in COMMANDS[command]:
        given = value if each is changed else RIGHT.get(each.typed)
        if given is None:
            continue
        if not each.option:
            arguments.append(given)
        elif each is changed or each.required or (*command, each.typed) in NEEDED:
            options.append(f"{each.option}={given}" if each is changed or given else each.option)
    named = {each.name for each in COMMANDS[command]}
    if "simulate" in named and changed.name not in ("interface", "channel"):
        options.append("--simulate")
    return [*command, *options, *(["--"] if value in arguments and value.startswith("-") else []), *arguments]


@pytest.fixture
def place(tmp_path):
    """A folder with one file of every kind."""
    shutil.copytree(PROFILES / "article", tmp_path / "axis")
    rows = "".join(f"{number},{number},{number / 50}\n" for number in range(9))
    (tmp_path / "record.csv").write_text("time_s,motor_position_deg,load_position_deg\n" + rows)
    (tmp_path / "bus.log").write_text("(1.000000) can0 080#\n")
    (tmp_path / "fleet.csv").write_text("path,joint\nrecord.csv,J1\n")
    (tmp_path / "junk").write_bytes(bytes(range(256)))
    (tmp_path / "empty").touch()
    (tmp_path / "circle").symlink_to("circle")
    os.mkfifo(tmp_path / "pipe")
    return tmp_path


def contents(folder):
    return {path: path.stat().st_size if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_invalid_arguments_are_refused_without_side_effects(command, place, monkeypatch):
    monkeypatch.delenv("HDBRIDGE_SOCKET", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    before, complaints = contents(place), []
    for parameter in COMMANDS[command]:
        for value in parameter.wrong:
            words = line(command, parameter, value)
            done = run_here(place, *words, status=None)
            said = done.stderr.splitlines()
            right = (
                done.returncode == 2
                and (done.stdout == "" or command in PRINTS)
                and len(said) == 1
                and said[0].startswith("hdbridge: ")
                and (parameter.typed in said[0] or (value and value in said[0]))
            )
            if not right:
                complaints.append((words, done.returncode, done.stdout[:100], said[-2:]))
            assert contents(place) == before, words
    assert complaints == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("step axis --simulate --step-deg 0", "--step-deg: found 0; expected the size of a step"),
        (
            "step axis --simulate --start-deg 1e300",
            "move the load to 1e+300 deg; the axis file allows -400 to 400",
        ),
        ("step axis --simulate --step-deg -1e300", "the axis file allows -400 to 400"),
        ("move axis 1e300 --simulate", "the axis file allows -400 to 400"),
        ("move axis 0 401 --simulate", "the axis file allows -400 to 400"),
        (
            "home axis --simulate --method 35 --offset 1e300",
            "--offset: found 1e+300; expected an angle within",
        ),
        (
            "home axis --simulate --method 35 --switch-velocity 21",
            "--switch-velocity: found 21.0; expected above 0",
        ),
        (
            "home axis --simulate --method 35 --zero-velocity 1e300",
            "--zero-velocity: found 1e+300; expected above 0",
        ),
        ("home axis --simulate --method 35 --acceleration 1e300", "--acceleration: found 1e+300"),
        ("step axis --interface cann0 --channel can0", "--interface: python-can has no interface 'cann0'"),
        ("scan --interface cann0 --channel can0", "python-can has no interface 'cann0'"),
        ("run axis --interface cann0 --channel can0", "--interface: python-can has no interface 'cann0'"),
        ("record mend empty", "not a flight recording"),
        ("record mend /dev/null", "not a flight recording"),
    ],
)
def test_requests_beyond_the_axis_are_refused_before_connecting(place, words, complaint):
    before = contents(place)
    done = run_here(place, *words.split(), status=2)
    assert complaint in done.stderr
    assert "booted" not in done.stderr
    assert contents(place) == before
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize(
    ("words", "pending"),
    [
        ("calibrate axis --simulate", "pending.yaml"),
        ("improve axis --simulate", "pending.yaml"),
        ("twin axis sweep.csv", "pending-twin.yaml"),
    ],
)
def test_a_profile_that_cannot_be_written_is_refused_before_a_measurement(place, words, pending):
    """As on a read-only disk: the place of the result is blocked, here by a folder."""
    (place / "axis" / pending).mkdir()
    turns = np.abs(np.linspace(-3600.0, 3600.0, 4000))
    columns = {
        "time_s": 0.004 * np.arange(4000),
        "motor_position_deg": turns,
        "load_position_deg": turns / 50,
    }
    Record({**columns, "motor_target_deg": turns}).write_csv(place / "sweep.csv")
    before = contents(place)
    done = run_here(place, *words.split(), status=2)
    assert f"axis/{pending}: cannot be written: it is a folder" in done.stderr
    assert "booted" not in done.stderr
    assert contents(place) == before


def test_an_axis_file_that_is_a_folder_is_named_once(place):
    (place / "axis" / "axis.yaml").unlink()
    (place / "axis" / "axis.yaml").mkdir()
    for profile in ("axis", "axis/axis.yaml"):
        done = run_here(place, "check", profile, status=2)
        assert f"{profile}: has no file axis.yaml; expected the folder of an axis" in done.stderr


@pytest.mark.parametrize("name", ["axis.yaml", "model.yaml", "truth.yaml"])
def test_a_named_pipe_in_a_profile_is_refused_at_once(place, name):
    (place / "axis" / name).unlink()
    os.mkfifo(place / "axis" / name)
    done = run_here(place, "step", "axis", "--simulate", "--count", 2, status=2)
    assert f"axis/{name}: cannot be read: it is a named pipe; expected a file" in done.stderr


def test_a_record_may_come_from_a_shell_pipe(place):
    with (place / "record.csv").open("rb") as file:
        done = run_here(
            place, "diagnose", f"/dev/fd/{file.fileno()}", "--model", "axis/model.yaml", status=None
        )
    assert "named pipe" not in done.stderr


def test_check_knows_python_can_and_local_interfaces(place):
    file = place / "axis" / "axis.yaml"
    text = file.read_text()
    file.write_text(text.replace("interface: virtual", "interface: socketcna"))
    done = run_here(place, "check", "axis", status=2)
    assert "bus.interface: python-can has no interface 'socketcna'" in done.stderr
    assert "did you mean 'socketcan'?" in done.stderr
    file.write_text(
        text.replace("interface: virtual", "interface: socketcan").replace(
            "channel: hdbridge", "channel: cann0"
        )
    )
    done = run_here(place, "check", "axis")  # at a desk, the interface may be another computer's
    assert "bus.channel: this computer has no network interface 'cann0'" in done.stderr


@pytest.mark.parametrize("name", ["mine", "cells/left/mine"])
def test_a_new_profile_on_a_full_disk_leaves_no_files(tmp_path, name):
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))  # noqa: E731
    done = run_apart(tmp_path, "new", name, preexec_fn=full, status=6)
    assert "cannot be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_names_its_option(place, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run_here(place, "run", "axis", "--simulate", "--page", "--port", port, status=7)
    assert (
        f"127.0.0.1:{port}: another process listens there; stop it, or give --port another number"
        in done.stderr
    )
