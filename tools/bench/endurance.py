"""Endurance run of the daemon: growth of its processes, cost of its clients, accounting of missed cycles.

    python tools/bench/endurance.py [--minutes 30]

Runs `hdbridge run --simulate` with all its processes and the recorder; first without clients, then with four
that poll, five that read live samples, a live page, and one that moves (the story of `clients.py`).

A figure grows if its median over the last quarter of the run exceeds that over the second quarter by more
than the allowed growth. During the first quarter, rings, bounded queues and caches fill up.

Exit status 1 if a figure grows, or if a cycle is missing without a report.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness import PROFILE, parser
from support.running import Daemon, running

from hdbridge.client import Client
from hdbridge.daemon.memory import Cell, Memory

CONTROL = "control"
EVERY_S, IDLE_S = 20.0, 60.0
"""Time between two looks, and time without clients, s."""
MACHINE = """schema: hdbridge.machine/1
name: endurance
axes: [{profile: article}]
recorder: {size_mb: 8, file_mb: 2, file_s: 60, kept_mb: 4, before_s: 10, after_s: 5}
"""
"""Machine file with a small recorder ring, which fills up within minutes."""
ALLOWED = {"rss_kb": 1024.0, "descriptors": 2.0, "threads": 2.0}
"""Allowed growth of each figure of a process."""


@dataclass(frozen=True)
class Cost:
    """Resource use of a process, as reported by the kernel."""

    cpu_s: float
    rss_kb: int
    """Private resident memory, without files and shared pages."""
    descriptors: int
    threads: int

    @classmethod
    def of(cls, pid: int) -> Cost:
        """Reads the resource use of a process; raises OSError if the process has ended."""
        proc = Path(f"/proc/{pid}")
        lines = (proc / "status").read_text(encoding="ascii").splitlines()
        fields = dict(line.split(":", 1) for line in lines)
        run_ns = (int((task / "schedstat").read_text().split()[0]) for task in (proc / "task").iterdir())
        return cls(
            sum(run_ns) / 1e9,
            int(fields["RssAnon"].split()[0]),
            len(list((proc / "fd").iterdir())),
            int(fields["Threads"]),
        )


@dataclass(frozen=True)
class Growth:
    """Growth of one figure over a run: first value, medians of the second and of the last quarter."""

    name: str
    first: float
    second: float
    last: float
    allowed: float

    @classmethod
    def of(cls, name: str, values: Sequence[float], allowed: float) -> Growth:
        """Computes the growth from at least four equidistant ``values``."""
        quarter = max(len(values) // 4, 1)
        second = statistics.median(values[quarter : 2 * quarter])
        return cls(name, values[0], second, statistics.median(values[-quarter:]), allowed)

    @property
    def grows(self) -> bool:
        """True if the figure grows by more than is allowed."""
        return self.last - self.second > self.allowed

    def __str__(self) -> str:
        verdict = "GROWS" if self.grows else "no growth"
        return (
            f"  {self.name:<34} {self.first:>10.0f} {self.second:>12.0f} {self.last:>13.0f} "
            f"{self.last - self.second:>+9.0f} (allowed {self.allowed:.0f}): {verdict}"
        )


class Accounts:
    """Account of all cycles: each has a sample, was reported as skipped, or was lost by this reader."""

    def __init__(self) -> None:
        self.samples = self.lost = self.missing = self.skipped = 0
        self._last: tuple[int, int] | None = None

    def take(self, samples: Any, lost: int) -> None:
        """Counts the samples of one read."""
        self.lost += lost
        self.samples += len(samples)
        for cycle, skipped in zip(samples["cycle"].tolist(), samples["skipped"].tolist(), strict=True):
            if self._last is not None:
                self.missing += cycle - self._last[0] - 1
                self.skipped += skipped - self._last[1]
            self._last = cycle, skipped

    def report(self) -> dict[str, int | bool]:
        """Returns the JSON object."""
        counts = {name: value for name, value in vars(self).items() if name != "_last"}
        return {**counts, "balanced": self.missing == self.skipped + self.lost}


@contextmanager
def memory_of(daemon: Daemon) -> Iterator[Memory]:
    """Opens the keeper's shared memory for reading, as the service does."""
    fds = Path(f"/proc/{daemon.process.pid}/fd")
    found = next(each for each in fds.iterdir() if str(each.readlink()).startswith("/memfd:hdbridge "))
    with Memory.attach(os.open(found, os.O_RDWR)) as memory:  # `Memory` closes it
        yield memory


def pids_of(daemon: Daemon) -> dict[str, int]:
    """Returns the process id of each of the daemon's processes, by name."""
    return {"keeper": daemon.process.pid, **{name: daemon.pids(name)[-1] for name in (CONTROL, "service")}}


@contextmanager
def clients(socket: Path) -> Iterator[Callable[[], dict[str, Any]]]:
    """Runs the process of `clients.py`; yields a function that ends it and returns its results."""
    program = Path(__file__).with_name("clients.py")
    process = subprocess.Popen(
        [sys.executable, str(program), str(socket)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None

    def seen() -> dict[str, Any]:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        return dict(json.loads(process.stdout.readline()))

    try:
        yield seen
    finally:
        process.kill()
        process.wait()


def turn_us(memory: Memory, pid: int, work: Callable[[], object]) -> float:
    """Returns the CPU time of the control process per cycle while ``work`` runs, us."""
    before, turns = Cost.of(pid), memory.status[Cell.LOOP_COUNT]
    work()
    return 1e6 * (Cost.of(pid).cpu_s - before.cpu_s) / (memory.status[Cell.LOOP_COUNT] - turns)


def run(minutes: float) -> tuple[list[Growth], dict[str, Any]]:
    """Runs the processes; returns their growth and the account of cycles."""
    rows: list[dict[str, Cost]] = []
    accounts = Accounts()
    with tempfile.TemporaryDirectory(prefix="endurance-") as text, ExitStack() as stack:
        folder = Path(text)
        shutil.copytree(PROFILE, folder / "article")
        (folder / "machine.yaml").write_text(MACHINE, encoding="utf-8")
        daemon = stack.enter_context(running(folder, "machine.yaml", "--simulate", name="endurance"))
        daemon.until_axis("disabled")
        memory = stack.enter_context(memory_of(daemon))
        pids, reader = pids_of(daemon), memory.reader()

        def watch() -> None:
            begin_s = due_s = time.monotonic()
            while (now_s := time.monotonic()) < begin_s + 60.0 * minutes:
                accounts.take(*reader.read())
                if now_s >= due_s:
                    due_s += EVERY_S
                    rows.append({name: Cost.of(pid) for name, pid in pids.items()})
                    memories = (f"{name} {cost.rss_kb} kB" for name, cost in rows[-1].items())
                    print(f"{(now_s - begin_s) / 60.0:6.1f} min ", *memories, flush=True)
                if pids_of(daemon) != pids:
                    raise SystemExit(f"a process was started again: {daemon.events[-20:]}")
                time.sleep(1.0)

        idle_us = turn_us(memory, pids[CONTROL], lambda: time.sleep(IDLE_S))
        accounts.take(*reader.read())
        seen = stack.enter_context(clients(daemon.socket))
        first_turn, begin_s = memory.status[Cell.LOOP_COUNT], time.monotonic()
        busy_us = turn_us(memory, pids[CONTROL], watch)
        turns, wall_s = memory.status[Cell.LOOP_COUNT] - first_turn, time.monotonic() - begin_s
        with Client(str(daemon.socket), timeout_s=60.0) as client:
            state = client.state()
        found = {
            "minutes": wall_s / 60.0,
            "turns": turns,
            "of real time": turns * state.cycle.period_s / wall_s,
            "turn without clients, us": idle_us,
            "turn with clients, us": busy_us,
            "accounts": accounts.report(),
            "recorder": state.recorder.model_dump(mode="json"),
            "recorded bytes": sum(each.stat().st_size for each in folder.rglob("*.mcap")),
            "clients": seen(),
            "problems in the log": Counter(
                f"{event['event']}: {event.get('text', event.get('why', ''))}"
                for event in daemon.events
                if event.get("level") in ("warning", "error", "critical")
            ),
        }
    growths = [
        Growth.of(f"{name}: {figure}", [getattr(row[name], figure) for row in rows], allowed)
        for name in pids
        for figure, allowed in ALLOWED.items()
    ]
    return growths, found


def main() -> int:
    given = parser(__doc__)
    given.add_argument("--minutes", type=float, default=30.0)
    growths, found = run(given.parse_args().minutes)
    print(f"  {'':<34} {'first':>10} {'2nd quarter':>12} {'last quarter':>13}")
    print(*growths, sep="\n")
    print(json.dumps(found, indent=2))
    return int(not found["accounts"]["balanced"] or any(each.grows for each in growths))


if __name__ == "__main__":
    sys.exit(main())
