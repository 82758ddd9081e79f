"""Interruptions and full disks lose no measurement; one measurement per axis at a time."""

import fcntl
import json
import resource
import signal
import subprocess
import sys

import pytest
from support import patience
from support.command import run_apart, run_here, started

from hdbridge.records.recording import Recording

TERMINAL = {"FORCE_COLOR": "1", "NO_COLOR": "1", "TERM": "xterm"}
"""Makes a command show its progress bar, which appears with the first step, on a pipe as well."""
LONG = ("step", "article", "--simulate", "--count", 400, "--step-deg", 20)


def until(said, folder, *arguments, **options):
    """Starts a command and returns it once it has printed this on standard error."""
    process = started(folder, *arguments, **options)
    assert process.stderr is not None
    while said not in (line := process.stderr.readline()):
        assert line, "it ended early"
    return process


@pytest.mark.usefixtures("at_a_terminal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_termination_signal_stops_in_order_and_keeps_the_measurement(tmp_path, number):
    process = until(" %", tmp_path, *LONG, "--record", "kept", env=TERMINAL)
    process.send_signal(number)
    _, errors = process.communicate()
    assert process.returncode == 130, errors
    (kept,) = (tmp_path / "kept").glob("*-stopped.csv.gz")
    scheme = kept.name.removeprefix("stepping-").removesuffix("-stopped.csv.gz")
    assert f"stopped in '{scheme}' after" in errors
    assert f"kept in kept/{kept.name}" in errors
    assert len(Recording.load(kept).record)


def test_results_of_finished_schemes_are_printed_and_written(tmp_path):
    outputs = ("--record", "kept", "--json", "figures.json", "--html", "page.html")
    process = until("booted", tmp_path, "step", "article", "--simulate", "--count", 40, *outputs)
    first = tmp_path / "kept" / "stepping-none.csv.gz"
    patience.until(lambda: first.exists() or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    printed, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "│ none" in printed
    assert "│ both" not in printed
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert "none" in figures
    assert "both" not in figures
    assert (tmp_path / "page.html").exists()


def test_signals_ignored_by_nohup_stay_ignored(tmp_path):
    process = subprocess.Popen(
        ["nohup", sys.executable, "-m", "hdbridge", "step", "article", "--simulate", "--count", "2"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while "booted" not in process.stderr.readline():
        pass
    process.send_signal(signal.SIGHUP)
    _, errors = process.communicate()
    assert process.returncode == 0, errors


def test_a_full_disk_during_motion_loses_no_figures(tmp_path):
    step = ("step", "article", "--simulate", "--count", 2, "--scheme", "none")
    outputs = ("--json", "out.json", "--html", "out.html", "--record", "kept")
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))  # noqa: E731
    done = run_apart(tmp_path, *step, *outputs, preexec_fn=full, status=6)
    assert "quantisation floor" in done.stdout
    assert done.stderr.count("cannot be written: File too large") == 3
    assert done.stderr.count("hdbridge: ") == 1
    assert not [each for each in tmp_path.rglob("*") if each.is_file()]


def test_one_measurement_of_an_axis_at_a_time(hdbridge, profile, tmp_path):
    with (profile.folder / "axis.yaml").open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        done = hdbridge("calibrate", profile.folder, "--simulate", "--out", "rec", status=2)
    assert "another hdbridge process is measuring this axis" in done.stderr
    assert "booted" not in done.stderr
    assert not (tmp_path / "rec").exists()


def test_a_folder_takes_the_results_of_one_process_at_a_time(tmp_path):
    with until("booted", tmp_path, *LONG, "--record", "kept") as first:
        for second in (
            ("step", "article", "--simulate", "--count", 2, "--record", "kept"),
            ("demo", "--count", 2, "--out", "kept"),
            ("measure", "demo", "--simulate", "--out", "kept"),
            ("calibrate", "demo", "--simulate", "--out", "kept"),
            ("fleet", "simulate", "kept"),
        ):
            refused = run_here(tmp_path, *second, status=2)
            assert "kept: another hdbridge process writes to this folder" in refused.stderr
            assert "booted" not in refused.stderr
        assert (tmp_path / "kept").is_dir()
        first.send_signal(signal.SIGINT)
        first.communicate()
    assert first.returncode == 130
    assert [each.name.endswith("-stopped.csv.gz") for each in (tmp_path / "kept").iterdir()] == [True]


def test_calibrations_within_one_second_get_separate_folders(monkeypatch, tmp_path):
    from hdbridge.files.atomic import new_folder

    monkeypatch.chdir(tmp_path)
    made = [new_folder(tmp_path / "recordings" / "axis-20250101-000000").name for _ in range(3)]
    assert made == [f"axis-20250101-000000{each}" for each in ("", "-2", "-3")]


def test_a_small_file_needs_little_memory(tmp_path):
    (tmp_path / "one.csv").write_text(
        "time_s,motor_position_deg,load_position_deg\n" + "".join(f"{n},{n},{n / 50}\n" for n in range(9))
    )
    script = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from hdbridge.records.record import Record\n"
        "used = 4096 * int(Path('/proc/self/statm').read_text().split()[0])\n"
        "resource.setrlimit(resource.RLIMIT_AS, 2 * (used + (256 << 20),))\n"
        "print(len(Record.read_csv('one.csv')))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout == "9\n", done.stderr
