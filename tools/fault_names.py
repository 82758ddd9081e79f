"""Writes the list of faults in docs/ci.md from the table of `hdbridge.testing`.

python tools/fault_names.py
"""

from __future__ import annotations

import re
from pathlib import Path

from hdbridge.testing.faulttable import sentences

PAGE = Path(__file__).resolve().parents[1] / "docs" / "ci.md"
_BLOCK = re.compile(r"(<!-- faults: .*? -->\n).*?(<!-- end -->)", re.DOTALL)


def table() -> str:
    """Returns the rows."""
    rows = [f"- `{name}({arguments})`: {what}" for name, arguments, what in sentences()]
    return "\n".join(rows) + "\n"


def page() -> str:
    """Returns the up-to-date page."""
    return _BLOCK.sub(
        lambda found: f"{found[1]}\n{table()}\n{found[2]}", PAGE.read_text(encoding="utf-8"), count=1
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
