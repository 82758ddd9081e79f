"""The command line as a person uses it: its output and its exit status."""

import os
import shutil
from functools import partial
from pathlib import Path

import pytest
from support.command import run_apart, run_here

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


def refused(done, *texts: str) -> None:
    """Checks that the only output is one line on standard error, with these words."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("hdbridge: ")]
    assert "Traceback" not in done.stderr
    assert len(lines) == 1, done.stderr
    for text in texts:
        assert text in lines[0]
    assert done.stdout == ""


@pytest.fixture
def hdbridge(tmp_path):
    """Run `hdbridge ARGS...` in an empty folder."""
    return partial(run_here, tmp_path)


@pytest.fixture
def process(tmp_path):
    """Runs a command in a process of its own, for tests of its standard output."""
    return partial(run_apart, tmp_path)


@pytest.fixture
def unread(tmp_path):
    """Runs `hdbridge ARGS... | true`, whose output nobody reads; returns its standard error."""

    def run(*arguments: object) -> str:
        reader, writer = os.pipe()
        os.close(reader)
        with os.fdopen(writer, "w") as broken:
            return run_apart(tmp_path, *arguments, stdout=broken).stderr

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
