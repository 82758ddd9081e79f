"""The page on bring-up names every check, and no other."""

import re
from pathlib import Path

from hdbridge.commissioning.bringup.doctor import CHECKS

PAGE = Path(__file__).parents[2] / "docs" / "bring-up.md"


def test_documented_checks_match_the_code() -> None:
    table = PAGE.read_text().split("| check |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == [check.name for check in CHECKS]
    assert len(CHECKS) == 18, "the page says eighteen"
