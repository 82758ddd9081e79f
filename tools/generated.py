"""Harness of the tools that generate pages from the code; with `--check` they only compare."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def main(made: Mapping[Path, str]) -> int:
    """Writes each file; with `--check` lists those that are not up to date. Returns the exit status."""
    behind = [
        path for path, text in made.items() if not path.exists() or path.read_text(encoding="utf-8") != text
    ]
    if "--check" not in sys.argv[1:]:
        for path in behind:
            path.write_text(made[path], encoding="utf-8")
        return 0
    for path in behind:
        print(f"{path.relative_to(ROOT)}: not up to date; run python tools/{Path(sys.argv[0]).name}")
    return int(bool(behind))
