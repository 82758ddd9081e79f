"""The reference of the files says what the code expects."""

import importlib.util
import re
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "file_reference.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("file_reference", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(tool):
    page = tool.PAGE.read_text(encoding="utf-8")
    assert tool.updated(page) == page, "run python tools/file_reference.py"


def test_every_table_is_on_the_page(tool):
    page = tool.PAGE.read_text(encoding="utf-8")
    assert set(re.findall(r"<!-- generated: ([a-z-]+) -->", page)) == set(tool.BLOCKS)


def test_every_key_has_a_meaning(tool):
    rows = [
        row
        for name in ("axis", "model", "recording", "history")
        for row in tool.BLOCKS[name]().splitlines()[2:]
    ]
    assert [row for row in rows if row.endswith("|  |")] == []
