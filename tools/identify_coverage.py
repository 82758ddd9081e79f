"""Coverage of the identification's intervals and accuracy of its parameters, over many random axes.

    .venv/bin/python tools/identify_coverage.py --axes 100

Each axis is drawn at random (ratio 30-160, offset 15-80 arcsec, width 5-40 deg, exponent 1.2-2.8, noise 0.5-3
arcsec, other encoders), moved through a bench plan and identified from the record alone. Prints the coverage
of the 95 % intervals, the share within the tolerances (amplitudes 0.15 arcsec or 2 %, offset 1 %, width 4 %,
exponent 0.04) and within tolerance or interval, and the false and missed orders.

The records come from formulas, not from hdbridge's models (`record`). An axis also has properties that the
identification does not model: a motor that lags its command and stops short within a count, a slow drift, a
load encoder that is read a little later.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from dataclasses import dataclass, field
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from random_axes import parser, seeds
from scipy.signal import lfilter

from hdbridge.analysis.identification import FitOptions
from hdbridge.analysis.identify import fit
from hdbridge.axis.effects import Start
from hdbridge.commissioning.calibration import measured_of
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment

RATE_HZ = 250.0
ARCSEC = 3600.0
TOLERANCE = {"offset_arcsec": 0.01, "width_deg": 0.04}


@dataclass
class Truth:
    ratio: float = 50.0
    orders: dict[int, tuple[float, float]] = field(default_factory=dict)  # k: arcsec, degrees
    offset: float = 40.0
    width: float = 20.0
    exponent: float = 1.6
    noise: float = 1.0  # arcsec, white, at the load
    wander: float = 0.3  # arcsec, slow
    wander_s: float = 20.0
    motor_counts: float = 8000.0
    load_counts: float = 2_880_000.0
    lag_s: float = 0.005
    delay_s: float = 0.0002
    load_first: float = 0.0  # arcsec, once per load turn


def draw(rng: np.random.Generator) -> Truth:
    """Draws a random axis in the ranges that a calibration must handle."""
    numbers = rng.choice(np.arange(1, 13), size=rng.integers(3, 8), replace=False)
    return Truth(
        ratio=float(rng.integers(30, 161)),
        orders={
            int(k): (float(rng.uniform(0.5, 12.0)), float(rng.uniform(-180, 180))) for k in sorted(numbers)
        },
        offset=float(rng.uniform(15, 80)),
        width=float(rng.uniform(5, 40)),
        exponent=float(rng.uniform(1.2, 2.8)),
        noise=float(rng.uniform(0.5, 3.0)),
        wander=float(rng.uniform(0.0, 0.6)),
        wander_s=float(rng.uniform(5.0, 60.0)),
        motor_counts=float(rng.choice([4000, 8000, 10000, 65536])),
        delay_s=float(rng.uniform(0.0, 0.0005)),
        load_first=float(rng.choice([0.0, rng.uniform(2, 20)])),
    )


def branch(xi: np.ndarray, n: float) -> np.ndarray:
    """Returns g of the rolling-friction law."""
    xi = np.clip(xi, 0.0, 1.0)
    if abs(n - 2.0) < 1e-9:
        return np.where(xi > 0, xi * (1.0 - np.log(np.maximum(xi, 1e-300))), 0.0)
    return (xi ** (n - 1.0) - (n - 1.0) * xi) / (2.0 - n)


def hysteresis(motor_deg: np.ndarray, offset: float, width: float, n: float, state: float) -> np.ndarray:
    """Returns the hysteresis error along a path, from saturation in the direction ``state``."""
    out = np.empty(len(motor_deg))
    out[0] = value = state * offset
    steps = np.diff(motor_deg)
    moving = np.flatnonzero(steps)
    if not len(moving):
        out[:] = value
        return out
    signs = np.sign(steps[moving])
    cut = np.flatnonzero(np.diff(signs)) + 1
    firsts = np.concatenate([[moving[0]], moving[cut]])
    lasts = np.concatenate([moving[cut], [len(motor_deg) - 1]])
    out[: firsts[0] + 1] = value
    for first, last, sign in zip(firsts, lasts, signs[np.concatenate([[0], cut])], strict=True):
        xi = np.abs(motor_deg[first + 1 : last + 1] - motor_deg[first]) / width
        out[first + 1 : last + 1] = sign * np.minimum(sign * value + 2.0 * offset * branch(xi, n), offset)
        value = out[last]
    return out


def ramp(begin: float, end: float, speed: float, acceleration: float = 100.0) -> np.ndarray:
    """Returns a trapezoidal move at `RATE_HZ`, without its first point."""
    way = abs(end - begin)
    speed = min(speed, np.sqrt(way * acceleration))
    rise = speed / acceleration
    total = way / speed + rise
    t = np.arange(1, int(np.ceil(total * RATE_HZ)) + 1) / RATE_HZ
    t = np.minimum(t, total)
    s = np.where(
        t < rise,
        0.5 * acceleration * t**2,
        np.where(t < total - rise, speed * (t - 0.5 * rise), way - 0.5 * acceleration * (total - t) ** 2),
    )
    return begin + np.sign(end - begin) * s


def plan(
    ratio: float, turns: float = 2.0, speed: float = 4.0, steps: int = 60, periods: int = 2
) -> list[tuple[str, np.ndarray]]:
    """Returns legs of load targets: pre-conditioning, rest, sweeps, sines, nested reversals, steps."""
    legs: list[tuple[str, np.ndarray]] = []
    at = 0.0
    speed *= 1.00713  # avoids synchronism with the encoder's counts

    def go(kind: str, end: float, velocity: float) -> None:
        nonlocal at
        if end != at:
            legs.append((kind, ramp(at, end, velocity)))
            at = end

    def rest(kind: str, seconds: float) -> None:
        legs.append((kind, np.full(int(seconds * RATE_HZ), at)))

    go("move", -2.0, 20.0)
    go("move", 0.0, 20.0)
    rest("standstill", 10.0)
    go("sweep", 360.0 * turns, speed)
    go("sweep", 0.0, speed)
    for amplitude_deg in (180.0, 45.0, 5.0):
        amplitude = amplitude_deg / ratio
        go("move", amplitude, 20.0)
        rest("move", 0.2)
        t = np.arange(1, int(periods * 20 * RATE_HZ) + 1) / RATE_HZ
        legs.append(("sine", amplitude * np.cos(2 * np.pi * 0.05 * t)))
    for depth in (2.0, 4.0, 8.0, 12.0, 16.0, 24.0):
        go("move", -60.0 / ratio, 20.0)
        for place in (0.0, -depth, -0.5 * depth, -depth, 0.0):
            go("reversal", place / ratio, 0.4)
    go("move", -2.0, 20.0)
    go("move", 0.0, 20.0)
    for index in [*range(1, steps + 1), *range(steps - 1, -1, -1)]:
        go("step", index * 43.56 / ratio, 20.0)
        rest("step", 0.3)
    return legs


def record(
    truth: Truth, rng: np.random.Generator, legs: list[tuple[str, np.ndarray]], every: int = 1
) -> list[dict[str, np.ndarray | str]]:
    """Records the legs; each is a dict of kind, time_s, target_deg, position_deg, load_deg."""
    load_target = np.concatenate([each for _, each in legs])
    count = 360.0 / truth.motor_counts
    target = np.round(load_target * truth.ratio / count) * count
    motor = np.empty(len(target))
    value, keep = target[0], np.exp(-1.0 / (truth.lag_s * RATE_HZ))
    at = 0
    for _, leg in legs:
        part = slice(at, at + len(leg))
        demand = target[part]  # a drive receives whole counts
        # First-order lag behind the command.
        response = np.empty(len(demand))
        for index, wanted in enumerate(demand.tolist()):
            value = wanted + (value - wanted) * keep
            response[index] = value
        motor[part] = response
        at += len(leg)
    motor = _stopping_short(motor, load_target, count, rng)
    time = np.arange(len(motor)) / RATE_HZ
    seen = np.interp(time - truth.delay_s, time, motor)  # the motor as it was when the load was read
    radians = np.deg2rad(seen)
    error = hysteresis(seen, truth.offset, truth.width, truth.exponent, 1.0)
    for order, (amplitude, phase) in truth.orders.items():
        error += amplitude * np.cos(order * radians + np.deg2rad(phase))
    error += truth.load_first * np.cos(radians / truth.ratio + 1.0)
    load = seen / truth.ratio + error / ARCSEC
    step = np.exp(-1.0 / (truth.wander_s * RATE_HZ))
    kicks = rng.normal(size=len(load)) * truth.wander * np.sqrt(1.0 - step**2)
    load += (lfilter([1.0], [1.0, -step], kicks) + rng.normal(size=len(load)) * truth.noise) / ARCSEC
    quantum = 360.0 / truth.load_counts
    load = np.round(load / quantum) * quantum
    position = np.round(motor / count) * count
    result: list[dict[str, np.ndarray | str]] = []
    at = 0
    for kind, leg in legs:
        part = slice(at + (-at) % every, at + len(leg), every)
        result.append(
            {
                "kind": kind,
                "time_s": time[part],
                "target_deg": target[part],
                "position_deg": position[part],
                "load_deg": load[part],
            }
        )
        at += len(leg)
    return result


def recording(rows: list[dict[str, np.ndarray | str]]) -> Recording:
    """Returns the legs of `record` as a recording of the bench."""
    names = {
        "time_s": "time_s",
        "motor_target_deg": "target_deg",
        "motor_position_deg": "position_deg",
        "load_position_deg": "load_deg",
    }
    columns = {column: np.concatenate([row[name] for row in rows]) for column, name in names.items()}
    times = [(row["kind"], *row["time_s"][[0, -1]].tolist()) for row in rows]
    legs = (Segment(kind=kind, start_s=first, end_s=last) for kind, first, last in times)
    return Recording(Record(columns), tuple(legs))


def _stopping_short(
    motor: np.ndarray, load_target: np.ndarray, count: float, rng: np.random.Generator
) -> np.ndarray:
    """Leaves the motor up to half a count short of its target at each rest, on the side that it came from."""
    result = motor.copy()
    moving = np.diff(load_target, prepend=load_target[0]) != 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~moving, [False]]).astype(np.int8)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if begin == 0 or end - begin < 20:
            continue
        sense = np.sign(load_target[begin - 1] - load_target[max(begin - 10, 0)])
        edge = motor[end - 1] - sense * rng.uniform(0.0, 0.5) * count
        low = max(begin - 50, 0)
        stretch = result[low:end]
        result[low:end] = np.minimum(stretch, edge) if sense > 0 else np.maximum(stretch, edge)
    return result


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
    given.add_argument("--every", type=int, default=5, help="keep one sample in this many, of 250 Hz")
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
