"""Writes the tables of docs/reliability.md: the results of every fault of the suite at every place.

python tools/reliability_page.py            run all (minutes; vcan by tools/socketcan.sh), write the page
python tools/reliability_page.py --check    only check that the page has the rows of the suite
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from support.characters import CHARACTERS, FRIENDLY, Character  # noqa: E402
from support.daemon_bench import DaemonRow  # noqa: E402
from support.daemon_faults import DAEMON_ROWS  # noqa: E402
from support.reliability import (  # noqa: E402
    DAEMON,
    DAEMON_VCAN,
    FURTHER,
    RECORD,
    ROWS,
    VCAN,
    VIRTUAL,
    WORDS,
    Further,
    Row,
    Seen,
    read_record,
)

PAGE = ROOT / "docs" / "reliability.md"
DAEMON_TESTS = sorted(Path("tests/daemon/loop").glob("test_reliability*.py"))
SOCKETCAN_TESTS = ("tests/socketcan/test_reliability.py", "tests/socketcan/test_daemon.py")
_BLOCK = re.compile(r"(<!-- tried: (?P<name>[a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
_BETWEEN = "; "
PLACES = {VIRTUAL: "bench", VCAN: "vcan", DAEMON: "daemon"}
"""Names of the suite's places on the page, in the order of the page."""


class Result(NamedTuple):
    """Row of the suite with the required reaction, the allowed and the measured number of cycles."""

    fault: str
    expected: str
    within: str
    cycles: str


def rows() -> list[tuple[str, str, str]]:
    """Returns fault, required reaction and allowed cycles of each row of the suite."""
    return [
        *((row.name, _expected(row), _within(row)) for row in ROWS),
        *((each.name, each.expected, f"{each.allowed:g}") for each in FURTHER),
        *((each.name, each.expected, str(each.within)) for each in DAEMON_ROWS),
    ]


def rows_of_page(text: str) -> list[tuple[str, str, str]]:
    """Returns fault, required reaction and allowed cycles of each result on a page."""
    tables = "".join(match[0] for match in _BLOCK.finditer(text))
    found = re.findall(r"^- \*(.+?)\* \(.+/(.+?)\): (.+)$", tables, re.MULTILINE)
    return [
        (fault, expected, within) for expected, within, faults in found for fault in faults.split(_BETWEEN)
    ]


def table(results: Iterable[Result]) -> str:
    """Returns results as a list; faults with the same reaction, limit and result share a line."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for each in results:
        groups.setdefault((each.expected, each.within, each.cycles), []).append(each.fault)
    return "".join(
        f"- *{expected}* ({cycles}/{within}): {_BETWEEN.join(faults)}\n"
        for (expected, within, cycles), faults in groups.items()
    )


def page(seen: list[Seen]) -> str:
    """Returns the page with new results; SystemExit if a row was not tried or failed."""
    found = {(each.name, each.place, each.character): each for each in seen}

    def seen_of(name: str, place: str, character: str = FRIENDLY.name) -> Seen:
        if (name, place, character) not in found:
            raise SystemExit(f"'{name}' was not tried on {place}, {character}: look at the tests")
        return found[name, place, character]

    def cell(row: Row, place: str) -> str:
        if place not in row.places:
            return "–"
        taken = [
            "–" if row.unseen_on(each) else f"{seen_of(row.name, place, each.name).taken:g}"
            for each in CHARACTERS
        ]
        return taken[0] if len({*taken}) == 1 else " ".join(taken)

    results = []
    for row in ROWS:
        cells = {name: cell(row, place) for place, name in PLACES.items()}
        results.append(Result(row.name, _expected(row), _within(row), together(cells)))
    blocks = {
        "drives": "".join(f"* *{each}*: {_behaviour(each)}\n" for each in CHARACTERS),
        "axis": table(results),
        "daemon": table(_further(each, seen_of(each.name, DAEMON)) for each in FURTHER),
        "processes": table(_whole(row, seen_of(row.name, DAEMON_VCAN)) for row in DAEMON_ROWS),
    }
    return _BLOCK.sub(
        lambda match: match[1] + blocks[match["name"]] + match[3], PAGE.read_text(encoding="utf-8")
    )


def together(cells: dict[str, str]) -> str:
    """Joins the results of a row at all places; a single result if they agree."""
    if len({*cells.values()}) == 1:
        return next(iter(cells.values()))
    return ", ".join(f"{place} {taken}" for place, taken in cells.items() if taken != "–")


def _further(row: Further, seen: Seen) -> Result:
    return Result(row.name, row.expected, f"{row.allowed:g}", f"{seen.taken:g}")


def _whole(row: DaemonRow, seen: Seen) -> Result:
    return Result(row.name, row.expected, str(row.within), f"{seen.taken:g}")


def _behaviour(character: Character) -> str:
    """Returns the keys of the truth file that differ from the default for a drive of this character."""
    keys = character.behaviour.model_dump(mode="json", exclude_defaults=True)
    chosen = [f"`{name}: {str(value).lower()}`" for name, value in keys.items()]
    return ", ".join([*chosen, f"605Ah = {character.quick_stop_option}"])


def _expected(row: Row) -> str:
    return WORDS[row.reaction]


def _within(row: Row) -> str:
    return str(row.allowed) if isinstance(row.allowed, int) else f"two {row.allowed}"


def try_all() -> list[Seen]:
    """Runs the suite at every place."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "record.jsonl"
        environment = {**os.environ, RECORD: str(record)}
        pytest = [sys.executable, "-m", "pytest", "-q"]
        for command in (
            [*pytest, "-k", "not on_every_drive", "tests/cycle/test_reliability.py", *map(str, DAEMON_TESTS)],
            ["tools/socketcan.sh", "--slowed", "50", *pytest, *map(str, SOCKETCAN_TESTS)],
        ):
            if status := subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode:
                raise SystemExit(status)
        return read_record(record)


def main() -> None:
    """Writes or checks the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    if parser.parse_args().check:
        if sorted(rows_of_page(PAGE.read_text(encoding="utf-8"))) != sorted(rows()):
            raise SystemExit(
                "docs/reliability.md lags behind the fault suite: python tools/reliability_page.py"
            )
        return
    PAGE.write_text(page(try_all()), encoding="utf-8")


if __name__ == "__main__":
    main()
