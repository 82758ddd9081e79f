"""Properties of all commands: writable results, complete tables, closed outputs."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.command import started


def test_no_figure_is_cut_in_a_narrow_terminal(process, profile):
    shown = process("model", "diff", profile.folder, "active", "active", env={"COLUMNS": "30"})
    assert "…" not in shown.stdout
    assert "orders[2].amplitude_arcsec" in shown.stdout


def test_output_to_a_file_has_no_colours_or_control_characters(hdbridge):
    done = hdbridge("step", "article", "--simulate", "--count", 2, "--scheme", "none")
    assert "\x1b" not in done.stdout + done.stderr


def test_the_version_and_the_short_help(hdbridge):
    from hdbridge import __version__

    assert hdbridge("--version").stdout == f"hdbridge {__version__}\n"
    assert hdbridge("step", "-h").stdout == hdbridge("step", "--help").stdout


def test_a_closed_output_pipe_is_not_an_error_and_results_are_complete(unread, tmp_path):
    arguments = ("article", "--simulate", "--count", 2, "--scheme", "none")
    errors = unread("step", *arguments, "--json", "out.json")
    assert "Traceback" not in errors
    assert "Exception" not in errors
    assert json.loads((tmp_path / "out.json").read_text())["schema"].startswith("hdbridge.")


@pytest.mark.parametrize("arguments", [("--help",), ("check", "article", "--json", "-")])
def test_a_closed_pipe_of_help_or_json_is_not_an_error(unread, arguments):
    assert unread(*arguments) == ""


def test_a_closed_standard_output_is_not_an_error(tmp_path):
    line = f'exec "{sys.executable}" -m hdbridge check article --json out.json >&-'
    done = subprocess.run(["sh", "-c", line], stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "wrote out.json\n")
    assert json.loads((tmp_path / "out.json").read_text())["axis"] == "article"


@pytest.mark.parametrize("of_class", [False, True])
@pytest.mark.parametrize(
    ("slow", "arguments"), [("typer", ("--help",)), ("numpy", ("step", "article", "--simulate"))]
)
def test_ctrl_c_during_start_up_prints_no_traceback(tmp_path, slow, arguments, of_class):
    """An import, or the creation of a class in it, that never ends stands for a slow one."""
    waits = "def wait(*_):\n import time\n print('loading', flush=True)\n time.sleep(600)\n"
    waiting = "class C:\n it = type('Slow', (), {'__set_name__': wait})()\n" if of_class else "wait()\n"
    (tmp_path / f"{slow}.py").write_text(waits + waiting)
    with started(Path.cwd(), *arguments, env={"PYTHONPATH": str(tmp_path)}) as process:
        assert process.stdout.readline() == "loading\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 130
    assert errors == ""


def test_characters_unknown_to_the_terminal_are_replaced(process):
    step = ("step", "article", "--simulate", "--count", 2, "--scheme", "none")
    shown = process(*step, env={"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"})
    assert "CW 3s" in shown.stdout


def test_a_full_standard_output_ends_in_one_line(process):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = process("check", "article", stdout=full, status=6)
    assert done.stderr.splitlines() == [
        "hdbridge: the standard output cannot be written: No space left on device"
    ]


def test_a_full_standard_error_costs_neither_result_nor_exit_status(process):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        step = process(
            "step", "article", "--simulate", "--count", 2, "--scheme", "none", "--record", "kept", stderr=full
        )
        process("check", "absent", stderr=full, status=2)
    assert "quantisation floor" in step.stdout
