"""Coverage of the identification's 95 % intervals, and missed and invented orders, over random axes.

    .venv/bin/python tools/identify_coverage.py --axes 24 --first 6000

The records are those of tests/identify: formulas that share nothing with hdbridge's models. Each axis has
its own ratio (30 to 160), orders, offset (15 to 80 arcsec), width (5 to 40 deg), exponent (1.2 to 2.8), noise
(0.5 to 3 arcsec), error of the load encoder and encoder counts.
"""

from __future__ import annotations

import sys
from collections import Counter
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from proportions import proportion
from random_axes import parser, seeds

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from identify.conftest import Axis, bench_plan
from support.legs import fit

from hdbridge.analysis.identification import FitOptions
from hdbridge.axis.effects import Start


def drawn(seed: int) -> Axis:
    """Draws an axis in the ranges that a calibration must handle."""
    rng = np.random.default_rng(seed)
    numbers = rng.choice(np.arange(1, 13), size=rng.integers(3, 8), replace=False)
    return Axis(
        ratio=float(rng.integers(30, 161)),
        orders={int(k): (float(rng.uniform(0.5, 12.0)), float(rng.uniform(-180.0, 180.0))) for k in numbers},
        offset=float(rng.uniform(15.0, 80.0)),
        width=float(rng.uniform(5.0, 40.0)),
        exponent=float(rng.uniform(1.2, 2.8)),
        noise=float(rng.uniform(0.5, 3.0)),
        load_first=float(rng.choice([0.0, rng.uniform(2.0, 20.0)])),
        motor_counts=float(rng.choice([4000, 8000, 10_000, 65_536])),
    )


def one(seed: int) -> Counter[str]:
    """Identifies an axis; returns the intervals by kind of parameter that hold, and those that do not."""
    axis = drawn(seed)
    result = fit(axis.record(bench_plan(2.0 * axis.ratio), seed), axis.ratio, FitOptions(start=Start.FORWARD))
    found = {each.order.number for each in result.orders}
    counts = Counter(missed=len(axis.orders.keys() - found), invented=len(found - axis.orders.keys()))
    true = {("hysteresis", f"{name}"): value for name, value in (
        ("offset_arcsec", axis.offset), ("width_deg", axis.width), ("exponent", axis.exponent)
    )}  # fmt: skip
    for number in found & axis.orders.keys():
        for name, value in zip(("amplitude_arcsec", "phase_deg"), axis.orders[number], strict=True):
            true["synchronous", f"orders[{number}].{name}"] = value
    for (effect, name), value in true.items():
        interval = result.interval(effect, name)
        off = interval.value - value
        off = (off + 180.0) % 360.0 - 180.0 if name.endswith("phase_deg") else off
        kind = "order" if effect == "synchronous" else name
        counts[f"{kind} {'in' if abs(off) <= interval.half_width else 'out'}"] += 1
    return counts


def main() -> None:
    given = parser(__doc__, axes=24, first=6000, workers=2).parse_args()
    with Pool(given.workers) as pool:
        counts = sum(pool.imap_unordered(one, seeds(given)), Counter[str]())
    for kind in ("offset_arcsec", "width_deg", "exponent", "order"):
        held, missed = counts[f"{kind} in"], counts[f"{kind} out"]
        print(f"{kind:14} {proportion(held, held + missed)}")
    print(f"orders missed {counts['missed']}, invented {counts['invented']}")


if __name__ == "__main__":
    main()
