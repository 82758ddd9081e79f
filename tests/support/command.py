"""Runs ``hdbridge ARGS...`` in the process of the tests, which saves half a second of start-up each time."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from hdbridge.cli import main


def run_here(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs the command in ``folder``, without a terminal and with an empty standard input."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["hdbridge", *map(str, arguments)])
        patch.setattr(sys, "stdin", io.StringIO(""))
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as end:
            main()
    return subprocess.CompletedProcess(arguments, end.value.code or 0, out.getvalue(), err.getvalue())
