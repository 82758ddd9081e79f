"""docs/reliability.md has the rows of the fault suite."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_has_the_rows_of_the_suite():
    done = subprocess.run(
        [sys.executable, ROOT / "tools" / "reliability_page.py", "--check"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
