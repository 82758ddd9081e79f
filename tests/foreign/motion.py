"""Figures of the compensation in motion: `PYTHONPATH=tests python -m foreign.motion [SEEDS [KIND]...]`.

Each axis has the exact correction of rest as its model. Its response is measured over the bus as
`hdbridge motion` does. Then the ripple of the load encoder is measured at fixed speeds. Axes: the foreign
servo structures, and the simulated drive with a servo, load and spring drawn at random. Per speed: the share
of the ripple that is removed, per cent, median (worst), static and filtered; the axes on which the filtered
correction is worse than none; and the same for axes whose large orders (4 and below) are all slower than a
third of the SYNC rate.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from foreign.bench import foreign_bench
from foreign.draw import draw
from foreign.servos import STRUCTURES

from hdbridge import Bench, Drive
from hdbridge.analysis.response import harmonics
from hdbridge.axis import AxisConfig
from hdbridge.calibration.motion import motion_test, motor_orders
from hdbridge.control.bench import compensation_for
from hdbridge.effects import MotorOrder, Synchronous
from hdbridge.errors import HdbridgeError
from hdbridge.model import TransmissionModel
from hdbridge.procedures.even_speed import EvenSpeed
from hdbridge.sim.lockstep import simulated_bench

SPEEDS_DEG_S = (5.0, 38.0, 76.0, 100.0, 120.0)
PROFILE = Path(__file__).resolve().parents[2] / "profiles" / "article"
RAISED = {
    "position_min_deg": -4000.0,
    "position_max_deg": 4000.0,
    "velocity_deg_s": 130.0,
    "acceleration_deg_s2": 300.0,
}


@contextmanager
def simulated(seed: int, folder: Path) -> Iterator[tuple[Drive, TransmissionModel]]:
    """The article's gear on a drawn servo, load and spring; the axis file with raised limits."""
    rng = np.random.default_rng([32, seed])
    axis = yaml.safe_load((PROFILE / "axis.yaml").read_text(encoding="utf-8"))
    truth = yaml.safe_load((PROFILE / "truth.yaml").read_text(encoding="utf-8"))
    axis["limits"] |= RAISED
    axis["drive"]["following_error_deg"] = 360.0
    axis["compensation"] |= {"maximum_arcsec": 600, "slew_arcsec_s": 100000}
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
    (folder / "axis.yaml").write_text(yaml.safe_dump(axis), encoding="utf-8")
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth), encoding="utf-8")
    config = AxisConfig.load(folder)
    model = TransmissionModel.load(PROFILE / "model.yaml")
    with (
        simulated_bench(folder / "truth.yaml", config.eds_path, seed=seed) as (bus, clock, _),
        Drive(bus, config, clock) as drive,
    ):
        drive.boot()
        yield drive, model


@contextmanager
def foreign(seed: int, structure: str, folder: Path) -> Iterator[tuple[Drive, TransmissionModel]]:
    """The foreign axis of a seed, and the correction of its motor orders."""
    truth = draw(seed, structure)
    orders = tuple(MotorOrder(**each._asdict()) for each in truth.mechanics.motor_orders)
    with (
        foreign_bench(seed, structure, folder) as bench,
        Drive(bench.bus, bench.axis, bench.clock) as drive,
    ):
        drive.boot()
        yield drive, TransmissionModel(truth.mechanics.ratio, (Synchronous(orders=orders),))


def figures(drive: Drive, model: TransmissionModel) -> np.ndarray:
    """Ripple at each speed without, with static and with filtered correction; NaN if too fast, (n, 3)."""
    axis = drive.axis
    response = motion_test(drive, model).response
    speeds = tuple(each for each in SPEEDS_DEG_S if each <= 0.95 * axis.limits.velocity_deg_s)
    orders = tuple(each.order for each in motor_orders(model))
    table = np.full((len(SPEEDS_DEG_S), 3), np.nan)
    for column, used in enumerate(
        (model.only(()), replace(model, response=None), replace(model, response=response))
    ):
        bench = Bench(drive, compensation_for(axis, used))
        runs = [harmonics(each, orders, model.ratio) for each in bench.run(EvenSpeed(speeds, 2.0)).outcome]
        table[: len(speeds), column] = np.sqrt(
            np.mean(np.reshape([each.ripple_arcsec**2 for each in runs], (-1, 2)), axis=1)
        )
    return table


def main(seeds: int, kinds: list[str]) -> None:
    for kind in kinds or (*STRUCTURES, "simulated"):
        tables, slow = [], []
        for seed in range(seeds):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                place = simulated(seed, folder) if kind == "simulated" else foreign(seed, kind, folder)
                try:
                    with place as (drive, model):
                        table = figures(drive, model)
                        limit = 1.0 / (3.0 * drive.axis.drive.cycle_s)
                except HdbridgeError as problem:
                    print(f"  {kind} {seed}: {problem}")
                    continue
            hertz = 4.0 * np.array(SPEEDS_DEG_S) * model.ratio / 360.0
            tables.append(table)
            slow.append(hertz < limit)
            removed = 100.0 * (1.0 - table[:, 1:] / table[:, :1])
            line = "  ".join(f"{a:.0f}/{b:.0f}" for a, b in removed if not math.isnan(a))
            print(f"  {kind} {seed}: static/filtered {line}", flush=True)
        print(f"{kind}: {len(tables)} axes")
        every, slower = np.array(tables), np.array(slow)
        for at, speed in enumerate(SPEEDS_DEG_S):
            print(f"  {speed:g} deg/s: {_line(every[:, at])}; slow orders: {_line(every[slower[:, at], at])}")
        sys.stdout.flush()


def _line(table: np.ndarray) -> str:
    table = table[~np.isnan(table[:, 0])]
    if not len(table):
        return "none"
    removed = 100.0 * (1.0 - table[:, 1:] / table[:, :1])
    cells = [f"{np.median(each):.0f} ({each.min():.0f})" for each in removed.T]
    worse = int(np.sum(table[:, 2] > 1.02 * table[:, 0]))
    return f"static {cells[0]}, filtered {cells[1]}, worse than none {worse} of {len(table)}"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5, sys.argv[2:])
