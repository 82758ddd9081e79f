"""Commands that start quickly do not load fit and diagnosis; the overview has the commands' own summaries."""

import inspect
import os
import re
import subprocess
import sys

import pytest

from hdbridge.cli import PANELS, load

ASK = """
import sys
from hdbridge.cli import main
sys.argv = ["hdbridge", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    status = end.code or 0
print("scipy" in sys.modules, status)
"""


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (("--help",), 0),
        (("model", "log", "article"), 0),
        (("scan", "--interface", "socketcan"), 2),
        (("check", "article"), 0),
    ],
)
def test_scipy_is_not_loaded_unless_something_is_fitted(arguments, status, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", ASK, *arguments], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert done.stdout.splitlines()[-1] == f"False {status}"


def test_the_overview_has_the_summary_of_every_command():
    asked = [sys.executable, "-m", "hdbridge", "--help"]
    wide = {**os.environ, "COLUMNS": "250"}
    shown = subprocess.run(asked, capture_output=True, text=True, check=True, env=wide).stdout
    for name in (name for panel in PANELS.values() for name in panel):
        loaded = load(name)
        said = [each.callback.__doc__ for each in loaded.registered_commands]
        said += [each.typer_instance.info.help for each in loaded.registered_groups]
        (words,) = said
        summary = " ".join(inspect.cleandoc(words).split("\n\n")[0].split())
        assert re.search(rf" {name} +{re.escape(summary)} ", shown), name


def test_help_loads_no_numeric_or_bus_modules_and_a_daemon_no_scipy():
    """Help imports all commands, but not the modules that they use when run."""
    program = (
        "import sys\nfrom hdbridge.cli import PANELS, load\n"
        "for panel in PANELS.values():\n    for name in panel:\n        load(name)\n"
        "heavy = {'numpy', 'scipy', 'pydantic', 'can', 'canopen', 'ruckig', 'jinja2'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
        "from hdbridge.daemon import keeper, serve\nfrom hdbridge.daemon.gateway import process\n"
        "from hdbridge.daemon.loop import process\nprint('scipy' in sys.modules)"
    )
    asked = [sys.executable, "-c", program]
    done = subprocess.run(asked, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\nFalse\n"
