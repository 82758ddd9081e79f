"""Write docs/reliability.md: what came of every fault of the suite, wherever it is tried, as tables.

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

from tests.support.daemon_bench import DaemonRow  # noqa: E402
from tests.support.daemon_faults import DAEMON_ROWS  # noqa: E402
from tests.support.reliability import (  # noqa: E402
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
HEAD = """# What faults an axis under way survives

Made by `python tools/reliability_page.py` from `tests/support/reliability.py`. The axis moves at constant
speed, the fault is made by real frames, and the reaction has to come within the cycles that are allowed.
After each quick stop and each latch the motor stands. The rows are tested with every change:

* *bench*: the control cycle of a bench, on the virtual bus (4 ms) and on a Linux CAN stack (vcan, 20 ms,
  master and drive in threads of their own; a dash where vcan cannot show the fault);
* *daemon*: the daemon's control loop with two axes in motion, on the virtual bus. After each row the other
  axis has gone on (or has stopped, where the whole bus is concerned), no further set-point was sent to the
  one that stopped, and every command but a reset was refused. The reset by the service led to disabled,
  where the axis stood; enabled by command it moved again.

[timing-and-faults.md](timing-and-faults.md) says what the reactions are. Cycles are counted from the fault to
the reaction, the one that notices it included.

| fault | expected | within | seen | bench | bench, vcan | daemon |
|---|---|---|---|---|---|---|
"""
FURTHER_HEAD = """
## What only the daemon shows

On the virtual bus, in cycles of 4 ms; 0 where nothing may happen.

| fault | expected | within | taken |
|---|---|---|---|
"""
DAEMON_VCAN_HEAD = """
## The whole daemon, in its processes

`hdbridge run` and `hdbridge simulate` as processes of their own at the two ends of a vxcan pair, in cycles of
20 ms. The axis moves when the fault is made. Afterwards a client resets it, where that is needed, enables it,
and it moves for the next row. Loss, delay, duplicates and the full queue are made by the kernel (tc netem).
Bus-off is the error frame that the driver of a controller sends for it: vxcan has no controller. The loop
notices a fault within a cycle or two; the rest of what is allowed is the time of the command that makes it.

| fault | expected | within | seen | cycles |
|---|---|---|---|---|
"""


def rows() -> list[str]:
    """The first three columns of each row, as the page has to have them."""
    further = [f"| {each.name} | {each.expected} | {each.allowed:g} |" for each in FURTHER]
    processes = [f"| {each.name} | {each.expected} | {each.within} |" for each in DAEMON_ROWS]
    return [*(f"| {row.name} | {_expected(row)} | {_within(row)} |" for row in ROWS), *further, *processes]


def rows_of_page(text: str) -> list[str]:
    """The same of a page."""
    lines = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| fault |")]
    return ["|".join(line.split("|")[:4]) + "|" for line in lines]


def page(seen: list[Seen]) -> str:
    """The page of what was seen; SystemExit where a row was not tried or failed."""
    found = {(each.name, each.place): each for each in seen}

    def seen_of(name: str, place: str) -> Seen:
        if (name, place) not in found:
            raise SystemExit(f"'{name}' was not tried on {place}: look at the tests")
        return found[name, place]

    lines = []
    for row in ROWS:
        here = {place: seen_of(row.name, place) for place in row.places}
        words = " / ".join(dict.fromkeys(each.seen for each in here.values()))
        cells = [f"{each.taken:g}" if (each := here.get(place)) else "–" for place in (VIRTUAL, VCAN, DAEMON)]
        lines.append(f"| {row.name} | {_expected(row)} | {_within(row)} | {words} | {' | '.join(cells)} |")
    text = HEAD + "\n".join(lines) + "\n"
    text += FURTHER_HEAD + "".join(_further(each, seen_of(each.name, DAEMON)) for each in FURTHER)
    return (
        text + DAEMON_VCAN_HEAD + "".join(_whole(row, seen_of(row.name, DAEMON_VCAN)) for row in DAEMON_ROWS)
    )


def _further(row: Further, seen: Seen) -> str:
    return f"| {row.name} | {row.expected} | {row.allowed:g} | {seen.taken:g} |\n"


def _whole(row: DaemonRow, seen: Seen) -> str:
    return f"| {row.name} | {row.expected} | {row.within} | {seen.seen} | {seen.taken:g} |\n"


def _expected(row: Row) -> str:
    return f"{WORDS[row.reaction]}: {row.fault.value}"


def _within(row: Row) -> str:
    return str(row.allowed) if isinstance(row.allowed, int) else f"two {row.allowed}"


def try_all() -> list[Seen]:
    """Run the suite everywhere."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "record.jsonl"
        environment = {**os.environ, RECORD: str(record)}
        pytest = [sys.executable, "-m", "pytest", "-q"]
        for command in (
            [*pytest, "tests/cycle/test_reliability.py", *map(str, DAEMON_TESTS)],
            ["tools/socketcan.sh", "--slowed", "50", *pytest, *map(str, SOCKETCAN_TESTS)],
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
