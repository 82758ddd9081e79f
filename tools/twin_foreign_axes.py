"""Fits twins of the foreign axes in tests/foreign, whose servos the simulated drive does not have.

    PYTHONPATH=tests .venv/bin/python tools/twin_foreign_axes.py --structures piv observed --first 20 --axes 2

Each axis is recorded on the plan ``dynamics`` and on another motion. The fit of its twin starts at usual
values with the gear's true transmission error, as if from a calibration. Prints for each axis the errors of
the twin's following error and torque on the other motion, per cent of the measured signal; how many of the
intervals contain the truth; the remarks on the twin; and the CPU time of the fit. With ``--checks``, each
axis is changed, recorded again and compared with its twin.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads slow down operations on such small matrices

import yaml
from foreign.bench import bench_of
from foreign.draw import Truth as Foreign
from foreign.draw import draw
from foreign.mechanics import BoucWen
from foreign.servos import STRUCTURES
from random_axes import parser, recorded, seeds
from twin_random_axes import ANOTHER, without_noise

from hdbridge.axis import AxisConfig
from hdbridge.drive.drive import Drive
from hdbridge.errors import HdbridgeError
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.check import check
from hdbridge.twin.compare import compare
from hdbridge.twin.parameters import default_truth
from hdbridge.twin.replay import replay
from hdbridge.twin.twin import fit_twin, judge


def bench(foreign: Foreign, plan: Plan) -> Recording:
    """Runs a plan on the foreign axis, over CAN frames, task by task."""
    with (
        tempfile.TemporaryDirectory() as folder,
        bench_of(foreign, Path(folder)) as axis,
        Drive(axis.bus, axis.axis, axis.clock) as drive,
    ):
        drive.boot()
        return recorded(drive, plan)


def axis_of(foreign: Foreign) -> AxisConfig:
    """Returns the axis file of a foreign axis."""
    with tempfile.TemporaryDirectory() as folder, bench_of(foreign, Path(folder)) as axis:
        return axis.axis


def start(axis: AxisConfig, foreign: Foreign) -> Truth:
    """Returns the start of the fit: usual values with the gear's true transmission error."""
    law, truth = foreign.mechanics.hysteresis, default_truth(axis).model_dump(by_alias=True)
    truth["gear"]["motor_orders"] = [each._asdict() for each in foreign.mechanics.motor_orders]
    truth["gear"]["hysteresis"] = (
        {"law": "bouc_wen", "offset_arcsec": law.offset_arcsec, "yield_deg": law.yield_deg}
        if isinstance(law, BoucWen)
        else {
            "law": "maxwell_slip",
            "elements": [{"limit_arcsec": limit, "yield_deg": travel} for limit, travel in law.elements],
        }
    )
    return Truth.model_validate(truth)


def shares(other: Recording, axis: AxisConfig, truth: Truth, seed: int) -> str:
    """Returns errors and noise of following error and torque on the other motion, per cent of the signal."""
    again = replay(other, axis, without_noise(truth), seed)
    told = compare(other.record, again, other.segments, axis.gear.ratio)
    return ", ".join(
        f"{name.split('_')[0]} {100.0 * row.share:.1f} % (noise {100.0 * row.noise / row.measured:.1f} %)"
        for name in ("following_error", "motor_torque")
        if (row := told.row(name)) is not None
    )


def _mechanics(foreign: Foreign, **changes: float) -> Foreign:
    return replace(foreign, mechanics=replace(foreign.mechanics, **changes))


def _detuned(foreign: Foreign) -> Foreign:
    """Returns the axis with a lower position loop gain, by the corresponding parameter of its structure."""
    law = foreign.servo.law
    name = "feedback_hz" if hasattr(law, "feedback_hz") else "position_gain_per_s"
    return replace(
        foreign, servo=replace(foreign.servo, law=replace(law, **{name: 0.6 * getattr(law, name)}))
    )


CHANGES = {
    "nothing": ("", lambda f: f),
    "friction doubled": ("friction", lambda f: _mechanics(f, coulomb_nm=2.0 * f.mechanics.coulomb_nm)),
    "load inertia x 1.5": (
        "load inertia",
        lambda f: _mechanics(f, load_inertia_kg_m2=1.5 * f.mechanics.load_inertia_kg_m2),
    ),
    "spring 30 % softer": (
        "gear stiffness",
        lambda f: _mechanics(f, stiffness_nm_per_rad=0.7 * f.mechanics.stiffness_nm_per_rad),
    ),
    "servo detuned": ("servo gains", _detuned),
    "1 ms of delay": (
        "servo dead time",
        lambda f: replace(f, servo=replace(f.servo, dead_time_ms=f.servo.dead_time_ms + 1.0)),
    ),
}
"""Cause that should be reported, and function that changes the axis, by name of the change."""


def print_checks(foreign: Foreign, axis: AxisConfig, twin: Truth, seed: int, workers: int) -> None:
    """Makes each change of the axis, records it with other noise, and prints the result of the check."""
    for name, (cause, change) in CHANGES.items():
        try:
            recording = bench(replace(change(foreign), seed=seed + 3000), Plan.load("dynamics"))
        except HdbridgeError as stop:
            print(f"    {name}: left out: {stop}", flush=True)
            continue
        found = check(recording, axis, twin, workers=workers)
        named = {each.cause for each in found.changes}
        silent = found.sentence.startswith("Nothing has changed")
        right = named == {cause} if cause else silent
        unseen = "could not be seen" if silent and cause in found.unseen else ""
        grown = ", ".join(f"{times:.1f}" for times in found.growth_before.values())
        verdict = "ok" if right else unseen or ("WRONG" if named or silent else "unnamed")
        print(f"    {name} [{verdict}] misfit x {grown}: ", end="")
        print(found.sentence, flush=True)


def main() -> None:
    given = parser(__doc__, axes=2, workers=1)
    given.add_argument("--structures", nargs="+", default=list(STRUCTURES), choices=list(STRUCTURES))
    given.add_argument("--checks", action="store_true", help="change the axes, and check the twins")
    options = given.parse_args()
    another = Plan.model_validate(yaml.safe_load(ANOTHER))
    for seed in seeds(options):
        for structure in options.structures:
            foreign = draw(seed, structure)
            axis = axis_of(foreign)
            law = foreign.mechanics.hysteresis
            limits = [law.offset_arcsec] if isinstance(law, BoucWen) else [limit for limit, _ in law.elements]
            if min(limits, default=0.0) < 0.0:
                print(f"{structure} {seed}: left out: its gear winds up backwards, which no truth file has")
                continue
            try:
                recording, other = bench(foreign, Plan.load("dynamics")), bench(foreign, another)
            except HdbridgeError as stop:
                print(f"{structure} {seed}: left out: {stop}", flush=True)
                continue
            began_s = time.process_time()
            twin = fit_twin([recording], axis, start(axis, foreign), workers=options.workers)
            took_s = time.process_time() - began_s
            true = foreign.by_place()
            inside = {place: pair for place, pair in twin.truth.intervals.items() if place in true}
            held = [place for place, (low, high) in inside.items() if low <= true[place] <= high]
            figures = shares(other, axis, twin.truth, seed)
            print(f"{structure} {seed}: {figures}; {len(held)} of {len(inside)} intervals; ", end="")
            print(f"{took_s:.0f} s\n    {judge(twin).text}")
            for each in twin.unexplained:
                print(f"    unexplained: {each}")
            for place in true:
                if place.startswith(("motor.", "load.", "gear.s", "gear.d", "servo.")):
                    print(
                        f"    {place}: {true[place]:.4g}, {_now(twin.truth, place)} {inside.get(place, '')}"
                    )
            sys.stdout.flush()
            if options.checks:
                print_checks(foreign, axis, twin.truth, seed, options.workers)


def _now(truth: Truth, place: str) -> str:
    at = truth
    for key in place.split("."):
        at = getattr(at, "load_" if key == "load" else key, None)
        if at is None:
            return "none"
    return f"{at:.4g}"


if __name__ == "__main__":
    main()
