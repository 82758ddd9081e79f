"""Cost of each effect: per peek and advance in the control loop, and per million samples of a record.

python tools/bench/effects.py
"""

from __future__ import annotations

import time
import timeit

import numpy as np

from hdbridge.axis.effects import CATALOGUE, Channel, Moment, Motion, Start

RATIO = 50.0


def main() -> None:
    """Prints one line per effect."""
    base = [CATALOGUE["synchronous"].candidate(RATIO), CATALOGUE["hysteresis"].candidate(RATIO)]
    count = 1_000_000
    time_s = np.arange(count) * 0.004
    angle = 2000.0 * np.sin(0.3 * time_s) + 15.0 * np.sin(4.0 * time_s)
    record = Motion(
        angle,
        time_s,
        {Channel.LOAD_TORQUE: 20.0 * np.sin(time_s), Channel.TEMPERATURE: 20.0 + 1e-3 * time_s},
        load_deg=angle / RATIO,
    )
    moment = Moment(10.0, (5.0, 0.1, 25.0), 100.0, 50.0, 1, 3.0)
    print(f"{'effect':28} {'peek us':>8} {'advance us':>10} {'1e6 samples: predict s':>24} {'columns s':>10}")
    for name, kind in CATALOGUE.items():
        effect = kind.candidate(RATIO, base)
        tracker = effect.tracker(Start.FORWARD)
        for each in (0.0, 50.0, 45.0, 46.0):
            tracker.advance(each, moment)
        peek = min(timeit.repeat(lambda t=tracker: t.peek(45.5, moment), number=20_000, repeat=5)) / 0.02
        turns = iter(np.tile(np.array([45.5, 45.8, 45.2, 45.9]), 30_000).tolist())
        advance = (
            min(timeit.repeat(lambda t=tracker, a=turns: t.advance(next(a), moment), number=20_000, repeat=5))
            / 0.02
        )
        begin = time.perf_counter()
        effect.predict(record)
        middle = time.perf_counter()
        effect.columns(record)
        end = time.perf_counter()
        print(f"{name:28} {peek:8.2f} {advance:10.2f} {middle - begin:24.3f} {end - middle:10.3f}")


if __name__ == "__main__":
    main()
