"""Writes docs/reliability.md: results of every fault of the suite, wherever it is tried, as tables.

python tools/reliability_page.py            try them (minutes; vcan by tools/socketcan.sh), write the page
python tools/reliability_page.py --check    only report if the page has the suite's rows
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

from tests.support.characters import CHARACTERS, FRIENDLY, Character, every_character  # noqa: E402
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
HEAD = """# Faults that an axis in motion survives

Made by `python tools/reliability_page.py` from `tests/support/reliability.py`. The axis moves at constant
speed, real frames make the fault, and the reaction has to come within the cycles that are allowed. After each
quick stop and each latch the motor stands, another program's first SYNC changes nothing, and the drive never
enters *operation enabled* without a request. The places:

* *bench*: the control cycle of a bench, on the virtual bus (4 ms) and on a Linux CAN stack (vcan, 20 ms,
  master and drive in threads of their own);
* *daemon*: the daemon's control loop with two axes in motion, on the virtual bus. After each row the other
  axis has continued (or has stopped, if the fault concerns the whole bus), no further set-point was sent to
  the one that stopped, and every command but a reset was refused. The reset by the service led to disabled,
  with the axis where it stood; enabled by command it moved again.

Each row is tried on {drives} drives that all keep to CiA 402 ([truth file](truth-file.md#firmware)):

{characters}

A cell has the cycles from the fault to the reaction on these {drives}, in this order; a dash if the place or
the drive cannot show the fault. `make test` tries them all on the virtual bus. `make test-slow` tries each
row on all {combinations} combinations of these choices.

[timing-and-faults.md](timing-and-faults.md) says what the reactions are.

| fault | expected | within | bench | bench, vcan | daemon |
|---|---|---|---|---|---|
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
    """Returns the required first three columns of each row."""
    further = [f"| {each.name} | {each.expected} | {each.allowed:g} |" for each in FURTHER]
    processes = [f"| {each.name} | {each.expected} | {each.within} |" for each in DAEMON_ROWS]
    return [*(f"| {row.name} | {_expected(row)} | {_within(row)} |" for row in ROWS), *further, *processes]


def rows_of_page(text: str) -> list[str]:
    """Returns the first three columns of each row of a page."""
    lines = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| fault |")]
    return ["|".join(line.split("|")[:4]) + "|" for line in lines]


def page(seen: list[Seen]) -> str:
    """Returns the page of the results; SystemExit if a row was not tried or failed."""
    found = {(each.name, each.place, each.character): each for each in seen}

    def seen_of(name: str, place: str, character: str = FRIENDLY.name) -> Seen:
        if (name, place, character) not in found:
            raise SystemExit(f"'{name}' was not tried on {place}, {character}: look at the tests")
        return found[name, place, character]

    def cell(row: Row, place: str) -> str:
        if place not in row.places:
            return "–"
        return " ".join(
            "–" if row.unseen_on(each) else f"{seen_of(row.name, place, each.name).taken:g}"
            for each in CHARACTERS
        )

    lines = []
    for row in ROWS:
        cells = " | ".join(cell(row, place) for place in (VIRTUAL, VCAN, DAEMON))
        lines.append(f"| {row.name} | {_expected(row)} | {_within(row)} | {cells} |")
    characters = "\n".join(f"* *{each}*: {_behaviour(each)};" for each in CHARACTERS)
    head = HEAD.format(
        drives=len(CHARACTERS), characters=f"{characters[:-1]}.", combinations=len(every_character())
    )
    text = head + "\n".join(lines) + "\n"
    text += FURTHER_HEAD + "".join(_further(each, seen_of(each.name, DAEMON)) for each in FURTHER)
    return (
        text + DAEMON_VCAN_HEAD + "".join(_whole(row, seen_of(row.name, DAEMON_VCAN)) for row in DAEMON_ROWS)
    )


def _further(row: Further, seen: Seen) -> str:
    return f"| {row.name} | {row.expected} | {row.allowed:g} | {seen.taken:g} |\n"


def _whole(row: DaemonRow, seen: Seen) -> str:
    return f"| {row.name} | {row.expected} | {row.within} | {seen.seen} | {seen.taken:g} |\n"


def _behaviour(character: Character) -> str:
    """Returns the keys of the truth file in which a drive differs from the default."""
    keys = character.behaviour.model_dump(mode="json", exclude_defaults=True)
    chosen = [f"`{name}: {str(value).lower()}`" for name, value in keys.items()]
    return ", ".join([*chosen, f"605Ah = {character.quick_stop_option}"])


def _expected(row: Row) -> str:
    return f"{WORDS[row.reaction]}: {row.fault.value}"


def _within(row: Row) -> str:
    return str(row.allowed) if isinstance(row.allowed, int) else f"two {row.allowed}"


def try_all() -> list[Seen]:
    """Runs the suite at every place."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "record.jsonl"
        environment = {**os.environ, RECORD: str(record)}
        pytest = [sys.executable, "-m", "pytest", "-q"]
        for command in (
            [*pytest, "-m", "not slow", "tests/cycle/test_reliability.py", *map(str, DAEMON_TESTS)],
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
        if rows_of_page(PAGE.read_text(encoding="utf-8")) != rows():
            raise SystemExit(
                "docs/reliability.md lags behind the fault suite: python tools/reliability_page.py"
            )
        return
    PAGE.write_text(page(try_all()), encoding="utf-8")


if __name__ == "__main__":
    main()
