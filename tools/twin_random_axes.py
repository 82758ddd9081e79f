"""Fits twins of random axes on the simulated drive and compares them with the truth.

    .venv/bin/python tools/twin_random_axes.py --axes 8 --checks

Each axis has its own inertias, friction, control loops and feed-forward (half to double the usual values),
dead time (0 to 3 ms), resonance (15 to 80 Hz), ratio (30 to 160), hysteresis law, tooth orders and noise. Its
axis file allows the following error that such a drive needs; gains near instability are drawn again. The axis
is recorded over CAN frames on the plan ``dynamics``, its twin is fitted from the usual values
(`hdbridge.twin.parameters`), and the twin is judged on another motion that the fit has not used. Prints for
each axis the differences on that motion, the number of 95 % intervals that contain the truth, and the result
of the check after no change, one change or two changes of the plant.

The gear's transmission error is given, as if from a calibration (tools/calibrate_random_axes.py measures
that); this tool measures the rest.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads slow down operations on such small matrices

import numpy as np
import yaml
from proportions import proportion
from random_axes import DEMO, drawn_orders, parser, recorded, seeds, simulated

from hdbridge.axis import AxisConfig
from hdbridge.errors import SafetyStop
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.check import check
from hdbridge.twin.compare import compare
from hdbridge.twin.parameters import BY_NAME, default_truth, value_in, with_values
from hdbridge.twin.replay import replay
from hdbridge.twin.twin import fit_twin

LAWS = ("rolling_friction", "maxwell_slip", "bouc_wen", "dahl")
ANOTHER = """
schema: hdbridge.plan/1
name: another
precondition_deg: 60
reference_s: 0.3
acceleration_deg_s2: 10000000
procedures:
  - {procedure: stepping, count: 6, step_deg: 97}
  - {procedure: sweep, motor_turns: 3, motor_turns_per_s: 2}
  - {procedure: sines, amplitudes_deg: [20], frequency_hz: 6, periods: 8}
"""
CHANGES: dict[str, tuple[str, Callable[[Truth], dict[str, float]]]] = {
    "friction doubled": ("friction", lambda t: {"Coulomb friction": 2.0 * t.motor.coulomb_nm}),
    "load inertia x 1.5": ("load inertia", lambda t: {"load inertia": 1.5 * t.load_.inertia_kg_m2}),
    "servo detuned": ("servo gains", lambda t: {"position gain": 0.6 * t.servo.position_gain_per_s}),
    "1 ms of delay": ("servo dead time", lambda t: {"servo dead time": t.servo.dead_time_ms + 1.0}),
    "spring 30 % softer": (
        "gear stiffness",
        lambda t: {"gear stiffness": 0.7 * t.gear.stiffness_nm_per_rad},
    ),
    "warmer gear": ("warmth", lambda t: {"temperature": t.temperature.ambient_c + 15.0}),
}
"""Cause that should be reported, and changed values of the plant, by name of the change."""
PAIRS = 3
"""Number of pairs of changes drawn for each axis."""
WINDOWS = 3.0
"""Ratio of the allowed following error to the one that the delay causes at the highest speed; `hdbridge
doctor` suggests three times the observed one."""
GAIN_MARGIN = 2.0
"""Minimum gain margin: 6 dB, the usual textbook minimum for loop tuning."""


@dataclass
class Outcome:
    seed: int
    about: str
    channels: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Differences on the other motion, relative to the measured signal and to its noise, by channel."""
    held: int = 0
    intervals: int = 0
    missed: list[str] = field(default_factory=list)
    fit_s: float = 0.0
    checks: list[tuple[str, set[str], set[str]]] = field(default_factory=list)
    """Change of the plant, causes that should be reported, and reported causes of each check."""


def draw(seed: int) -> tuple[AxisConfig, Truth]:
    """Draws a random axis."""
    rng = np.random.default_rng(seed)

    def some() -> float:
        """Draws a factor from one half to two."""
        return float(np.exp(rng.uniform(math.log(0.5), math.log(2.0))))

    ratio = float(rng.integers(60, 321)) / 2.0
    data = yaml.safe_load((DEMO / "axis.yaml").read_text())
    data["name"] = f"random-{seed}"
    data["gear"] = {"ratio": ratio}
    for name in ("velocity_deg_s", "acceleration_deg_s2", "jerk_deg_s3"):
        data["limits"][name] *= 50.0 / ratio
    axis = AxisConfig.from_text(yaml.safe_dump(data), DEMO / "axis.yaml")
    usual_servo = default_truth(axis).servo.model_dump()
    truth = default_truth(axis).model_dump(by_alias=True, exclude_none=True)
    motor, servo, gear, load = truth["motor"], truth["servo"], truth["gear"], truth["load"]
    for name in ("inertia_kg_m2", "coulomb_nm", "viscous_nm_s_per_rad"):
        motor[name] *= some()
    for name in (
        "position_gain_per_s", "velocity_gain_nm_s_per_rad", "integral_time_ms", "command_filter_ms",
        "inertia_feedforward_kg_m2", "viscous_feedforward_nm_s_per_rad", "friction_feedforward_nm",
    ):  # fmt: skip
        servo[name] *= some()
    servo["load_feedforward"]["inertia_kg_m2"] *= some()
    servo["dead_time_ms"] = float(rng.uniform(0.0, 3.0))
    load["inertia_kg_m2"] *= some()
    turn = math.tau * float(np.exp(rng.uniform(math.log(15.0), math.log(80.0))))
    gear["stiffness_nm_per_rad"] = load["inertia_kg_m2"] * turn**2
    gear["damping_nm_s_per_rad"] = 2.0 * float(rng.uniform(0.03, 0.2)) * load["inertia_kg_m2"] * turn
    load["encoder"]["noise_arcsec"] = float(rng.uniform(0.3, 2.0))
    gear["hysteresis"] = _law(LAWS[seed % len(LAWS)], rng)
    gear["motor_orders"] = drawn_orders(rng, 5)
    # An explicit reference, because by default the friction would depend on the ambient temperature.
    truth.setdefault("temperature", {}).update(friction_growth_per_k=-0.015, reference_c=22.0)
    while _gain_margin(truth) < GAIN_MARGIN:
        for name in ("position_gain_per_s", "velocity_gain_nm_s_per_rad", "integral_time_ms"):
            servo[name] = usual_servo[name] * some()
    servo["load_feedforward"]["frequency_hz"] *= some()
    needed_ms = 2.0 * servo["command_filter_ms"] + servo["dead_time_ms"]
    window_deg = WINDOWS * 1e-3 * needed_ms * axis.limits.velocity_deg_s * ratio
    drive = axis.drive.model_copy(
        update={"following_error_deg": max(window_deg, axis.drive.following_error_deg)}
    )
    return axis.model_copy(update={"drive": drive}), Truth.model_validate(truth)


def _gain_margin(truth: dict[str, Any]) -> float:
    """Returns the factor by which the velocity gain may fall or rise before the loops become unstable.

    The lower limit is the stability limit of a rigid axis (Routh), the upper one that of the motor alone: the
    loop uses the mean speed of the previous substep, which limits the gain to two inertias per substep.
    """
    servo, motor, ratio = truth["servo"], truth["motor"], truth["gear"]["ratio"]
    gain, inertia = servo["velocity_gain_nm_s_per_rad"], motor["inertia_kg_m2"]
    whole = inertia + truth["load"]["inertia_kg_m2"] / ratio**2
    position, integral = servo["position_gain_per_s"], 1e3 / servo["integral_time_ms"]
    least = whole / (1.0 / position + 1.0 / integral)
    most = 2.0 * inertia / (1e-3 * truth["substep_ms"])
    return float(min(gain / least, most / gain))


def _law(law: str, rng: np.random.Generator) -> dict[str, Any]:
    offset, width = float(rng.uniform(15.0, 80.0)), float(rng.uniform(5.0, 40.0))
    if law == "maxwell_slip":
        shares = ((0.4, 0.2), (0.35, 0.5), (0.25, 1.0))
        return {
            "law": law,
            "elements": [{"limit_arcsec": offset * a, "yield_deg": width * b} for a, b in shares],
        }
    if law == "rolling_friction":
        exponent = float(rng.uniform(1.2, 2.6))
        return {"law": law, "offset_arcsec": offset, "width_deg": width, "exponent": exponent}
    return {"law": law, "offset_arcsec": offset, "yield_deg": width / 3.0}


def usual(axis: AxisConfig, truth: Truth) -> Truth:
    """Returns the start of the fit: usual values with the gear's true transmission error."""
    start = default_truth(axis)
    known = {"motor_orders": truth.gear.motor_orders, "hysteresis": truth.gear.hysteresis}
    return start.model_copy(
        update={
            "gear": start.gear.model_copy(update=known),
            "temperature": start.temperature.model_copy(
                update={
                    "friction_growth_per_k": truth.temperature.friction_growth_per_k,
                    "reference_c": truth.temperature.reference_c,
                }
            ),
        }
    )


def without_noise(truth: Truth) -> Truth:
    """Removes the encoder noise, so that a comparison contains only the noise of the measurement."""
    encoder = truth.load_.encoder.model_copy(update={"noise_arcsec": 0.0})
    return truth.model_copy(update={"load_": truth.load_.model_copy(update={"encoder": encoder})})


def bench(axis: AxisConfig, truth: Truth, plan: Plan, seed: int) -> Recording:
    """Runs a plan on the simulated drive."""
    with simulated(axis, truth, seed) as (drive, _):
        return recorded(drive, plan)


def both_motions(seed: int, axis: AxisConfig, truth: Truth) -> tuple[Recording, Recording] | None:
    """Records an axis on both plans; returns None if its drive cannot follow them and stops."""
    another = Plan.model_validate(yaml.safe_load(ANOTHER))
    try:
        return bench(axis, truth, Plan.load("dynamics"), seed), bench(axis, truth, another, seed + 1000)
    except SafetyStop as stop:
        print(f"{seed:4d} left out: {stop}", flush=True)
        return None


def one(
    seed: int,
    axis: AxisConfig,
    truth: Truth,
    recording: Recording,
    other: Recording,
    *,
    checks: bool,
    workers: int,
) -> Outcome:
    """Fits a twin and judges it on the other motion, by its intervals and, with ``checks``, by changes."""
    began_s = time.perf_counter()
    twin = fit_twin([recording], axis, usual(axis, truth), workers=workers)
    law = truth.gear.hysteresis.law if truth.gear.hysteresis else "none"
    about = (
        f"N {truth.gear.ratio:5.1f} {truth.load_frequency_hz:4.1f} Hz "
        f"{truth.servo.dead_time_ms:3.1f} ms {law:16s}{_saturated(recording, axis)}"
    )
    found = Outcome(seed, about, fit_s=time.perf_counter() - began_s)
    again = replay(other, axis, without_noise(twin.truth), seed + 2000)
    told = compare(other.record, again, other.segments, axis.gear.ratio)
    for name in ("following_error", "motor_torque", "load_error", "settling_time"):
        row = told.row(name)
        if row is not None:
            found.channels[name] = (row.share, row.in_noise)
    for name, each in BY_NAME.items():
        interval = twin.truth.intervals.get(each.path)
        true = value_in(truth, each)
        if interval is not None and true is not None:
            found.intervals += 1
            held = interval[0] <= true <= interval[1]
            found.held += held
            if not held:
                found.missed.append(f"{name} {true:.3g} not in {interval[0]:.3g}..{interval[1]:.3g}")
    if checks:
        for what, causes, changed in changed_plants(truth, seed):
            try:
                again = bench(patient(axis), changed, Plan.load("dynamics"), seed + 3000)
            except SafetyStop as stop:
                print(f"{seed:4d} {what} left out: {stop}", flush=True)
                continue
            answer = check(again, axis, twin.truth, workers=workers)
            found.checks.append((what, causes, {each.cause for each in answer.changes}))
    return found


def _saturated(recording: Recording, axis: AxisConfig) -> str:
    """Returns a remark if the drive reaches its torque limit, at which control loops and load oscillate."""
    most_nm = 0.01 * axis.limits.torque_percent * axis.drive.rated_torque_nm
    share = float(np.mean(np.abs(recording.record.columns["motor_torque_nm"]) > 0.99 * most_nm))
    return f" {share:.1%} at the torque limit" if share else ""


def patient(axis: AxisConfig) -> AxisConfig:
    """Returns the axis with twice the allowed following error, for changes that increase its lag."""
    drive = axis.drive.model_copy(update={"following_error_deg": 2.0 * axis.drive.following_error_deg})
    return axis.model_copy(update={"drive": drive})


def changed_plants(truth: Truth, seed: int) -> Iterator[tuple[str, set[str], Truth]]:
    """Yields the unchanged plant, each change alone, and some pairs."""
    pairs = list(combinations(CHANGES, 2))
    drawn = np.random.default_rng(seed + 4000).choice(len(pairs), PAIRS, replace=False)
    for names in ((), *((name,) for name in CHANGES), *(pairs[place] for place in drawn)):
        values = {key: value for name in names for key, value in CHANGES[name][1](truth).items()}
        plant = with_values(truth, values) if values else truth
        yield " + ".join(names) or "nothing", {CHANGES[name][0] for name in names}, plant


def line(each: Outcome) -> str:
    """Returns the output line of one axis."""
    parts = [
        f"{name.split('_')[0]} {share:.3f} {noise:.2f}" for name, (share, noise) in each.channels.items()
    ]
    told = " | ".join(parts)
    return f"{each.seed:4d} {each.about} | {told} | {each.held}/{each.intervals} | {each.fit_s:.0f} s"


def main() -> None:
    given = parser(__doc__, axes=20, workers=2)
    given.add_argument("--checks", action="store_true", help="change the plants, and check the twins")
    options = given.parse_args()
    print(
        "on another motion: difference / measured, difference / noise; intervals that hold; time of the fit"
    )
    found = []
    for seed in seeds(options):
        drawn = draw(seed)
        both = both_motions(seed, *drawn)
        if both is None:
            continue
        each = one(seed, *drawn, *both, checks=options.checks, workers=options.workers)
        found.append(each)
        print(line(each), flush=True)
        for miss in each.missed:
            print(f"       {miss}")
        for what, causes, named in each.checks:
            verdict = "ok" if causes == named else "WRONG" if named else "silent"
            print(f"       {what}: {', '.join(sorted(named)) or 'nothing'} [{verdict}]", flush=True)
    for name in ("following_error", "motor_torque"):
        good = [o.channels[name][0] <= 0.10 or o.channels[name][1] <= 1.3 for o in found]
        print(f"{name} within 10 % or 1.3 x noise: {proportion(sum(good), len(good))}")
    settled = [o.channels["settling_time"] for o in found if "settling_time" in o.channels]
    for what, good in (
        ("10 %", [off <= 0.10 for off, _ in settled]),
        ("10 % or 1.3 x noise", [off <= 0.10 or noise <= 1.3 for off, noise in settled]),
    ):
        print(f"settling time within {what}: {proportion(sum(good), len(good))}")
    near = [o.channels["load_error"][1] <= 1.3 for o in found]
    print(f"load error within 1.3 x noise: {proportion(sum(near), len(near))}")
    held, intervals = sum(o.held for o in found), sum(o.intervals for o in found)
    print(f"intervals that hold the truth: {proportion(held, intervals)}")
    cases = [case for o in found for case in o.checks]
    for what, some in (
        ("one change named, and nothing else", [c for c in cases if len(c[1]) == 1]),
        ("nothing changed, silent", [c for c in cases if not c[1]]),
        ("two changes named, and nothing else", [c for c in cases if len(c[1]) == 2]),
    ):
        if some:
            print(f"{what}: {proportion(sum(c[1] == c[2] for c in some), len(some))}")
            among = sum(c[1] <= c[2] for c in some)
            print(f"    what changed is among the named: {proportion(among, len(some))}")


if __name__ == "__main__":
    sys.exit(main())
