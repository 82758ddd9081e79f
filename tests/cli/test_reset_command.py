"""`hdbridge reset`, and that every message which asks for a reset names the command."""

import ast
import json
import re
from pathlib import Path

import pytest

from hdbridge.errors import RESET
from hdbridge.testing import simulated_drive

PACKAGE = Path(__file__).parents[2] / "hdbridge"
ASKS = re.compile(r"\breset (it|its|the (fault|axis|drive)|that)\b")


@pytest.fixture
def faulty():
    """A drive in fault that this process reaches, and how to say so on the command line."""
    with simulated_drive("article", bus="virtual") as drive:
        drive.fault("drive_fault", code=0x3210)
        drive.sleep(0.5)
        yield drive, ("--interface", drive.interface, "--channel", drive.channel)


def test_a_fault_is_reset_by_the_command_that_the_refusal_names(hdbridge, faulty, tmp_path):
    drive, bus = faulty
    before_deg = drive.truth.load_deg
    refused = hdbridge("move", "article", 1, "--hold", 0, *bus)
    assert refused.returncode == 4
    assert "3210h" in refused.stderr
    assert RESET in refused.stderr
    done = hdbridge("reset", "article", *bus, "--json", "reset.json")
    assert done.returncode == 0, done.stderr
    assert "the fault is reset (error code 3210h, DC link over-voltage" in done.stdout
    assert json.loads((tmp_path / "reset.json").read_text())["state"] == "switch on disabled"
    assert drive.truth.load_deg == pytest.approx(before_deg, abs=1e-3)
    again = hdbridge("reset", "article", *bus)
    assert again.returncode == 0, again.stderr
    assert again.stdout == "there is no fault to reset: the drive is in 'switch on disabled'\n"


def test_without_a_fault_nothing_is_done(hdbridge):
    done = hdbridge("reset", "article", "--simulate")
    assert done.returncode == 0, done.stderr
    assert "there is no fault to reset" in done.stdout


def _texts(tree: ast.Module) -> list[str]:
    """Every text of a module but its docstrings; an inserted `RESET` counts as its value."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    } | {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    joined = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    parts = {id(part) for each in joined for part in each.values}
    found = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in docstrings | parts
    ]
    for each in joined:
        found.append(
            "".join(
                str(part.value) if isinstance(part, ast.Constant) else
                RESET if isinstance(part, ast.FormattedValue) and ast.unparse(part.value) == "RESET" else "{}"
                for part in each.values
            )
        )  # fmt: skip
    return found


def test_every_message_that_asks_for_a_reset_names_the_command():
    asking = [
        (path.name, text)
        for path in sorted(PACKAGE.rglob("*.py"))
        if "reset" in (code := path.read_text(encoding="utf-8"))
        for text in _texts(ast.parse(code))
        if ASKS.search(text)
    ]
    assert len(asking) >= 8
    assert [
        each for each in asking if "hdbridge reset" not in each[1] and "hdbridge ctl reset" not in each[1]
    ] == []
