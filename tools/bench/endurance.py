"""Endurance run of the daemon: growth of its processes, and an account of every missed cycle.

    python tools/bench/endurance.py stepped [--hours 24] [--every MINUTES] [--json FILE]
    python tools/bench/endurance.py real [--minutes 30] [--every SECONDS] [--json FILE]

``stepped`` (`stepped_day.py`): control loop, simulated drive and service in one thread on virtual time, as
fast as the processor runs. ``real``: `hdbridge run --simulate` as it is, its processes, its flight recorder,
with four clients that poll, five that watch, a live page, and one that moves (the story of `clients.py`).

A figure grows when its median over the last quarter of the run is above that over the second quarter by more
than is allowed. The first quarter is for what fills up: rings, queues of bounded length, caches.

Exit status 1 where something grows, or a cycle is missing without a word.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from accounts import Accounts
from rundaemon import CONTROL, KEEPER, SERVICE, Cost, running

RECORDER = "size_mb: 8, file_mb: 2, file_s: 60, kept_mb: 4, before_s: 10, after_s: 5"
"""Recorder settings with a small ring, which is full within minutes."""


@dataclass(frozen=True)
class Growth:
    """Growth of one figure over a run."""

    name: str
    first: float
    second: float
    """Median of the second quarter."""
    last: float
    """Median of the last quarter."""
    allowed: float

    @classmethod
    def of(cls, name: str, values: Sequence[float], allowed: float) -> Growth:
        """Computes the growth of at least four equidistant ``values``."""
        quarter = max(len(values) // 4, 1)
        second = statistics.median(values[quarter : 2 * quarter])
        return cls(name, values[0], second, statistics.median(values[-quarter:]), allowed)

    @property
    def grows(self) -> bool:
        """True if the run shows more growth than is allowed."""
        return self.last - self.second > self.allowed

    def __str__(self) -> str:
        verdict = "GROWS" if self.grows else "no growth"
        return (
            f"  {self.name:<34} {self.first:>10.0f} {self.second:>10.0f} {self.last:>10.0f} "
            f"{self.last - self.second:>+9.0f} (allowed {self.allowed:.0f}): {verdict}"
        )


HEAD = f"  {'':<34} {'first':>10} {'2nd quarter':>10} {'last quarter':>10}"


def real(minutes: float, every_s: float) -> tuple[list[Growth], dict[str, Any]]:
    """Runs the processes; returns their growth and the account of cycles."""
    rows: list[dict[str, Cost]] = []
    accounts = Accounts()
    with tempfile.TemporaryDirectory(prefix="endurance-") as text:
        folder = Path(text)
        with (
            running(folder, "--moving", "story", recorder=RECORDER) as (daemon, clients),
            daemon.memory() as memory,
        ):
            reader = memory.reader()
            pids = daemon.pids()
            clients.say("on")
            begin_s = time.monotonic()
            due_s = begin_s + every_s
            first_turns = memory.status.loop_count
            while (now_s := time.monotonic()) < begin_s + 60.0 * minutes:
                accounts.take(*reader.read())
                if now_s >= due_s:
                    due_s += every_s
                    rows.append({name: Cost.of(pid) for name, pid in pids.items()})
                    print(
                        f"{(now_s - begin_s) / 60.0:6.1f} min  "
                        + "  ".join(
                            f"{name} {cost.rss_kb} kB {cost.descriptors} fd"
                            for name, cost in rows[-1].items()
                        ),
                        flush=True,
                    )
                if daemon.pids() != pids:
                    raise SystemExit("a process was started again")
                time.sleep(1.0)
            wall_s = time.monotonic() - begin_s
            turns = memory.status.loop_count - first_turns
            state = json.loads(_state(daemon.socket))
            seen = clients.seen()
            recorded = sum(each.stat().st_size for each in folder.rglob("*.mcap"))
        events = list(daemon.told())
    growths = []
    for name in (KEEPER, CONTROL, SERVICE):
        growths.append(Growth.of(f"{name}: own memory, kB", [row[name].rss_kb for row in rows], 1024.0))
        growths.append(Growth.of(f"{name}: descriptors", [row[name].descriptors for row in rows], 2.0))
        growths.append(Growth.of(f"{name}: threads", [row[name].threads for row in rows], 2.0))
    problems = {}
    for event in events:
        if event.get("level") in ("warning", "error", "critical"):
            key = f"{event['event']}: {event.get('text', event.get('why', ''))}"
            problems[key] = problems.get(key, 0) + 1
    cpu = {
        name: (rows[-1][name].cpu_s - rows[0][name].cpu_s) / ((len(rows) - 1) * every_s) for name in rows[0]
    }
    found = {
        "minutes": wall_s / 60.0,
        "turns": turns,
        "of real time": turns * memory_period(state) / wall_s,
        "cpu share": cpu,
        "accounts": accounts.report(),
        "recorder": state["recorder"],
        "recorded bytes": recorded,
        "clients": seen,
        "problems in the log": problems,
        "rows": [{name: vars(cost) for name, cost in row.items()} for row in rows],
    }
    return growths, found


def _state(socket: Path) -> str:
    from hdbridge.client import Client  # noqa: PLC0415

    with Client(str(socket), timeout_s=60.0) as client:
        return client.state().model_dump_json()


def memory_period(state: dict[str, Any]) -> float:
    """Turn time, s."""
    return float(state["cycle"]["period_s"])


def stepped(options: argparse.Namespace) -> tuple[list[Growth], dict[str, Any]]:
    """Runs hours of axis time; returns growth and the account of cycles."""
    from stepped_day import run  # noqa: PLC0415 - needs the tests' support

    def say(row: dict[str, float]) -> None:
        print("  ".join(f"{name} {value:.10g}" for name, value in row.items()), flush=True)

    found = run(options.hours, 60.0 * options.every, options.seed, say, 60.0 * options.at_most)
    rows = found["rows"]
    allowed = {"rss_kb": 4096.0, "blocks": 5000.0, "objects": 2000.0, "descriptors": 2.0}
    return [Growth.of(name, [row[name] for row in rows], most) for name, most in allowed.items()], found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    kinds = parser.add_subparsers(dest="kind", required=True)
    axis_time = kinds.add_parser("stepped")
    axis_time.add_argument("--hours", type=float, default=24.0, help="of axis time")
    axis_time.add_argument("--every", type=float, default=15.0, help="minutes of axis time between two looks")
    axis_time.add_argument("--seed", type=int, default=1)
    axis_time.add_argument("--at-most", type=float, default=math.inf, help="minutes by the clock")
    processes = kinds.add_parser("real")
    processes.add_argument("--minutes", type=float, default=30.0)
    processes.add_argument("--every", type=float, default=20.0, help="seconds between two looks")
    options = parser.parse_args()
    if options.kind == "real":
        growths, found = real(options.minutes, options.every)
        balanced = found["accounts"]["balanced"]
    else:
        growths, found = stepped(options)
        balanced = found["accounts"]["balanced"] and found["skipped"] == found["skipped told in events"]
    print("\n".join([HEAD, *map(str, growths)]))
    print(json.dumps({name: value for name, value in found.items() if name != "rows"}, indent=2))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return int(not balanced or any(each.grows for each in growths))


if __name__ == "__main__":
    sys.exit(main())
