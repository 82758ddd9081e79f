"""Coverage of the identification's intervals and accuracy of its parameters, over many random axes.

    .venv/bin/python tools/identify_coverage.py --axes 100

Each axis is drawn at random (ratio 30-160, offset 15-80 arcsec, width 5-40 deg, exponent 1.2-2.8, noise 0.5-3
arcsec, other encoders), moved through a bench plan and identified from the record alone. Prints the coverage
of the 95 % intervals, the share within the tolerances (amplitudes 0.15 arcsec or 2 %, offset 1 %, width 4 %,
exponent 0.04) and within tolerance or interval, and the false and missed orders.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from identify_records import draw, plan, record, recording
from random_axes import parser, seeds

from hdbridge.analysis.identification import FitOptions
from hdbridge.analysis.identify import fit
from hdbridge.axis.effects import Start
from hdbridge.commissioning.calibration import measured_of

TOLERANCE = {"offset_arcsec": 0.01, "width_deg": 0.04}


def one(job: tuple[int, int, float]) -> dict[str, object]:
    seed, every, speed = job
    rng = np.random.default_rng(seed)
    truth = draw(rng)
    rows = record(truth, rng, plan(truth.ratio, speed=speed), every)
    begun = time.perf_counter()
    result = fit(measured_of([recording(rows)]), truth.ratio, FitOptions(start=Start.FORWARD))
    taken = time.perf_counter() - begun
    found = []
    wanted = {"offset_arcsec": truth.offset, "width_deg": truth.width, "exponent": truth.exponent}
    for name, value in wanted.items():
        try:
            interval = result.interval("hysteresis", name)
        except KeyError:
            continue
        near = TOLERANCE[name] * value if name in TOLERANCE else 0.04
        found.append((name, value, interval.value, interval.half_width, near))
    numbers = {each.order.number for each in result.orders}
    for number in sorted(numbers & truth.orders.keys()):
        amplitude, phase = truth.orders[number]
        near = max(0.15, 0.02 * amplitude)
        interval = result.interval("synchronous", f"orders[{number}].amplitude_arcsec")
        found.append(("amplitude_arcsec", amplitude, interval.value, interval.half_width, near))
        interval = result.interval("synchronous", f"orders[{number}].phase_deg")
        off = (interval.value - phase + 180.0) % 360.0 - 180.0
        found.append(("phase_deg", 0.0, off, interval.half_width, np.rad2deg(near / amplitude)))
    delay = [each for each in result.nuisances if each.name == "delay_ms"]
    for each in delay:
        found.append(("delay_ms", truth.delay_s * 1000.0, each.value, each.half_width, 0.05))
    return {
        "seed": seed,
        "truth": vars(truth),
        "found": found,
        "invented": sorted(numbers - truth.orders.keys()),
        "missed": sorted(truth.orders.keys() - numbers),
        "samples": result.noise.samples,
        "seconds": taken,
        "warnings": [each for each in result.warnings if "order 1 shows" not in each],
        "improves": result.held_out.improves,
    }


def main() -> None:
    given = parser(__doc__, axes=100, first=1000, workers=2)
    given.add_argument("--every", type=int, default=5, help="keep every so many samples of 250 Hz")
    given.add_argument("--speed", type=float, default=4.0, help="of the sweeps, load degrees per second")
    given.add_argument("--json", type=Path)
    options = given.parse_args()
    jobs = [(seed, options.every, options.speed) for seed in seeds(options)]
    with Pool(options.workers) as pool:
        axes = list(pool.imap_unordered(one, jobs))
    gathered: dict[str, list[tuple[float, float, float, float]]] = defaultdict(list)
    for axis in axes:
        for name, true, value, half, near in axis["found"]:
            gathered[name].append((true, value, half, near))
    print(
        f"{'parameter':18s}{'fits':>6s}{'covered':>9s}{'within':>8s}{'or in CI':>10s}"
        f"{'median half':>13s}{'bias/se':>9s}"
    )
    for name, rows in gathered.items():
        true, value, half, near = np.array(rows).T
        off = value - true
        print(
            f"{name:18s}{len(rows):6d}{np.mean(np.abs(off) <= half):9.1%}{np.mean(np.abs(off) <= near):8.1%}"
            f"{np.mean(np.abs(off) <= np.maximum(near, half)):10.1%}{np.median(half):13.4f}"
            f"{np.mean(off / half) * 1.96:9.2f}"
        )
    print(
        f"axes {len(axes)}, orders invented {sum(len(a['invented']) for a in axes)}, "
        f"missed {sum(len(a['missed']) for a in axes)}, "
        f"held-out improves {sum(a['improves'] for a in axes)}, "
        f"median fit {np.median([a['seconds'] for a in axes]):.1f} s "
        f"for {np.median([a['samples'] for a in axes]):.0f} samples"
    )
    if options.json:
        options.json.write_text(json.dumps(axes, default=float))


if __name__ == "__main__":
    main()
