"""The examples of docs/daemon-api.md run against a served machine."""

import re
from pathlib import Path

import pytest

from hdbridge.client.messages import ControlState

PAGE = Path(__file__).resolve().parents[2] / "docs" / "daemon-api.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_documented_example_runs(number, api, monkeypatch, capsys):
    api.bridge.__init__("arm", "base")
    api.bridge.axes["arm"].at = ControlState.ENABLED
    monkeypatch.setenv("HDBRIDGE_SOCKET", str(api.socket))
    exec(compile(EXAMPLES[number], f"{PAGE.name}, example {number + 1}", "exec"), {"__name__": "__main__"})
    assert not api.bridge.state().lease.held
    output = capsys.readouterr().out
    assert bool(output) == ("print(" in EXAMPLES[number])


def test_the_page_has_examples():
    assert len(EXAMPLES) >= 4
