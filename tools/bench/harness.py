"""Harness of the benchmarks: command line, interleaved blocks, repetition of disturbed blocks."""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from hdbridge.errors import SafetyStop

ROOT = Path(__file__).resolve().parents[2]
PROFILE = ROOT / "profiles" / "article"
CHANNEL = "vcan0"
ATTEMPTS = 20
sys.path += [str(ROOT / "tests"), str(ROOT / "tools")]  # for the imports after that of this module


class Busy(Exception):  # noqa: N818 - what happened
    """Raised if this computer stalled during a block, so that an axis was stopped by a fault."""


class Waking:
    """Clock of this computer, which records the lateness of each wake-up and the busy time after it."""

    now = staticmethod(time.monotonic)

    def __init__(self) -> None:
        self._woke_s = self._late_s = 0.0
        self._left = 0
        self.late_s = self.busy_s = [0.0]

    def record(self, cycles: int, cycle: Callable[[], object]) -> None:
        """Calls ``cycle``, which sleeps once, until that many cycles are recorded."""
        self._left = cycles + 1  # the first one, which is stored last, began before
        self.late_s, self.busy_s = [0.0] * self._left, [0.0] * self._left
        while self._left:
            cycle()
        del self.late_s[-1], self.busy_s[-1]

    def sleep_until(self, deadline_s: float) -> None:
        """Sleeps until the absolute deadline."""
        now_s = time.monotonic()
        if self._left:
            self._left -= 1
            self.busy_s[self._left] = now_s - self._woke_s
            self.late_s[self._left] = self._late_s
        if deadline_s > now_s:
            time.sleep(deadline_s - now_s)
        self._woke_s = time.monotonic()
        self._late_s = self._woke_s - deadline_s


def parser(text: str | None, *, blocks: int = 0, cycles: int = 0) -> argparse.ArgumentParser:
    """Returns a parser of the common options; ``blocks`` and ``cycles`` are defaults, 0 omits an option."""
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if blocks:
        made.add_argument("--blocks", type=int, default=blocks, help="blocks per variant")
    if cycles:
        made.add_argument("--cycles", type=int, default=cycles, help="cycles per block, for one axis")
    return made


def block_us(work: Callable[[], object], cycles: int, timer: Callable[[], float] = time.thread_time) -> float:
    """Returns the mean time per call of ``work``, us."""
    begin = timer()
    for _ in range(cycles):
        work()
    return 1e6 * (timer() - begin) / cycles


def undisturbed(block: Callable[[], float]) -> float:
    """Returns the result of a block; repeats the block if a busy computer has caused a stop in it."""
    for _ in range(ATTEMPTS):
        with suppress(SafetyStop, Busy):
            return block()
    raise SystemExit("no block ran to its end: this machine is too busy to measure on")


def in_turn(variants: Mapping[str, Callable[[], float]], blocks: int) -> dict[str, list[float]]:
    """Runs one block of each variant in turn, repeatedly; returns the results by variant."""
    times: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(blocks):
        for name, block in variants.items():
            times[name].append(block())
    return times


def verdict(what: str, ratio: float, goal: float, reference: str) -> str:
    """Returns a line that states if a ratio reaches its goal."""
    reached = "reached" if ratio <= goal else "missed"
    return f"  goal: {what} at most {goal} x {reference}: {reached} ({ratio:.2f} x)"


def medians(times: Mapping[str, list[float]]) -> dict[str, float]:
    """Returns the median of each variant."""
    return {name: statistics.median(values) for name, values in times.items()}
