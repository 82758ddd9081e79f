"""Example files of docs/ci.md."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "ci.md"
_FILE = re.compile(r"^\*\*`([^`]+)`\*\*[^\n]*\n\n```\w+\n(.*?)^```$", re.DOTALL | re.MULTILINE)
WORKFLOW = ".github/workflows/motion.yml"


def files() -> dict[str, str]:
    """Returns the text of each file by its path."""
    return dict(_FILE.findall(PAGE.read_text(encoding="utf-8")))


def write(folder: Path) -> Path:
    """Writes all files into a folder."""
    for name, text in files().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder
