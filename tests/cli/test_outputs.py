"""Outputs destroy nothing: they are refused before anything is computed, or written directly."""

import json
import os
import shutil
import stat
import threading
import typing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis.model import TransmissionModel
from hdbridge.cli import PANELS, load
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind, Output, check_outputs

RECORD = "time_s,motor_position_deg,load_position_deg\n" + "".join(
    f"{0.01 * n},{n},{n / 50}\n" for n in range(200)
)


@pytest.fixture
def bench(tmp_path, profile):
    """A folder with a profile, a record and a recording, and a function that checks that they are
    unchanged.
    """
    (tmp_path / "one.csv").write_text(RECORD)
    (tmp_path / "other.csv").write_text(RECORD)
    shutil.copytree(profile.folder, tmp_path / "p")
    shutil.rmtree(profile.folder)
    history = tmp_path / "p" / "history"
    history.mkdir()
    shutil.copy(tmp_path / "p" / "model.yaml", history / "0001.yaml")
    shutil.copy(tmp_path / "p" / "model.yaml", tmp_path / "p" / "pending.yaml")
    kept = tmp_path / "rec"
    kept.mkdir()
    (kept / "recording.yaml").write_text("schema: hdbridge.recording/1\n")
    (kept / "sweep.csv").write_text(RECORD)
    before = {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()}

    def stands() -> bool:
        return before == {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()}

    return stands


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("fit one.csv --ratio 50 --json one.csv", "--json would overwrite one.csv, which this command reads"),
        ("fit one.csv --ratio 50 --html sub/../one.csv", "--html would overwrite one.csv"),
        ("fit one.csv --ratio 50 --json other.csv", "which is not a result of hdbridge"),
        ("fit one.csv --ratio 50 --out out --json out", "--out and --json both write to this path"),
        ("fit one.csv --ratio 50 --out Out --json out", "both write to this path"),
        ("fit one.csv --ratio 50 --out p/model.yaml", "hdbridge model commit"),
        ("fit one.csv --ratio 50 --out p/axis.yaml", "file of a profile"),
        ("fit rec --ratio 50 --json rec/sweep.csv", "of the recording"),
        ("fit rec --ratio 50 --json rec/calibration.json", "of the recording"),
        ("diagnose one.csv --model p/model.yaml --extend p/model.yaml", "which this command reads"),
        ("check p --json p/axis.yaml", "of the profile"),
        ("check p --json p/history/0002.yaml", "of the profile"),
        ("check p/axis.yaml --json p/pending.yaml", "of the profile"),
        ("model log p --json p/history/0001.yaml", "of the profile"),
        ("calibrate p --simulate --out p", "not empty"),
        ("calibrate p --simulate --out p/history", "not empty"),
        ("calibrate p --simulate --out p/history/new", "the history of the profile"),
        ("calibrate p --simulate --out one.csv/x", "one.csv is not a folder"),
        ("step p --simulate --count 2 --record rec", "not empty"),
        ("demo --count 2 --out rec", "not empty"),
    ],
)  # fmt: skip
def test_destructive_outputs_are_refused_before_anything_is_read(hdbridge, bench, line, words):
    done = hdbridge(*line.split(), status=2)
    assert words in done.stderr
    assert (done.stderr.count("\n"), done.stdout) == (1, "")
    assert bench()


def test_a_pending_model_may_be_written_to_a_profile(tmp_path, bench):
    for name in ("pending.yaml", "first/model.yaml"):
        (tmp_path / "p" / "first").mkdir(exist_ok=True)
        shutil.copy(tmp_path / "p" / "axis.yaml", tmp_path / "p" / "first")
        check_outputs([Output("--out", tmp_path / "p" / name, Kind.MODEL)])


def test_stepping_twice_into_one_folder_keeps_the_first(hdbridge, tmp_path):
    command = ("step", "article", "--simulate", "--count", 2, "--scheme", "none", "--record", "kept")
    hdbridge(*command)
    first = (tmp_path / "kept" / "stepping-none.csv.gz").read_bytes()
    again = hdbridge(*command, "--seed", 1, status=2)
    assert "kept: --record would write into a folder that is not empty" in again.stderr
    assert (tmp_path / "kept" / "stepping-none.csv.gz").read_bytes() == first


def test_a_dash_means_standard_output_and_tables_go_to_standard_error(process, tmp_path):
    for place in ("-", "/dev/fd/1"):
        done = process("check", "article", "--json", place)
        assert json.loads(done.stdout if place == "-" else done.stdout.split("\n}\n")[0] + "}")
        assert "all right" in (done.stderr if place == "-" else done.stderr + done.stdout)
    assert not (tmp_path / "-").exists()
    process("fit", "x.csv", "--json", "-", "--html", "/dev/stdout", status=2)


def test_a_pipe_is_written_directly(hdbridge, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    hdbridge("check", "article", "--json", "pipe")
    reader.join()
    assert json.loads(read[0])["axis"] == "article"
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_device_is_never_replaced(hdbridge, tmp_path):
    """Root creates a device node; other users use the terminal's, which they may not replace."""
    device = tmp_path / "null"
    try:
        os.mknod(device, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        device.open("w").close()
    except OSError:
        device = Path("/dev/null")
        if os.geteuid() == 0:
            pytest.skip("device nodes do not work here")
    hdbridge("fit", "article", "--json", device, status=2)
    hdbridge("check", "article", "--json", device)
    hdbridge("model", "log", "article", "--json", device)
    TransmissionModel(50.0).save(device)
    assert stat.S_ISCHR(device.stat().st_mode)


def test_a_socket_is_refused_as_output(hdbridge, tmp_path, monkeypatch):
    import socket

    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("place")
        done = hdbridge("check", "article", "--json", "place", status=2)
    assert "neither a file nor a pipe nor a character device" in done.stderr


def test_a_file_already_open_in_the_shell_is_refused(process, tmp_path):
    with (tmp_path / "out").open("w") as out:
        done = process("check", "article", "--json", "out", stdout=out, status=2)
    assert "standard output already goes there" in done.stderr


def test_dangling_output_names_give_one_line(hdbridge, tmp_path):
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    for place, words in (("circle", "circle"), ("x" * 300, "too long"), ("one/two", "no folder")):
        done = hdbridge("check", "article", "--json", place, status=2)
        assert words in done.stderr
        assert done.stderr.count("\n") == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == ["circle"]


SPELLINGS = {
    "same": lambda path: path,
    "relative": lambda path: Path(os.path.relpath(path)),
    "roundabout": lambda path: path.parent / "missing" / ".." / "." / path.name,
    "symbolic link": lambda path: _linked(path, os.symlink),
    "link of a link": lambda path: _linked(_linked(path, os.symlink), os.symlink),
    "hard link": lambda path: _linked(path, os.link),
    "link of its folder": lambda path: _linked(path.parent, os.symlink) / path.name,
}
OF_A_FILE_TO_BE = sorted({*SPELLINGS, "other case"} - {"hard link"})


def _linked(path: Path, link: typing.Callable[[Path, Path], None]) -> Path:
    place = path.with_name(f"link-{len(list(path.parent.iterdir()))}-{path.name}")
    link(path, place)
    return place


def _is_seen_to_be_one(one: Path, other: Path) -> None:
    with pytest.raises(InputError, match="both write to this path"):
        check_outputs([Output("--json", one, Kind.JSON), Output("--html", other, Kind.JSON)])
    check_outputs([Output("--json", one, Kind.JSON), Output("--html", other.parent / "two", Kind.PAGE)])


@given(st.tuples(*2 * [st.sampled_from(sorted(SPELLINGS))]))
def test_aliases_of_a_file_are_recognised(tmp_path_factory, names):
    file = tmp_path_factory.mktemp("names") / "one.json"
    file.write_text('{"schema": "hdbridge.check/1"}')
    one, other = (SPELLINGS[each](file) for each in names)
    with pytest.raises(InputError, match="which this command reads"):
        check_outputs([Output("--json", one, Kind.JSON)], [other])
    _is_seen_to_be_one(one, other)


@given(st.tuples(*2 * [st.sampled_from(OF_A_FILE_TO_BE)]))
def test_aliases_of_a_future_file_are_recognised(tmp_path_factory, names):
    file = tmp_path_factory.mktemp("names") / "one.json"
    more = {**SPELLINGS, "other case": lambda path: path.with_name("ONE.json")}
    _is_seen_to_be_one(*(more[each](file) for each in names))


def test_every_output_option_is_guarded():
    """`--json` and `--html` are outputs everywhere; other outputs begin their help with "Write"."""
    outputs = set()
    for name in (name for panel in PANELS.values() for name in panel):
        loaded = load(name)
        groups = [each.typer_instance for each in loaded.registered_groups]
        for command in (each for app in (loaded, *groups) for each in app.registered_commands):
            hints = typing.get_type_hints(command.callback, include_extras=True)
            for parameter, hint in hints.items():
                info = next(
                    (each for each in getattr(hint, "__metadata__", ()) if hasattr(each, "help")), None
                )
                says = (info.help or "") if info else ""
                names_a_place = bool not in typing.get_args(hint)  # a flag is no output
                writes = names_a_place and says.startswith("Write")
                guarded = any(isinstance(each, Kind) for each in getattr(hint, "__metadata__", ()))
                assert writes == guarded, (name, parameter, says)
                outputs |= {parameter} if writes else set()
    assert len(outputs) > 3, outputs
