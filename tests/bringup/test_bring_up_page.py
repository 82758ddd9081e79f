"""The page on bring-up names every check, and no other."""

import re
from pathlib import Path

from hdbridge.commissioning.bringup.doctor import CHECKS

PAGE = Path(__file__).parents[2] / "docs" / "bring-up.md"


def test_documented_checks_match_the_code() -> None:
    doctor = PAGE.read_text().split("## 5. The doctor")[1].split("\n## ")[0]
    assert re.findall(r"^- `(\w+)`: ", doctor, re.MULTILINE) == [check.name for check in CHECKS]
    assert len(CHECKS) == 18, "the page says eighteen"
