"""Verdict on a twin, from its residuals in each channel on held-out legs. Pure.

A fit assumes that the simulated drive can behave like the axis. The residuals show if that is so. Only a twin
that explains every channel has the values of the axis. Any other twin replays the motion, and its values are
those of a different drive with similar motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.comparison import (
    ALL,
    FOLLOWING_ERROR,
    LOAD_ERROR,
    MOTOR_TORQUE,
    TEMPERATURE,
    TITLES,
    Comparison,
    rms,
)
from hdbridge.twin.defaults import default_truth
from hdbridge.twin.misfit import CHANNELS, Data, counted, demand_deg
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE
from hdbridge.twin.result import HELD_OUT, Left, Twin, Values
from hdbridge.units import ARCSEC_PER_DEG, figure

SIGNALS: Final = (LOAD_ERROR, FOLLOWING_ERROR, MOTOR_TORQUE, TEMPERATURE)
LEAST_GAIN: Final = 0.01
"""Minimum reduction of the mean ratio of the differences; smaller ones are due to noise."""
WORSE: Final = 1.1
"""Ratio of the differences after and before above which a signal is worse, if it exceeds its noise."""
DECADE: Final = 10.0
"""Maximum ratio of a motor's inertia to the usual one for its rated torque, and of load and motor inertia
seen by the motor. Servo motors of equal torque differ by a factor of three to five (catalogues)."""
MOST_DEAD_CYCLES: Final = 2.0
"""Maximum dead time in SYNC cycles: one to take over the demand, one to execute it (CiA 402)."""


def what_is_left(
    data: Data, residuals: Mapping[str, FloatArray], noise: Mapping[str, float]
) -> tuple[Left, ...]:
    """Returns the residual of each recorded channel, on held-out legs if there are any.

    ``residuals`` by channel over all rows of the data, ``noise`` by channel in its unit (`noise_in_motion`).
    """
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    signals, found = signals_of(data), []
    for name, counts in counted(data).items():
        held_out = (counts > 0.0) & (data.out > 0.0)
        inside = held_out if held_out.any() else counts > 0.0
        if not inside.any():
            continue
        squares, signal = np.square(residuals[name][inside]), rms(signals[name][inside])
        by_kind = {str(kind): float(squares[kinds[inside] == kind].mean()) for kind in set(kinds[inside])}
        left = math.sqrt(float(squares.mean()))
        share = left / signal if signal else math.inf
        found.append(Left(name, share, left / noise[name], max(by_kind, key=lambda kind: by_kind[kind])))
    return tuple(found)


def signals_of(data: Data) -> dict[str, FloatArray]:
    """Returns the measured signals by channel, in its unit; for the load, its error without the zero."""
    per_motor_deg = ARCSEC_PER_DEG / data.axis.gear.ratio
    found = {name: list[FloatArray]() for name in CHANNELS}
    for piece in data.pieces:
        inside = piece.counts[LOAD] > 0.0
        motor_deg = demand_deg(piece.commands, data.axis) - piece.measured[FOLLOWING]
        error = piece.measured[LOAD] - per_motor_deg * motor_deg
        found[LOAD].append(error - (np.mean(error[inside]) if inside.any() else 0.0))
        for name in (FOLLOWING, TORQUE):
            found[name].append(piece.measured[name])
    return {name: np.concatenate(each) for name, each in found.items()}


def values_of(left: Sequence[Left]) -> Values:
    """Returns the origin of fitted values: the axis if all channels are explained, else a replay."""
    return Values.AXIS if all(each.explained for each in left) else Values.REPLAY


def impossible(truth: Truth, axis: AxisConfig, cycle_s: float) -> tuple[str, ...]:
    """Returns values of a truth that are impossible for this axis file, each in a sentence."""
    motor, servo = truth.motor, truth.servo
    usual = default_truth(axis).motor.inertia_kg_m2
    load = truth.load_.whole_inertia_kg_m2 / axis.gear.ratio**2
    found = []
    for name, value, of, other in (
        ("motor inertia", motor.inertia_kg_m2, usual, "the one usual for its rated torque"),
        ("load inertia seen by the motor", load, motor.inertia_kg_m2, "the motor's"),
    ):
        if not 1.0 / DECADE <= value / of <= DECADE:
            found.append(f"{name} {figure(value, 3)} kg m2; expected within a decade of {other}, {of:.3g}")
    most_rad_s = math.radians(axis.limits.velocity_deg_s * axis.gear.ratio)
    rise = 1.0 + motor.stribeck.rise if motor.stribeck else 1.0
    friction_nm = motor.coulomb_nm * rise + motor.viscous_nm_s_per_rad * most_rad_s
    if servo.friction_feedforward_nm > friction_nm:
        found.append(
            f"friction feed-forward {figure(servo.friction_feedforward_nm, 3)} Nm; expected at most the "
            f"friction, {figure(friction_nm, 3)}"
        )
    most_ms = 1e3 * MOST_DEAD_CYCLES * cycle_s
    if servo.dead_time_ms > most_ms:
        found.append(
            f"dead time {figure(servo.dead_time_ms, 3)} ms; expected at most two cycles, {figure(most_ms, 3)}"
        )
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision to keep a twin or not, with its reason."""

    kept: bool
    text: str
    """Reason in a sentence or two, beginning with the validity of the values."""


def judge(twin: Twin) -> Verdict:
    """Decides if a twin is kept, and states the validity of its values."""
    gain = better(twin.before, twin.after)
    if twin.impossible:
        return Verdict(False, f"the twin is not kept: no axis has these values: {'; '.join(twin.impossible)}")
    if not gain.better:
        return Verdict(False, f"the twin is not kept: {gain.text}")
    kept = f"the twin is kept as pending: {gain.text}"
    return Verdict(True, kept if twin.values is Values.AXIS else f"{replays_only(twin.left)}; {kept}")


def replays_only(left: Sequence[Left]) -> str:
    """Returns the headline of a twin whose values are not the axis's."""
    shown = [f"{each.channel} to {_percent(each.share)}" for each in left]
    lost = [
        f"{each.channel} is left with {figure(each.times_noise, 3)} times its noise"
        for each in left
        if not each.explained
    ]
    replayed = f"the twin replays this drive ({', '.join(shown)})"
    return f"{replayed}, but its values are not the axis's: {'; '.join(lost)}"


def _percent(share: float) -> str:
    return f"{figure(100.0 * share, 2)} %" if math.isfinite(share) else "no share"


@dataclass(frozen=True, slots=True)
class Gain:
    """Improvement by a fit."""

    better: bool
    text: str


def better(before: Comparison, after: Comparison) -> Gain:
    """Compares the rms differences of load error, following error, torque and temperature, if recorded.

    On held-out legs, or on all legs if none was held out.
    """
    kind = HELD_OUT if any(row.kind == HELD_OUT for row in after.rows) else ALL
    where = "on legs that the fit has not seen" if kind == HELD_OUT else "on the legs that it was fitted to"
    pairs = {
        name: (was, now)
        for name in SIGNALS
        if (was := before.row(name, kind)) is not None and (now := after.row(name, kind)) is not None
    }
    # A replay starts at a reading and may be off by a step from there on; smaller differences are equal.
    step_k = max((each.noise for each in pairs.get(TEMPERATURE, ())), default=0.0)
    if max((each.difference for each in pairs.get(TEMPERATURE, ())), default=0.0) <= step_k:
        pairs.pop(TEMPERATURE, None)
    worse = [
        f"{TITLES[name]} differs by {now.difference:.3g} {now.unit}, before by {was.difference:.3g}"
        for name, (was, now) in pairs.items()
        if now.difference > WORSE * was.difference and now.difference > max(now.noise, 1e-12)
    ]
    # Noise is in both differences. Differences below these limits are rounding errors.
    least = {name: step_k if name == TEMPERATURE else 1e-12 for name in pairs}
    ratios = [
        math.log(max(now.difference, least[name]) / max(was.difference, least[name]))
        for name, (was, now) in pairs.items()
    ]
    gain = 1.0 - math.exp(sum(ratios) / len(ratios)) if ratios else 0.0
    if worse:
        return Gain(False, f"{where}, {'; '.join(worse)}")
    if gain < LEAST_GAIN:
        return Gain(False, f"{where} it is no nearer to the axis than the simulation was")
    return Gain(True, f"{where} the differences from the axis are {100.0 * gain:.0f} % smaller in the mean")
