"""What a set-point costs, and a correction: medians in microseconds, and ratios to a plain python loop.

    python tools/bench/motion.py [--json FILE]

`unit` is a loop of 100 float multiplications on this machine; the ratios to it are what compares between
machines.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from hdbridge.motion import SetPoint
from hdbridge.procedures.moves import MotionLimits

LIMITS = MotionLimits(-3600.0, 3600.0, 60.0, 200.0, 4000.0)
PERIOD_S = 0.004


def median_us(
    action: Callable[[], object], prepare: Callable[[], object] = lambda: None, count: int = 3000
) -> float:
    """Median of one call, microseconds; ``prepare`` is not counted."""
    taken = []
    for _ in range(count):
        prepare()
        begin = time.perf_counter()
        action()
        taken.append(time.perf_counter() - begin)
    return 1e6 * statistics.median(taken)


def unit() -> float:
    """The yardstick."""
    value = 1.0
    for _ in range(100):
        value *= 1.000001
    return value


def moving() -> SetPoint:
    """In motion, with a long way to go."""
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.goto(3600.0)
    for _ in range(30):
        set_point.step()
    return set_point


def set_points() -> dict[str, float]:
    """What the calls of a set-point cost."""
    holding, going, streaming = SetPoint(LIMITS, PERIOD_S), moving(), SetPoint(LIMITS, PERIOD_S)
    streaming.stream(1.0)
    streaming.begin_stream()
    streaming.knot(0.0, 0.0, 0.0)
    number = 0

    def knot() -> None:
        nonlocal number
        number += 1
        streaming.knot(number * PERIOD_S, 1e-9 * number, 1e-6)

    targets = [3000.0, 2000.0]

    def retarget() -> None:
        targets.reverse()
        going.goto(targets[0])

    return {
        "step, holding": median_us(holding.step),
        "step, on a plan": median_us(moving().step),
        "step, in a stream": median_us(streaming.step, knot),
        "knot": median_us(knot, streaming.step),
        "goto, in motion": median_us(retarget, going.step),
        "jog, renewed": median_us(lambda: going.jog(20.0, 0.5), going.step),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    yardstick = median_us(unit)
    figures = set_points()
    print(f"{'':32} {'us':>8} {'units':>8}   (unit: {yardstick:.2f} us)")
    for name, taken in figures.items():
        print(f"{name:32} {taken:8.2f} {taken / yardstick:8.2f}")
    if given.json:
        given.json.write_text(json.dumps({"unit_us": yardstick, "us": figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()
