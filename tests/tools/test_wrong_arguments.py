"""Tools refuse arguments that they cannot use with a line that states what they expect."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("bench/adaptation.py", "--minutes", "1"), "expected 8 or more"),
        (("bench/adaptation.py", "--faulty-minutes", "nan"), "expected 8 or more"),
        (("real_records.py",), "HDBRIDGE_REAL_RECORDS"),
        (("real_records.py", "joints"), "expected nothing, or 'twins'"),
    ],
)
def test_a_tool_states_what_it_expects(arguments: tuple[str, ...], expected: str) -> None:
    tool, *others = arguments
    without = {name: value for name, value in os.environ.items() if name != "HDBRIDGE_REAL_RECORDS"}
    done = subprocess.run(
        [sys.executable, TOOLS / tool, *others], env=without, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
