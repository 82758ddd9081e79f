"""`hdbridge reset`, and that every message which asks for a reset names the command."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from hdbridge.errors import RESET
from hdbridge.testing import simulated_drive

PACKAGE = Path(__file__).parents[2] / "hdbridge"
ASKS = re.compile(r"\breset (it|its|the (fault|axis|drive)|that)\b")


@pytest.fixture
def faulty():
    """Drive in fault in this process, and the command-line options that address it."""
    with simulated_drive("article", bus="virtual") as drive:
        drive.fault("drive_fault", code=0x3210)
        drive.sleep(0.5)
        yield drive, ("--interface", drive.interface, "--channel", drive.channel)


def test_the_suggested_command_resets_the_fault(hdbridge, faulty, tmp_path):
    drive, bus = faulty
    before_deg = drive.truth.load_deg
    refused = hdbridge("move", "article", 1, "--hold", 0, *bus, status=4)
    assert "3210h" in refused.stderr
    assert RESET in refused.stderr
    done = hdbridge("reset", "article", *bus, "--json", "reset.json")
    assert "the fault is reset (error code 3210h, DC link over-voltage" in done.stdout
    assert json.loads((tmp_path / "reset.json").read_text())["state"] == "switch on disabled"
    assert drive.truth.load_deg == pytest.approx(before_deg, abs=1e-3)
    again = hdbridge("reset", "article", *bus)
    assert again.stdout == "there is no fault to reset: the drive is in 'switch on disabled'\n"


def test_without_a_fault_nothing_is_done(hdbridge):
    done = hdbridge("reset", "article", "--simulate")
    assert "there is no fault to reset" in done.stdout


def texts(tree: ast.Module) -> Iterator[str]:
    """Returns all strings of a module except docstrings; f-strings with their expressions."""
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(each) for each in node.values}
            yield ast.unparse(node)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped:
            yield node.value


def test_every_message_asking_for_a_reset_names_the_command():
    asking = [
        (path.name, text)
        for path in sorted(PACKAGE.rglob("*.py"))
        if "reset" in (code := path.read_text(encoding="utf-8"))
        for text in texts(ast.parse(code))
        if ASKS.search(text)
    ]
    assert len(asking) >= 8
    named = ("hdbridge reset", "hdbridge ctl reset", "{RESET}")
    assert [each for each in asking if not any(name in each[1] for name in named)] == []
