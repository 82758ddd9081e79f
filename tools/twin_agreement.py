"""Calibrates and steps random axes and their twins, and compares the results.

    .venv/bin/python tools/twin_agreement.py --first 500 --axes 2

The axes are those of tools/twin_random_axes.py. Each is treated as an axis on a bench: calibrated with the
stepping test, and recorded on the plan ``dynamics``. Its twin is fitted from usual values with the
transmission error of the calibrated model, and then calibrated and stepped in the same way. Prints for each
axis 3 sigma of the stepping test without compensation, the hysteresis offset, and the largest difference of
an order.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from random_axes import calibrated, parser, seeds
from twin_random_axes import bench, draw

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration import Calibration
from hdbridge.errors import SafetyStop
from hdbridge.motion.procedures.plan import Plan
from hdbridge.sim.truth import Truth
from hdbridge.twin.translate import translate
from hdbridge.twin.twin import fit_twin

STEPPING, ORDERS_ARCSEC, OFFSET = 0.05, 0.3, 0.02
"""Tolerances of a twin: relative error of 3 sigma, phasor of each order, relative error of the offset."""


def calibration(axis: AxisConfig, truth: Truth, plan: str, seed: int) -> Calibration:
    """Calibrates an axis that has no model, stepping test included."""
    with tempfile.TemporaryDirectory() as folder:
        return calibrated(axis, truth, plan, seed, Path(folder))[0]


def three_sigma_arcsec(found: Calibration) -> float:
    """Returns 3 sigma of the stepping test without compensation, arcsec."""
    return found.validation.before.pooled.three_sigma_arcsec if found.validation else float("nan")


def offset_arcsec(model: TransmissionModel) -> float:
    """Returns the hysteresis offset of a model; 0 without hysteresis."""
    return sum(
        each.offset_arcsec for each in model.effects if isinstance(each, Hysteresis | HysteresisMemory)
    )


def phasors(model: TransmissionModel) -> dict[int, complex]:
    """Returns the complex amplitude of each motor order, arcsec."""
    return {
        each.order: each.amplitude_arcsec * np.exp(1j * np.radians(each.phase_deg))
        for effect in model.effects
        if isinstance(effect, Synchronous)
        for each in effect.orders
    }


def one(seed: int, plan: str, workers: int) -> str:
    """Measures one axis and its twin; returns one line of the table."""
    began_s = time.perf_counter()
    axis, truth = draw(seed)
    own = calibration(axis, truth, plan, seed)
    recording = bench(axis, truth, Plan.load("dynamics"), seed + 1000)
    start = translate(axis, own.model).truth
    twin = fit_twin([recording], axis, start, workers=workers).truth
    again = calibration(axis, twin, plan, seed + 2000)
    law = truth.gear.hysteresis.law if truth.gear.hysteresis else "none"
    return f"{seed:4d} {law:16s} | {compared(own, again)} | {time.perf_counter() - began_s:.0f} s"


def compared(own: Calibration, again: Calibration) -> str:
    """Compares the calibrations of an axis and of its twin."""
    stepped = three_sigma_arcsec(own), three_sigma_arcsec(again)
    offsets = offset_arcsec(own.model), offset_arcsec(again.model)
    one, other = phasors(own.model), phasors(again.model)
    apart = {order: abs(one.get(order, 0.0) - other.get(order, 0.0)) for order in {*one, *other}}
    worst = max(apart, key=lambda order: apart[order], default=0)
    off = apart.get(worst, 0.0)
    verdicts = (
        abs(stepped[1] / stepped[0] - 1.0) <= STEPPING,
        abs(offsets[1] / offsets[0] - 1.0) <= OFFSET,
        off <= ORDERS_ARCSEC,
    )
    return (
        f"3 sigma {stepped[0]:6.2f} {stepped[1]:6.2f} "
        f"({100 * (stepped[1] / stepped[0] - 1):+.1f} %) | offset {offsets[0]:6.2f} {offsets[1]:6.2f} "
        f"({100 * (offsets[1] / offsets[0] - 1):+.1f} %) | order {worst} {off:.2f} arcsec apart | "
        f"{' '.join('ok' if each else 'OUT' for each in verdicts)}"
    )


def main() -> None:
    given = parser(__doc__, axes=4, workers=2)
    given.add_argument("--plan", default="quick", help="of the calibrations")
    options = given.parse_args()
    print("the axis, its twin (how far that is off)")
    for seed in seeds(options):
        try:
            print(one(seed, options.plan, options.workers), flush=True)
        except SafetyStop as stop:
            print(f"{seed:4d} left out: {stop}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
