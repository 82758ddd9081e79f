"""Calibrates random axes on the simulated drive and compares the results with the truth.

    .venv/bin/python tools/calibrate_random_axes.py --axes 20 --workers 2

Each axis has its own orders and phases, offset (15-80 arcsec), width (5-40 deg), exponent (1.2-2.8), ratio
(30-160), encoder resolutions and directions, and noise (0.5-3 arcsec). The calibration is that of the
command: a plan on the bench, the fit, the stepping test before and after. Prints for each axis the parameter
errors, the number of 95 % intervals that contain the truth, the result of the stepping test relative to the
best possible with the axis's counts and noise, and the speed relative to real time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from proportions import proportion
from random_axes import DEMO, calibrated, drawn_orders, parser, seeds

from hdbridge.axis import AxisConfig
from hdbridge.sim.truth import Truth

ARCSEC_PER_RAD = 180.0 * 3600.0 / np.pi
LOOP = ("offset_arcsec", "width_deg", "exponent")


def draw(seed: int, presliding_arcsec: float = 0.0) -> tuple[dict[str, Any], dict[str, Any]]:
    """Draws axis file and truth file of a random axis; motor, servo and frequencies are those of the demo.

    With ``presliding_arcsec``, most of the hysteresis loop is due to friction at the load with presliding.
    """
    rng = np.random.default_rng(seed)
    axis, truth = (yaml.safe_load((DEMO / name).read_text()) for name in ("axis.yaml", "truth.yaml"))
    ratio = float(rng.integers(60, 321)) / 2.0
    scale = ratio / 50.0
    axis["name"] = truth["name"] = f"random-{seed}"
    axis["gear"] = {"ratio": ratio}
    for name in ("velocity_deg_s", "acceleration_deg_s2", "jerk_deg_s3"):
        axis["limits"][name] = axis["limits"][name] / scale
    motor = {
        "counts_per_turn": int(rng.choice([4000, 8000, 10_000, 16_384])),
        "direction": int(rng.choice([1, -1])),
    }
    load = {
        "counts_per_turn": int(rng.choice([1_048_576, 2_880_000, 8_388_608])),
        "direction": int(rng.choice([1, -1])),
    }
    axis["motor_encoder"].update(motor)
    axis["load_encoder"].update(load)
    truth["motor"]["encoder"].update(motor)
    truth["load"]["encoder"].update(load, noise_arcsec=float(rng.uniform(0.5, 3.0)))
    truth["load"]["inertia_kg_m2"] *= scale**2
    offset = float(rng.uniform(15.0, 80.0))
    truth["gear"].update(
        ratio=ratio,
        stiffness_nm_per_rad=truth["gear"]["stiffness_nm_per_rad"] * scale**2,
        damping_nm_s_per_rad=truth["gear"]["damping_nm_s_per_rad"] * scale**2,
        motor_orders=drawn_orders(rng, int(rng.integers(3, 7))),
        hysteresis={
            "law": "rolling_friction",
            "offset_arcsec": offset,
            "width_deg": float(rng.uniform(5.0, 40.0)),
            "exponent": float(rng.uniform(1.2, 2.8)),
            "start_arcsec": float(rng.uniform(-offset, offset)),
        },
    )
    if presliding_arcsec:
        gear = truth["gear"]
        gear["hysteresis"].update(offset_arcsec=4.0, start_arcsec=0.0)
        whole_nm = presliding_arcsec * gear["stiffness_nm_per_rad"] / ARCSEC_PER_RAD
        travel_deg = float(rng.uniform(5.0, 40.0)) / ratio
        truth["load"]["presliding"] = [
            {"limit_nm": whole_nm * part, "travel_deg": travel_deg * stretch}
            for part, stretch in ((0.3, 0.1), (0.3, 0.3), (0.2, 0.6), (0.2, 1.0))
        ]
    return axis, truth


def one(job: tuple[int, str, float]) -> dict[str, Any]:
    """Calibrates one axis; returns its figures.

    The figures of a parameter are its true value, the error of the fit, and True if the interval contains the
    true value. ``worst`` is the largest ratio of an amplitude's error to its tolerance, 0.15 arcsec or 2 %.
    """
    seed, plan, presliding_arcsec = job
    axis_data, truth = draw(seed, presliding_arcsec)
    axis = AxisConfig.from_text(yaml.safe_dump(axis_data), DEMO / "axis.yaml")
    with tempfile.TemporaryDirectory() as name:
        wall, cpu = time.perf_counter(), time.process_time()
        result, axis_s = calibrated(axis, Truth.model_validate(truth), plan, seed, Path(name))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    gear = truth["gear"]
    known = {
        f"orders[{each['order']}].{name}": float(each[name])
        for each in gear["motor_orders"]
        for name in ("amplitude_arcsec", "phase_deg")
    } | {name: float(gear["hysteresis"][name]) for name in LOOP}
    found = {each.parameter: each for each in result.fit.intervals}
    off = {name: found[name].value - value for name, value in known.items() if name in found}
    off = {name: (value + 180.0) % 360.0 - 180.0 if "phase" in name else value for name, value in off.items()}
    held = {name: abs(value) <= found[name].half_width for name, value in off.items()}
    amplitudes = {name: value for name, value in known.items() if "amplitude" in name}
    checked, nothing = result.validation, float("nan")
    return {
        **{name: (known[name], off.get(name, nothing), held.get(name, False)) for name in LOOP},
        "seed": seed,
        "ratio": axis.gear.ratio,
        "counts": axis.motor_encoder.counts_per_turn,
        "noise": float(truth["load"]["encoder"]["noise_arcsec"]),
        "worst": max(
            abs(off.get(name, value)) / max(0.15, 0.02 * value) for name, value in amplitudes.items()
        ),
        "missed": sum(name not in found for name in amplitudes),
        "invented": sum("amplitude" in name and name not in known for name in found),
        "held": sum(held.values()),
        "intervals": len(held),
        "floor": checked.floor.three_sigma_arcsec if checked else nothing,
        "after": checked.after.pooled.three_sigma_arcsec if checked else nothing,
        "before": checked.before.pooled.three_sigma_arcsec if checked else nothing,
        "offered": "" if result.offer and result.offer.made else "  not offered",
        "axis_s": axis_s,
        "by_wall": axis_s / wall,
        "by_cpu": axis_s / cpu,
    }


def row(each: dict[str, Any]) -> str:
    """Returns the output line of one axis."""
    loop = []
    for name, shown in (("offset_arcsec", "+6.1f"), ("width_deg", "+6.1f"), ("exponent", "+6.3f")):
        true, off, inside = each[name]
        error = off if name == "exponent" else 100.0 * off / true
        loop.append(f"{true:6.2f} {error:{shown}}{' ' if inside else '!'}")
    return (
        "{seed:4d} {ratio:6.1f} {counts:6d} {noise:5.2f} | {} | {} | {} | {worst:5.2f} {missed:2d} "
        "{invented:2d} | {held:2d}/{intervals:<2d} | {before:7.2f} {after:6.2f} {floor:6.2f} {:5.2f} | "
        "{axis_s:6.0f} {by_wall:5.1f} {by_cpu:5.1f}{offered}"
    ).format(*loop, each["after"] / each["floor"], **each)


HEAD = (
    "seed  ratio counts noise |  offset, off % |   width, off % |  exponent, off | worst mis inv | held  | "
    " before  after  floor ratio | axis s  x wall  x cpu"
)


def near(each: dict[str, Any], name: str, tolerance: float) -> bool:
    """Returns True if the true value is within the tolerance or the interval of the fit."""
    _, off, inside = each[name]
    return bool(inside or abs(off) <= tolerance)


GOALS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "offset within 1 % or its interval": lambda o: near(o, "offset_arcsec", 0.01 * o["offset_arcsec"][0]),
    "width within 4 % or its interval": lambda o: near(o, "width_deg", 0.04 * o["width_deg"][0]),
    "exponent within 0.04 or its interval": lambda o: near(o, "exponent", 0.04),
    "every amplitude within 0.15 arcsec or 2 %": lambda o: o["worst"] <= 1.0,
    "no order missed or invented": lambda o: not o["missed"] and not o["invented"],
    "stepping at most 1.15 x the floor": lambda o: o["after"] <= 1.15 * o["floor"],
    "at least 20 x faster than the axis": lambda o: o["by_wall"] >= 20.0,
}


def main() -> None:
    options = parser(__doc__, axes=20, workers=1)
    options.add_argument("--plan", default="quick")
    options.add_argument(
        "--presliding",
        type=float,
        default=0.0,
        help="arcsec of friction at the load that yields before it slips",
    )
    given = options.parse_args()
    jobs = [(seed, given.plan, given.presliding) for seed in seeds(given)]
    print(HEAD)
    print(
        "worst: largest amplitude error over its tolerance (0.15 arcsec or 2 %); !: outside its 95 % interval"
    )
    found = []
    with Pool(given.workers) as pool:
        for each in pool.imap(one, jobs):
            found.append(each)
            print(row(each), flush=True)
    for name, reached in GOALS.items():
        print(f"{sum(map(reached, found)):3d} of {len(found)}  {name}")
    held, intervals = sum(o["held"] for o in found), sum(o["intervals"] for o in found)
    print(f"coverage of the 95 % intervals: {proportion(held, intervals)}")


if __name__ == "__main__":
    sys.exit(main())
