"""Draws random thermal constants for the demo's axis and measures the coverage of a twin's intervals.

    python tools/twin_warmth.py --first 100 --axes 30 --minutes 30

Each axis has its own ambient temperature (14 to 32 deg C), thermal resistance (0.8 to 5 K/W), time constant
(240 to 1500 s) and copper loss (0 to 30 W). It moves for three quarters of the time: slow moves, moves at
high acceleration and rests, in periods of 20 to 180 s; then it rests. The temperature is measured in steps of
0.1 K. The twin begins at usual values. Its mechanics are those of the axis, except for friction, which has a
random error with the uncertainty of a fit: 0.5 % (Coulomb) and 3 % (viscous).
"""

from __future__ import annotations

import math

import numpy as np
from proportions import proportion
from random_axes import DEMO, parser, seeds

from hdbridge.axis import AxisConfig
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import Fitted
from hdbridge.twin.misfit import Scales
from hdbridge.twin.parameters import BY_NAME, at_coordinates, coordinates
from hdbridge.twin.thermal import THERMAL, with_warmth

AXIS, TRUTH = AxisConfig.load(DEMO), Truth.load(DEMO)
STEP_K = 0.1
FRICTION = {"Coulomb friction": 0.005, "viscous friction": 0.03}


def draw(rng: np.random.Generator) -> Truth:
    """Returns the demo's axis with random thermal constants and ambient temperature."""

    def some() -> float:
        return float(np.exp(rng.uniform(-1.0, 1.0) * math.log(2.5)))

    ambient_c = float(rng.uniform(14.0, 32.0))
    heat = {
        "ambient_c": ambient_c,
        "start_c": ambient_c + float(rng.uniform(-2.0, 5.0)),
        "resistance_k_per_w": 2.0 * some(),
        "time_constant_s": 600.0 * some(),
        "copper_loss_w": float(rng.uniform(0.0, 30.0)),
    }
    return TRUTH.model_copy(update={"temperature": TRUTH.temperature.model_copy(update=heat)})


def recorded(truth: Truth, rng: np.random.Generator, minutes: float) -> Recording:
    """Records motion of several kinds, and a final rest."""
    machine = Machine(truth, 0, may_compile=True)
    machine.torque_limit_permille = 10.0 * AXIS.limits.torque_percent
    bench = Exercise(machine)
    works_s = 0.75 * 60.0 * minutes
    while bench.samples * bench.cycle_s < works_s:
        kind, until_s = rng.integers(3), bench.samples * bench.cycle_s + float(rng.uniform(20.0, 180.0))
        while bench.samples * bench.cycle_s < until_s:
            way = float(rng.choice([-1.0, 1.0]))
            if kind == 0:
                bench.move(way * rng.uniform(300.0, 4000.0), rng.uniform(300.0, 3000.0), 9_000.0)
            elif kind == 1:
                bench.move(way * rng.uniform(100.0, 600.0), 5000.0, rng.uniform(30_000.0, 90_000.0))
            else:
                bench.hold(rng.uniform(1.0, 5.0))
    bench.hold(works_s / 3.0)
    told = bench.readings()
    columns = {
        "time_s": told.time_s,
        "motor_target_deg": told.target_deg,
        "motor_position_deg": told.motor_deg,
        "load_position_deg": told.load_deg,
        "motor_torque_nm": told.motor_torque_nm,
        "temperature_c": STEP_K * np.round(told.temperature_c / STEP_K),
    }
    return Recording(Record(columns))


def fitted(rng: np.random.Generator) -> Fitted:
    """Returns the axis's mechanics with the random errors of a fit."""
    parameters, spread = tuple(BY_NAME[name] for name in FRICTION), np.array(list(FRICTION.values()))
    place = np.array(coordinates(TRUTH, parameters)) + spread * rng.standard_normal(len(spread))
    truth = at_coordinates(TRUTH, parameters, place.tolist())
    none = np.zeros(0)
    return Fitted(
        truth, parameters, prior=place, place=place, covariance=np.diag(spread**2), scales=Scales({}),
        residuals={}, rows=none.astype(np.bool_), vector=none, jacobian=np.zeros((0, len(spread))),
    )  # fmt: skip


def main() -> None:
    given = parser(__doc__, axes=30)
    given.add_argument("--minutes", type=float, default=30.0, help="length of a recording")
    options = given.parse_args()
    held, named = np.zeros(len(THERMAL), dtype=np.int64), 0
    for seed in seeds(options):
        rng = np.random.default_rng(seed)
        truth = draw(rng)
        recording, fit = recorded(truth, rng, options.minutes), fitted(rng)
        after, finding = with_warmth(recording, AXIS, fit, fit.truth)
        warm_c = recording.record.columns["temperature_c"]
        cells = [f"{seed:4d} {warm_c[0]:.1f}, {np.min(warm_c):.1f} to {np.max(warm_c):.1f} C"]
        for number, each in enumerate(THERMAL):
            true, now = (getattr(t.temperature, each.path.split(".")[-1]) for t in (truth, after))
            lower, upper = after.intervals[each.path]
            held[number] += lower <= true <= upper
            missed = "" if lower <= true <= upper else " missed"
            cells.append(f"{each.name} {true:.4g}: {now:.4g} ({lower:.4g} to {upper:.4g}){missed}")
        named += finding is not None
        print(" | ".join(cells), flush=True)
    print(f"warmth named on {named} of {options.axes}")
    for name, hits, count in (
        *((each.name, int(n), options.axes) for each, n in zip(THERMAL, held, strict=True)),
        ("all", int(held.sum()), options.axes * len(THERMAL)),
    ):
        print(f"{name}: intervals that hold {proportion(hits, count)}")


if __name__ == "__main__":
    main()
