"""The command line as a person uses it: a process, its output and its exit status."""

import io
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hdbridge.cli import main

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


@pytest.fixture
def hdbridge(tmp_path):
    """Run `hdbridge ARGS...` in an empty folder."""

    def run(*arguments: object, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "hdbridge", *map(str, arguments)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run


@pytest.fixture
def unread(tmp_path):
    """Run `hdbridge ARGS... | true`, where nobody reads what it prints: its standard error."""

    def run(*arguments: object) -> str:
        reader, writer = os.pipe()
        os.close(reader)
        with os.fdopen(writer, "w") as broken:
            return subprocess.run(
                [sys.executable, "-m", "hdbridge", *map(str, arguments)],
                cwd=tmp_path,
                stdout=broken,
                stderr=subprocess.PIPE,
                text=True,
                timeout=120,
                check=False,
            ).stderr

    return run


@pytest.fixture
def here(monkeypatch, capsys, tmp_path):
    """The same in this process, which spares its start; nobody answers its questions."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["hdbridge", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.StringIO(""))
        with pytest.raises(SystemExit) as end:
            main()
        out, err = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, end.value.code or 0, out, err)

    return run


@pytest.fixture
def profile(tmp_path):
    """A copy of the article's profile, with a function that edits its files."""
    folder = tmp_path / "profile"
    shutil.copytree(PROFILE, folder)

    def edit(old: str, new: str, file: str = "axis.yaml") -> Path:
        path = folder / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        return folder

    edit.folder = folder
    return edit
