"""Example files of docs/ci.md."""

import shutil
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "ci.md"
EXAMPLE = PAGE.parent / "ci-example"
WORKFLOW = EXAMPLE / "motion.yml"


def write(folder: Path) -> Path:
    """Copies all example files into a folder."""
    return shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
