"""Commands in messages work as printed, also for a folder whose name has a space and an umlaut."""

import re
import shlex
from pathlib import Path

import pytest

NAME = "Prüfstand 1/arm"
PLAN = """
schema: hdbridge.plan/1
name: short
reference_s: 0.5
procedures:
  - {procedure: standstill, duration_s: 1}
validation: {count: 2, cycles: 0}
"""


def commands_in(text):
    """The words of each command in a text; a command ends at ', ' or '; ' or the end of the line."""
    return [shlex.split(each) for each in re.findall(r"hdbridge ([a-z]+ (?:'[^']*'|[^';,\n(])*)", text)]


@pytest.fixture
def at_bench(hdbridge, tmp_path):
    made = hdbridge("new", NAME)
    assert commands_in(made.stdout) == [["check", NAME]]
    (tmp_path / "short.yaml").write_text(PLAN)
    (tmp_path / NAME / "model.yaml").unlink(missing_ok=True)
    return hdbridge


def test_the_next_commands_of_a_measurement(at_bench, tmp_path, monkeypatch):
    shown = at_bench("measure", NAME, "--simulate", "--plan", "short.yaml", "--out", "Messung 1")
    assert commands_in(shown.stdout) == [["twin", NAME, "Messung 1"]]


@pytest.mark.parametrize(
    ("arguments", "advice"),
    [
        (("improve", NAME, "--simulate"), [["calibrate", NAME], ["model", "commit", NAME]]),
        (("step", NAME, "--simulate"), [["calibrate", NAME], ["model", "commit", NAME]]),
        (("diagnose", "a b.csv"), [["fit", "a b.csv", "--ratio", "N", "--out", "model.yaml"]]),
        (
            ("diagnose", "a b.csv", "--model", NAME),
            [
                ["calibrate", NAME],
                ["model", "commit", NAME],
                ["fit", "RECORD", "--axis", NAME, "--out", "model.yaml"],
            ],
        ),
    ],
)
def test_the_advice_of_an_error(at_bench, arguments, advice):
    refused = at_bench(*arguments, status=2)
    assert commands_in(refused.stderr) == advice


def test_no_message_joins_a_command_itself():
    """Every command with a path is made by `errors.command`, which quotes it."""
    joined = re.compile(r"hdbridge (?!ctl|gateway of)[a-z-]+ (?:[A-Za-z-]+ )*\{(?!command)")
    sources = Path(__file__).parents[2].glob("hdbridge/**/*.py")
    assert [str(path) for path in sources if joined.search(path.read_text())] == []
