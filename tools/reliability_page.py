"""Write docs/reliability.md: what came of every fault of the suite, on both buses, as a table.

python tools/reliability_page.py            try them (minutes; vcan by tools/socketcan.sh), write the page
python tools/reliability_page.py --check    only say whether the page has the suite's rows
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.reliability import RECORD, ROWS, VCAN, VIRTUAL, WORDS, Row, Seen, read_record  # noqa: E402

PAGE = ROOT / "docs" / "reliability.md"
HEAD = """# What faults an axis under way survives

Made by `python tools/reliability_page.py` from `tests/support/reliability.py`. The axis moves at constant
speed, the fault is made by real frames, and the reaction has to come within the cycles that are allowed.
After each quick stop and each latch the motor stands. The rows are tested with every change, on the virtual
bus (4 ms) and on a Linux CAN stack (vcan, 20 ms, master and drive in threads of their own; a dash where vcan
cannot show the fault). [timing-and-faults.md](timing-and-faults.md) says what the reactions are. Cycles are
counted from the fault to the reaction, the one that notices it included.

| fault | expected | within | seen | cycles, virtual | cycles, vcan |
|---|---|---|---|---|---|
"""


def rows() -> list[str]:
    """The first three columns of each row, as the page has to have them."""
    return [f"| {row.name} | {_expected(row)} | {_within(row)} |" for row in ROWS]


def rows_of_page(text: str) -> list[str]:
    """The same of a page."""
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    return ["|".join(line.split("|")[:4]) + "|" for line in lines]


def page(seen: list[Seen]) -> str:
    """The page of what was seen; SystemExit where a row was not tried or failed."""
    found = {(each.name, each.bus): each for each in seen}
    lines = []
    for row, begun in zip(ROWS, rows(), strict=True):
        here = {bus: found.get((row.name, bus)) for bus in row.buses}
        missing = [bus for bus, each in here.items() if each is None]
        if missing:
            raise SystemExit(f"'{row.name}' was not tried on {', '.join(missing)}: look at the tests")
        words = " / ".join(dict.fromkeys(each.seen for each in here.values() if each))
        cells = [str(each.cycles) if (each := here.get(bus)) else "–" for bus in (VIRTUAL, VCAN)]
        lines.append(f"{begun} {words} | {cells[0]} | {cells[1]} |")
    return HEAD + "\n".join(lines) + "\n"


def _expected(row: Row) -> str:
    return f"{WORDS[row.reaction]}: {row.fault.value}"


def _within(row: Row) -> str:
    return str(row.allowed) if isinstance(row.allowed, int) else f"two {row.allowed}"


def try_all() -> list[Seen]:
    """Run the suite on both buses."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "record.jsonl"
        environment = {**os.environ, RECORD: str(record)}
        pytest = [sys.executable, "-m", "pytest", "-q"]
        for command in (
            [*pytest, "tests/cycle/test_reliability.py"],
            ["tools/socketcan.sh", *pytest, "tests/socketcan/test_reliability.py"],
        ):
            if status := subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode:
                raise SystemExit(status)
        return read_record(record)


def main() -> None:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    if parser.parse_args().check:
        if rows_of_page(PAGE.read_text(encoding="utf-8")) != rows():
            raise SystemExit(
                "docs/reliability.md lags behind the fault suite: python tools/reliability_page.py"
            )
        return
    PAGE.write_text(page(try_all()), encoding="utf-8")


if __name__ == "__main__":
    main()
