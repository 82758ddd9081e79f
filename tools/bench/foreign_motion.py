"""Figures of the compensation in motion.

    PYTHONPATH=tests python tools/bench/foreign_motion.py FILE [--kinds KIND...] [--seeds 0-4]
    PYTHONPATH=tests python tools/bench/foreign_motion.py FILE --retuned [--seeds 0-4]

Each axis is calibrated by `PLAN` with a motion test, without prior knowledge. Then the load error is measured
at ten speeds up to the limit, both ways, without, with static and with filtered correction. The axes are the
foreign servo structures, and the simulated drive with random servo, load and stiffness. FILE stores a line of
JSON per axis; axes in it are not measured again. Prints, per speed, the percentage removed, as median
(worst), of the orders slower than a third of the SYNC rate, with static and filtered correction, and on how
many axes the whole ripple is larger than without correction. Then prints, per path, the error and the
settling time without correction and with that of the calibration; and the error at rest.

With ``--retuned`` the position gains of simulated drives are multiplied by `GAINS` after the measurement of
the response. FILE then stores the percentage of the slow orders removed over all speeds, before and after
refinements by runs at the two speeds `WORK`, the number of refinements, and the difference that the watch
evaluates.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from foreign.bench import foreign_bench
from foreign.servos import STRUCTURES
from harness import parser
from random_axes import calibration, simulated
from support.raised import ARTICLE, raised_axis

from hdbridge import Bench, Drive
from hdbridge.analysis.response import (
    DIFFERENT,
    Answers,
    Harmonics,
    Limits,
    harmonics,
    motor_orders,
    order_hz,
)
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.motion import MotionTest, motion_test
from hdbridge.control.bench import compensation_for
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.errors import HdbridgeError
from hdbridge.motion.procedures.even_speed import EvenRun, EvenSpeed
from hdbridge.motion.procedures.plan import Plan
from hdbridge.sim.truth import Truth

SHARES = (0.04, 0.1, 0.2, 0.32, 0.45, 0.58, 0.71, 0.84, 1.0)
"""Speeds as fractions of the limit, in addition to `SLOWEST_DEG_S`; others than in the motion test."""
SLOWEST_DEG_S = 1.0
ORDERS = (1, 2, 3, 4, 6, 8)
GAINS = (1.0, 0.65, 0.8, 1.25, 1.5)
WORK = (0.46, 0.35)
STEPS = 4
BOUND = AdaptationSettings().bound_share
CHANCE = 1.02
"""Ratio of two ripples above which the first counts as larger."""
PLAN = """
schema: hdbridge.plan/1
name: short
procedures:
  - {procedure: standstill, duration_s: 2}
  - {procedure: sweep, motor_turns: 10, motor_turns_per_s: 0.5}
  - {procedure: sines, amplitudes_deg: [180, 45], frequency_hz: 0.05, periods: 2}
  - {procedure: reversals, depths_deg: [2, 4, 8, 12, 16, 24], reach_deg: 60, motor_deg_per_s: 10}
validation: {count: 20, step_deg: 43.56, motion: true}
"""
"""Plan of the calibration: `quick` without its long sweep; it takes minutes."""


def drawn(seed: int) -> tuple[AxisConfig, dict[str, Any]]:
    """Returns the article's axis with random servo, load and stiffness, and with raised limits; its truth."""
    rng = np.random.default_rng([32, seed])
    axis = yaml.safe_load(raised_axis())
    truth = yaml.safe_load((ARTICLE / "truth.yaml").read_text(encoding="utf-8"))
    axis["drive"]["following_error_deg"] = 360.0
    load = float(0.225 * math.exp(rng.uniform(math.log(0.3), math.log(3.0))))
    held = float(rng.uniform(15.0, 80.0))
    truth["load"]["inertia_kg_m2"] = load
    truth["gear"]["stiffness_nm_per_rad"] = load * (math.tau * held) ** 2
    truth["gear"]["damping_nm_s_per_rad"] = float(rng.uniform(0.1, 0.4)) * load * math.tau * held
    servo = truth["servo"]
    gain = float(rng.uniform(50.0, 300.0))
    servo["position_gain_per_s"] = gain
    servo["velocity_gain_nm_s_per_rad"] = 0.035 * max(0.5, gain / 200.0)
    servo["command_filter_ms"] = float(rng.uniform(0.0, 5.0))
    servo["dead_time_ms"] = float(0.5 * rng.integers(0, 7))
    if rng.random() < 0.5:
        servo["load_feedforward"] |= {"inertia_kg_m2": load / 2500.0, "frequency_hz": held}
    else:
        del servo["load_feedforward"]
        servo["inertia_feedforward_kg_m2"] = 0.0
    return AxisConfig.from_text(yaml.safe_dump(axis), ARTICLE / "axis.yaml"), truth


def retuned(seed: int) -> Iterator[dict[str, Any]]:
    """Yields the figures of an axis for each change of its position gain."""
    static = TransmissionModel.load(ARTICLE / "model.yaml")
    axis, truth = drawn(seed)
    with simulated(axis, Truth.model_validate(truth), seed) as (drive, _):
        model = replace(static, response=motion_test(drive, static).response)
    gain = truth["servo"]["position_gain_per_s"]
    orders, limits, limit = motor_orders(model), Limits.of(axis, model), axis.limits.velocity_deg_s
    third_hz = 1.0 / (3.0 * axis.drive.cycle_s)

    def runs(used: TransmissionModel, shares: Sequence[float]) -> tuple[EvenRun, ...]:
        return (
            Bench(drive, compensation_for(axis, used))
            .run(EvenSpeed(tuple(each * limit for each in shares)))
            .outcome
        )

    def slow(used: TransmissionModel) -> float:
        found = [harmonics(each, ORDERS, model.ratio) for each in runs(used, SHARES[1:])]
        return math.hypot(*(_slow(each, third_hz, model.ratio) for each in found))

    for factor in GAINS:
        truth["servo"]["position_gain_per_s"] = factor * gain
        with simulated(axis, Truth.model_validate(truth), seed) as (drive, _):
            used, answers, differences = model, None, []
            while len(differences) < STEPS:
                answers = Answers(used.response, orders, model.ratio, answers)
                for run in runs(used, WORK):
                    answers.take(run.speed_deg_s, *np.array([each[1:5] for each in run.samples]).T)
                differences.append(answers.difference)
                changed = used is not model or answers.difference > DIFFERENT
                response = answers.refined(model.response, limits, BOUND, retuned=changed)
                if response is None:
                    break
                used = replace(model, response=response)
            none = slow(model.only(()))
            removed = [100.0 * (1.0 - slow(each) / none) for each in (model, used)]
        steps = len(differences) - (response is None)
        yield {"seed": seed, "gain": factor, "removed": removed, "steps": steps, "difference": differences[0]}


@contextmanager
def booted(kind: str, seed: int, folder: Path) -> Iterator[Drive]:
    """Provides a simulated axis, or one with a foreign servo structure, random by seed."""
    if kind == "simulated":
        axis, truth = drawn(seed)
        with simulated(axis, Truth.model_validate(truth), seed) as (drive, _):
            yield drive
        return
    with foreign_bench(seed, kind, folder) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
        drive.boot()
        yield drive


def figures(drive: Drive, model: TransmissionModel) -> dict[str, Any]:
    """Returns the rms of the ripple and of the slow orders, arcsec, for each speed.

    Each has three values: without correction, with static correction, and with filtered correction.
    """
    axis = drive.axis
    limit = axis.limits.velocity_deg_s
    speeds = (SLOWEST_DEG_S, *(round(share * limit, 3) for share in SHARES))
    third_hz = 1.0 / (3.0 * axis.drive.cycle_s)
    ripple: list[list[float]] = []
    slow: list[list[float]] = []
    for used in (model.only(()), replace(model, response=None), model):
        bench = Bench(drive, compensation_for(axis, used))
        runs = [harmonics(each, ORDERS, model.ratio) for each in bench.run(EvenSpeed(speeds)).outcome]
        ripple.append(_both_ways([each.ripple_arcsec for each in runs]))
        slow.append(_both_ways([_slow(each, third_hz, model.ratio) for each in runs]))
    return {
        "speed_deg_s": speeds,
        "ripple_arcsec": list(zip(*ripple, strict=True)),
        "slow_orders_arcsec": list(zip(*slow, strict=True)),
        "known_to_hz": model.response.known_to_hz if model.response else None,
        "cycle_ms": axis.drive.cycle_ms,
    }


def of_paths(tested: MotionTest) -> dict[str, Any]:
    """Returns path error, arcsec, and settling time, ms, per path without and with correction."""
    found = {}
    for each in tested.paths:
        kept = [each.none, each.filtered or each.static]
        found[each.name] = [[one.path_arcsec for one in kept], [1000.0 * one.settle_s for one in kept]]
    return {"paths": found}


def _slow(run: Harmonics, third_hz: float, ratio: float) -> float:
    """Returns the rms of the orders below a third of the SYNC rate, arcsec."""
    slow = order_hz(ORDERS, run.speed_deg_s, ratio) < third_hz
    return math.sqrt(0.5 * float(np.sum(abs(run.amplitudes[slow]) ** 2)))


def _both_ways(values: list[float]) -> list[float]:
    return [math.hypot(*pair) / math.sqrt(2.0) for pair in zip(values[::2], values[1::2], strict=True)]


def measure(kind: str, seed: int) -> dict[str, Any]:
    """Returns the figures of one axis, or the error that ended its measurement."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            with booted(kind, seed, folder) as drive:
                result = calibration(drive, Plan.model_validate(yaml.safe_load(PLAN)), folder)
                assert result.motion is not None
                assert result.validation is not None
                rest = {"of_floor": result.validation.as_dict()["of_floor"]}
                return figures(drive, result.model) | of_paths(result.motion) | rest
        except HdbridgeError as problem:
            return {"error": str(problem)}


def main(file: Path, kinds: list[str], seeds: range) -> None:
    done = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    for seed in seeds:
        for kind in kinds:
            key = {"kind": kind, "seed": seed}
            if not any(key.items() <= each.items() for each in done):
                done.append(key | measure(kind, seed))
                with file.open("a") as out:
                    out.write(json.dumps(done[-1]) + "\n")
    for kind in kinds:
        report(kind, [each for each in done if each["kind"] == kind])


def report(kind: str, axes: list[dict[str, Any]]) -> None:
    """Prints the table for one kind of axis."""
    for each in axes:
        if "error" in each:
            print(f"{kind} {each['seed']}: {each['error']}")
    axes = [each for each in axes if "error" not in each]
    if not axes:
        return
    print(f"{kind}, {len(axes)} axes: removed of the slow orders, per cent, median (worst)")
    slow = np.array([each["slow_orders_arcsec"] for each in axes])
    ripple = np.array([each["ripple_arcsec"] for each in axes])
    removed = 100.0 * (1.0 - slow[:, :, 1:] / slow[:, :, :1])
    worse = ripple[:, :, 1:] > CHANCE * ripple[:, :, :1]
    for at, speed in enumerate(("1 deg/s", *(f"{100.0 * share:g} %" for share in SHARES))):
        cells = [
            f"{name} {np.median(removed[:, at, i]):5.1f} ({removed[:, at, i].min():5.1f}), "
            f"worse than none {worse[:, at, i].sum():2}"
            for i, name in enumerate(("static", "filtered"))
        ]
        print(f"  {speed:>7}: {'; '.join(cells)}")
    filtered = removed[:, :, 1]
    print(
        f"  all speeds: median {np.median(filtered):.1f}, below 88 % {np.mean(filtered < 88.0):.0%} of "
        f"{filtered.size}, worst {filtered.min():.1f}"
    )
    for name in axes[0]["paths"]:
        error, settle = np.array([each["paths"][name] for each in axes]).transpose(1, 2, 0)
        print(
            f"  {name}: none {_spread(error[0])} arcsec, corrected {_spread(error[1])}, "
            f"larger on {np.sum(error[1] > CHANCE * error[0])}; settled after {_spread(settle[0])} ms, "
            f"{_spread(settle[1])}, later by {_spread(settle[1] - settle[0])}"
        )
    if "of_floor" in axes[0]:
        print(f"  at rest: {_spread(np.array([each['of_floor'] for each in axes]))} times the floor")


def _spread(values: np.ndarray) -> str:
    return f"{np.median(values):.2f} ({values.max():.2f})"


if __name__ == "__main__":
    options = parser(__doc__)
    options.add_argument("file", type=Path)
    options.add_argument("--kinds", nargs="+", default=[*STRUCTURES, "simulated"])
    options.add_argument("--seeds", default="0-4", help="first and last")
    options.add_argument("--retuned", action="store_true", help="change the position gain afterwards")
    given = options.parse_args()
    first, last = map(int, given.seeds.split("-"))
    if given.retuned:
        for number in range(first, last + 1):
            with given.file.open("a") as out:
                for found in retuned(number):
                    print(json.dumps(found), file=out, flush=True)
        raise SystemExit
    main(given.file, given.kinds, range(first, last + 1))
