"""Servo structures: fits for drives with loops other than those that a fit assumes first.

The simulated servo is put together from blocks (`hdbridge.sim.servo`). Each fit starts at several bandwidths,
with and without a torque feed-forward, because a servo far from the start is a minimum of its own. Blocks are
then added one at a time, and kept if they reduce what is left of legs that the fit has not seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.motor import TrueNotch
from hdbridge.twin.defaults import VELOCITY_BANDWIDTH_RAD_S, with_sections
from hdbridge.twin.least_squares import Fitted, solve
from hdbridge.twin.misfit import CHANNELS, Data, counted
from hdbridge.twin.noise import noise_in_motion
from hdbridge.twin.parameters import BY_NAME, Parameter, at_coordinates, coordinates, with_values
from hdbridge.twin.regressions import start_of
from hdbridge.twin.replays import Replays
from hdbridge.twin.verdict import signals_of

BANDWIDTHS: Final = ((25.0, 100.0), (80.0, 300.0), (200.0, 800.0))
"""Position gain, 1/s, and velocity gain over the whole inertia, rad/s: a geared axis with a soft load, an
ordinary one, and a stiff one."""
INTEGRALS: Final = ("speed", "position")
"""Signal of the integral: speed error (PI velocity loop) or position error (PIV)."""
INTEGRAL: Final = 3.0
"""Integral time times that bandwidth (symmetric optimum: 2 to 4)."""
FILTER_MS: Final = 0.5
"""Speed and torque filter at the start: half to twice the period of common velocity loops."""
SHORT_MS: Final = 0.1
"""Negligible command filter: a fifth of a substep."""
VELOCITY_FEEDFORWARD: Final = 0.9
"""Start value between none (rare) and the full speed."""
STEP: Final = 0.02
"""Step of the differences, in a parameter's spread."""
FINE: Final = 0.01
"""Share of a channel's signal that is the minimum unit of its misfit."""
BEST: Final = 3
"""Number of starts that are followed up."""
FEW, MORE, MOST = 5, 10, 25
"""Maximum function evaluations of a fit: from each start, of each structure, and over the whole recording."""
GAIN: Final = 0.97
"""Maximum ratio of the misfits with and without a block for keeping it; mere extra parameters gain less."""
MECHANICS: Final = (
    "motor inertia", "Coulomb friction", "viscous friction", "friction's rise at rest", "Stribeck speed",
    "load inertia", "gear stiffness", "gear damping",
)  # fmt: skip
LOOPS: Final = (
    "position gain", "velocity gain", "integral time", "command filter", "velocity feed-forward",
    "servo dead time", "speed filter", "torque filter", "load encoder delay",
)  # fmt: skip
NOTCH: Final = ("notch frequency", "notch depth", "notch width")
PLACES: Final = (0.7, 1.0, 1.4)
"""Start values of the notch frequency, relative to the resonance of motor and load."""


class Structure(NamedTuple):
    """A simulated drive and its parameters to fit."""

    truth: Truth
    parameters: tuple[Parameter, ...]


@dataclass(frozen=True, eq=False)
class Reached:
    """Result of a fit of a structure."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    residuals: dict[str, FloatArray]
    misfit: float
    """Root mean square over the channels in `units`, on held-out legs."""


def fit_structures(
    replays: Replays, begun: Truth, progress: Callable[[float], None] = lambda _: None
) -> Fitted:
    """Finds the structure that explains the recording best, and fits it to the whole recording.

    All starts have the mechanics of the regressions, or else of ``begun``.
    """
    few = replays.rough
    cycle_ms = 1e3 * replays.data.pieces[0].commands.cycle_s
    tried = [least_squares_fit(few, each, FEW) for each in starts(start_of(begun, replays.data), cycle_ms)]
    progress(0.3)
    tried.sort(key=lambda each: each.misfit)
    again = [least_squares_fit(few, Structure(each.truth, each.parameters), MORE) for each in tried[:BEST]]
    best = min(again, key=lambda each: each.misfit)
    progress(0.5)
    added: set[str] = set()
    for _ in range(3):
        found = {
            name: least_squares_fit(few, each, MORE) for name, each in more_blocks(best) if name not in added
        }
        if not found:
            break
        name = min(found, key=lambda each: found[each].misfit)
        if found[name].misfit > GAIN * best.misfit:
            break
        best, added = found[name], added | {name.split()[0]}
        progress(0.5 + 0.1 * len(added))
    end = least_squares_fit(replays, Structure(best.truth, best.parameters), MOST)
    place = np.array(coordinates(end.truth, end.parameters))
    return solve(replays, end.truth, end.parameters, place, 0)


def starts(truth: Truth, cycle_ms: float) -> Iterator[Structure]:
    """Yields the servos at which a fit starts.

    An acceleration feed-forward uses the filtered demand, or differences over whole SYNC cycles, which is a
    moving average of one cycle.
    """
    lag_ms = truth.servo.dead_time_ms + 2.0 * truth.servo.command_filter_ms
    averaged_ms = min(cycle_ms, BY_NAME["moving average"].most)
    averaged = {
        "moving_average_ms": averaged_ms,
        "command_filter_ms": SHORT_MS,
        "dead_time_ms": max(lag_ms - 0.5 * averaged_ms, 0.0),
    }
    whole = truth.motor.inertia_kg_m2 + truth.load_.whole_inertia_kg_m2 / truth.gear.ratio**2
    fastest = VELOCITY_BANDWIDTH_RAD_S.value * truth.motor.inertia_kg_m2
    for gain, rate in BANDWIDTHS:
        for (forward, command), integral in product(((0.0, {}), (whole, {}), (whole, averaged)), INTEGRALS):
            servo = truth.servo.model_copy(
                update={
                    "position_gain_per_s": gain,
                    "velocity_gain_nm_s_per_rad": min(rate * whole, fastest),
                    "integral_of": integral,
                    "integral_time_ms": 1e3 * INTEGRAL / rate,
                    "velocity_feedforward": VELOCITY_FEEDFORWARD,
                    "speed_filter_ms": FILTER_MS,
                    "torque_filter_ms": FILTER_MS,
                    "inertia_feedforward_kg_m2": forward,
                    "load_feedforward": None,
                    "viscous_feedforward_nm_s_per_rad": 0.0,
                    "friction_feedforward_nm": 0.0,
                    **command,
                }
            )
            more = (("inertia feed-forward",) if forward else ()) + (("moving average",) if command else ())
            names = (*MECHANICS, *LOOPS, *more)
            parameters = tuple(BY_NAME[each] for each in names)
            yield Structure(with_sections(truth.model_copy(update={"servo": servo}), parameters), parameters)


def more_blocks(best: Reached) -> Iterator[tuple[str, Structure]]:
    """Yields the servo with one more or a replaced block; the names begin with the block's."""
    truth, servo = best.truth, best.truth.servo
    if servo.notch is None:
        load = truth.load_.whole_inertia_kg_m2
        motor = truth.motor.inertia_kg_m2 * truth.gear.ratio**2
        free_hz = math.sqrt(truth.gear.stiffness_nm_per_rad * (1.0 / load + 1.0 / motor)) / math.tau
        for place in PLACES:
            notch = TrueNotch(frequency_hz=min(place * free_hz, 600.0), depth=0.5, width=0.7)
            notched = servo.model_copy(update={"notch": notch})
            parameters = (*best.parameters, *(BY_NAME[each] for each in NOTCH))
            yield f"notch {place}", Structure(truth.model_copy(update={"servo": notched}), parameters)
    if servo.moving_average_ms == 0.0:
        lag_ms = min(max(2.0 * servo.command_filter_ms, 0.5), 3.0)
        averaged = servo.model_copy(update={"moving_average_ms": 2.0 * lag_ms, "command_filter_ms": SHORT_MS})
        parameters = (*best.parameters, BY_NAME["moving average"])
        yield "average", Structure(truth.model_copy(update={"servo": averaged}), parameters)
    if servo.friction_feedforward_nm == 0.0:
        with_friction = with_values(truth, {"friction feed-forward": 0.3 * truth.motor.coulomb_nm})
        yield "friction", Structure(with_friction, (*best.parameters, BY_NAME["friction feed-forward"]))


def least_squares_fit(replays: Replays, start: Structure, evaluations: int) -> Reached:
    """Fits a structure with `scipy.optimize.least_squares`, each channel in `units`."""
    data, parameters = replays.data, start.parameters
    spread = np.array([each.spread for each in parameters])
    low, high = np.array([each.bounds for each in parameters]).T
    prior = np.clip(coordinates(start.truth, parameters), low, high)
    scale, rows = units(data), seen(data)

    def led(places: Sequence[FloatArray]) -> list[dict[str, FloatArray]]:
        return replays([at_coordinates(start.truth, parameters, each.tolist()) for each in places])

    def vector(found: dict[str, FloatArray]) -> FloatArray:
        return np.concatenate([found[name][rows[name]] / scale[name] for name in CHANNELS])

    def residuals(place: FloatArray) -> FloatArray:
        (found,) = led([place])
        return np.concatenate([vector(found), (place - prior) / spread])

    def slopes(place: FloatArray) -> FloatArray:
        steps = np.where(place + STEP * spread > high, -STEP, STEP) * spread
        here, *there = led([place, *(place + step for step in np.diag(steps))])
        now = vector(here)
        table = [(vector(each) - now) / step for each, step in zip(there, steps, strict=True)]
        return np.concatenate([np.stack(table, axis=1), np.diag(1.0 / spread)])

    inside = np.clip(prior, low + 1e-9, high - 1e-9)
    found = least_squares(
        residuals, inside, slopes, (low, high), x_scale=spread, max_nfev=evaluations, ftol=2e-4, xtol=1e-4
    )
    truth = at_coordinates(start.truth, parameters, found.x.tolist())
    (left,) = replays([truth])
    return Reached(truth, parameters, left, misfit(data, left))


def units(data: Data) -> dict[str, float]:
    """Returns a hundredth of the signal, or the noise if larger, by channel, in its unit."""
    noise, counts, found = noise_in_motion(data), counted(data), {}
    for name, signal in signals_of(data).items():
        inside = counts[name] > 0.0
        rms = math.sqrt(float(np.mean(np.square(signal[inside])))) if inside.any() else 0.0
        found[name] = max(noise[name], FINE * rms)
    return found


def seen(data: Data) -> dict[str, NDArray[np.bool_]]:
    """Returns the mask of the rows that a fit sees, by channel."""
    return {name: (each > 0.0) & (data.out == 0.0) for name, each in counted(data).items()}


def misfit(data: Data, left: dict[str, FloatArray]) -> float:
    """Returns the root mean square over the channels in `units`, on held-out legs if there are any."""
    scale, squares = units(data), []
    for name, counts in counted(data).items():
        held_out = (counts > 0.0) & (data.out > 0.0)
        inside = held_out if held_out.any() else counts > 0.0
        if inside.any():
            squares.append(float(np.mean(np.square(left[name][inside] / scale[name]))))
    return math.sqrt(sum(squares) / len(squares))
