"""Runs ``hdbridge ARGS...``, in the process of the tests or in one of its own."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from hdbridge.cli import main


def run_here(folder: Path, *arguments: object, status: int | None = 0) -> subprocess.CompletedProcess[str]:
    """Runs the command in ``folder`` and this process, which saves half a second of start-up, without a
    terminal and with an empty standard input. AssertionError for another exit status; None permits any.
    """
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["hdbridge", *map(str, arguments)])
        patch.setattr(sys, "stdin", io.StringIO(""))
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as end:
            main()
    return _checked(arguments, end.value.code or 0, out.getvalue(), err.getvalue(), status)


def started(
    folder: Path, *arguments: object, env: dict[str, str] | None = None, **options: Any
) -> subprocess.Popen[str]:
    """Starts the command in ``folder`` and a process of its own; ``env`` is added to the environment.

    It writes no bytecode, because a full disk would cut it off, and every later process would fail.
    Standard output and error are pipes unless ``options`` of `subprocess.Popen` say otherwise.
    """
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    command = [sys.executable, "-B", "-m", "hdbridge", *map(str, arguments)]
    return subprocess.Popen(command, cwd=folder, env={**os.environ, **(env or {})}, text=True, **options)


def run_apart(
    folder: Path, *arguments: object, status: int | None = 0, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Runs the command to its end in a process of its own; see `started` and `run_here`."""
    with started(folder, *arguments, **options) as process:
        out, err = process.communicate()
    return _checked(arguments, process.returncode, out, err, status)


def _checked(
    arguments: tuple[object, ...], found: Any, out: str, err: str, expected: int | None
) -> subprocess.CompletedProcess[str]:
    assert expected in (None, found), f"{arguments}: status {found}, expected {expected}; {err or out}"
    return subprocess.CompletedProcess(arguments, found, out, err)
