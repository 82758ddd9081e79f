"""Cost of a set-point and of a correction: medians in microseconds, and ratios to a plain Python loop.

    python tools/bench/motion.py [--json FILE]

The unit is a loop of 100 float multiplications on this machine: the ratios to it compare between machines.
In the corrections' figures the axis moves; `changing` is a cycle in which two models are at work.
"""

from __future__ import annotations

import argparse
import json
import pickle
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Moment
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.loadloop import LoadLoop
from hdbridge.control.switchover import Correction
from hdbridge.motion import SetPoint
from hdbridge.motion.procedures.moves import MotionLimits

PROFILES = Path(__file__).resolve().parents[2] / "profiles"
LIMITS = MotionLimits(-3600.0, 3600.0, 60.0, 200.0, 4000.0)
PERIOD_S = 0.004


def median_us(
    action: Callable[[], object], prepare: Callable[[], object] = lambda: None, count: int = 3000
) -> float:
    """Returns the median time of one call, microseconds, without ``prepare``."""
    taken = []
    for _ in range(count):
        prepare()
        begin = time.perf_counter()
        action()
        taken.append(time.perf_counter() - begin)
    return 1e6 * statistics.median(taken)


def unit() -> float:
    """Runs the reference loop."""
    value = 1.0
    for _ in range(100):
        value *= 1.000001
    return value


def moving() -> SetPoint:
    """Returns a set-point in a long motion."""
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.goto(3600.0)
    for _ in range(30):
        set_point.step()
    return set_point


def set_points() -> dict[str, float]:
    """Measures the calls of a set-point."""
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


def corrections() -> dict[str, float]:
    """Measures a cycle of the compensation, alone and behind a `Correction`, and the load loop's."""
    model = TransmissionModel.load(PROFILES / "article" / "model.yaml")
    moment = Moment()
    # A slow ramp, so that the change lasts for the whole measurement.
    slow = CompensationLimits(ramp_s=1e6)

    def made() -> Compensation:
        compensation = Compensation(model, slow, PERIOD_S)
        compensation.reset(0.0)
        return compensation

    changing = Correction(made())
    changing.change(made())
    load = [0.0, 0.0, 0.0]
    alone, behind = made(), Correction(made())

    def cycle(place: int, its: Compensation | Correction) -> Callable[[], object]:
        def run() -> None:
            load[place] += 1e-3
            its.command(load[place], moment)

        return run

    loop = LoadLoop(1.0, 40.0, 100.0, PERIOD_S, counts_arcsec=3.6)
    # Alternating, so that a slower machine affects both.
    alone_us, behind_us = [], []
    for _ in range(9):
        alone_us.append(median_us(cycle(0, alone), count=1000))
        behind_us.append(median_us(cycle(1, behind), count=1000))
    return {
        "compensation, alone": statistics.median(alone_us),
        "correction, unchanging": statistics.median(behind_us),
        "correction, changing": median_us(cycle(2, changing)),
        "load loop, at rest": median_us(lambda: loop.step(1.0, 0.0, 0.0, False)),
    }


def pickles() -> dict[str, float]:
    """Measures the adoption of a compensation that the service has made, per bundled model."""
    taken = {}
    for path in sorted(PROFILES.rglob("model.yaml")):
        axis = AxisConfig.load(path.with_name("axis.yaml"))
        sent = pickle.dumps(compensation_for(axis, TransmissionModel.load(path)), pickle.HIGHEST_PROTOCOL)
        name = f"pickle.loads, {path.parent.name} ({len(sent)} bytes)"
        taken[name] = median_us(lambda sent=sent: pickle.loads(sent), count=500)
    return taken


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    yardstick = median_us(unit)
    figures = {**set_points(), **corrections(), **pickles()}
    print(f"{'':40} {'us':>8} {'units':>8}   (unit: {yardstick:.2f} us)")
    for name, taken in figures.items():
        print(f"{name:40} {taken:8.2f} {taken / yardstick:8.2f}")
    if given.json:
        given.json.write_text(json.dumps({"unit_us": yardstick, "us": figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()
