"""What is fitted in addition to the model so that it does not bend it: zeros, and faults of the measurement.

A load encoder that is read later than the motor's looks like hysteresis at one speed. An encoder of whole
counts reads a motor that creeps from count to count, or rests just short of one, wrong by a fraction of a
count *in the direction of motion*: that looks like hysteresis too, and the fraction changes with speed.
Each turn is known to within a count and the way between two samples only (its reach), and a hysteresis that
is narrow or steep cannot be known better than its turns. Each has a column; a fraction of its reach it cannot
exceed. With fine encoders that are read often these columns vanish by themselves. The load on the gear's
spring swings beyond the error that shakes it, the more the faster. Two speeds distinguish that from the
orders' amplitudes; at one speed they are less well known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import pairwise

import numpy as np

from hdbridge.analysis.blocks import AVERAGED_COUNTS_S, LOCKED_COUNTS, Design
from hdbridge.analysis.linear import Nuisances, Prior, solve_symmetric, unknown
from hdbridge.effects import Effect, FloatArray, IntArray
from hdbridge.units import ARCSEC_PER_DEG

DELAY = "delay_ms"
ROUNDING = "rounding"
TURNS = "turns"
SWING = "swing_ms2"
SWING_LAG = "swing_ms3"
TEXTS = {
    DELAY: "the load encoder is read later than the motor's by",
    ROUNDING: "in the direction of its last motion the motor is behind what its encoder says, at rest, by",
    SWING: "the load swings beyond the error that shakes it, by its own acceleration times",
}
UNITS = {DELAY: "ms", ROUNDING: "counts", SWING: "ms\N{SUPERSCRIPT TWO}"}
SWING_MS2 = 25.0
"""Standard deviation beforehand: 1 / (2 pi f)^2 of a load that swings at f = 32 Hz."""
SWING_MS3 = 50.0
"""The same for a damping ratio z of the swing: 2 z / (2 pi f)^3."""
SWING_COUNT_ARCSEC = 2.0
"""With a coarser motor encoder its sawtooth, which differs from speed to speed too, poses as swing."""
MOST_TURNS = 80
SMALLEST_TURN = 1e-3
COUNTS = 0.29
"""Standard deviation that an unknown place within a count, or within the reach of a turn, has."""
SPEEDS_COUNTS_S = (
    0, 25, *range(50, 800, 50), *range(800, 1600, 100), *range(1600, 3200, 200),
    3200, 4800, 6400, 12800, np.inf,
)  # fmt: skip
"""Edges of the classes of speed that round alike; at rest is a class of its own. A drive that is told whole
counts in every cycle, and read in the same cycles, lags by the same fraction of a count as long as its speed
is the same: simulated servos were read wrong by 0.08 to 0.22 counts (rms over speeds) from 300 to 12,000
counts per second. With a lag of 5 ms that goes round with every 200 counts per second; a class is a quarter.
"""
SHARE = 0.1
"""A nuisance of whose column less than this is left by what else is fitted stays out."""


def zeros(zero: IntArray, number: int) -> Nuisances:
    """A column for each of so many absolute zeros; ``zero`` (b,) says which."""
    return unknown(zero[:, np.newaxis] == np.arange(number), [f"zero {each}" for each in range(number)])


def delay_column(design: Design) -> FloatArray:
    """What a load encoder read with a delay of one millisecond would show, shape (b, 1), arcsec."""
    blocks, samples = design.blocks, design.samples
    column = -blocks.speed_deg_s * blocks.moving / samples.ratio * ARCSEC_PER_DEG / 1000.0
    return np.asarray(column)[:, np.newaxis]


def rounding_columns(design: Design) -> tuple[FloatArray, FloatArray]:
    """A count in the direction of motion, arcsec: at rest, per class of speed, and in all of them together.

    Columns (b, classes + 2), and how many counts there may be of each (standard deviations).
    """
    blocks, samples = design.blocks, design.samples
    count_arcsec = samples.count_deg / samples.ratio * ARCSEC_PER_DEG
    rate = np.abs(blocks.speed_deg_s) / max(samples.count_deg, 1e-12)
    share = np.minimum(1.0, AVERAGED_COUNTS_S / np.maximum(rate, 1.0))
    columns = [~blocks.moving, np.where(blocks.moving, share, 1.0)]
    sizes = [LOCKED_COUNTS, COUNTS]
    for low, high in pairwise(SPEEDS_COUNTS_S):
        inside = blocks.moving & (rate >= low) & (rate < high)
        if inside.any():
            columns.append(inside)
            sizes.append(LOCKED_COUNTS)
    against = -blocks.heading * count_arcsec
    return np.stack([against * each for each in columns], axis=1), np.array(sizes)


def turn_columns(design: Design, effects: Sequence[Effect]) -> tuple[FloatArray, list[Prior]]:
    """A column for each turn that matters, shape (b, turns): what its reach further out would change.

    The turn is anywhere within its count, and from where the sample lies to where straight lines meet: it is
    to be expected halfway out.
    """
    change, missed, turn = design.turn_effects(effects)
    weight = np.bincount(turn, design.blocks.count * change**2)
    most = np.argsort(weight)[::-1][:MOST_TURNS]
    chosen = np.sort(most[weight[most] > SMALLEST_TURN * np.max(weight, initial=0.0)])
    out = np.zeros(int(np.max(turn, initial=0)) + 1)
    out[turn] = missed
    deviations = COUNTS * np.hypot(out, 1.0 - 2.0 * out)[chosen]
    prior = list(map(Prior, (0.5 * out[chosen]).tolist(), (deviations**-2).tolist()))
    return np.asarray((turn[:, np.newaxis] == chosen) * change[:, np.newaxis]), prior


def is_turn(name: str) -> bool:
    """Whether a column of this name is one turn's."""
    return name.startswith("turn ")


def swing(
    rate: FloatArray,
    waves: Iterable[tuple[float, FloatArray, FloatArray]],
    mean: Callable[[FloatArray], FloatArray] = lambda columns: columns,
) -> Nuisances:
    """What the load shows beyond waves of the motor angle, arcsec per square and cube of a millisecond.

    ``rate`` (n,) is the motor's, radians per second. ``waves`` are orders, what they contribute, (n,), and
    the same a quarter of a wave later; ``mean`` averages columns (n, 2) as the observations are.
    Driven by a cos(w t) well below its natural frequency f a load on a spring with damping ratio z answers
    with (1 + (w / 2 pi f)^2) a cos(w t) + 2 z (w / 2 pi f)^3 a sin(w t): more, and later both ways.
    """
    columns = np.zeros((len(rate), 2))
    for order, wave, later in waves:
        columns[:, 0] += (1e-3 * order * rate) ** 2 * wave
        columns[:, 1] += (1e-3 * order * rate) ** 3 * later
    known = tuple(Prior(0.0, each**-2) for each in (SWING_MS2, SWING_MS3))
    return Nuisances(mean(columns), (SWING, SWING_LAG), known)


def speeds_differ(speed_deg_s: FloatArray, count: FloatArray) -> bool:
    """Whether more than `SHARE` of the squared speed is left by its mean; ``count`` (n,) samples have each.

    At one speed a swing of the load cannot be distinguished from the orders that shake it.
    """
    squared = speed_deg_s**2
    fourth = float(count @ squared**2)
    return fourth > 0.0 and 1.0 - float(count @ squared) ** 2 / (float(np.sum(count)) * fourth) > SHARE


def nuisances_of(
    design: Design,
    nuisances: Sequence[str],
    effects: Sequence[Effect],
    waves: Sequence[tuple[float, FloatArray, FloatArray]] = (),
) -> Nuisances:
    """Zeros and the nuisances named; ``waves`` as for `swing`."""
    parts = [zeros(design.blocks.zero, design.samples.zeros)]
    if DELAY in nuisances:
        parts.append(unknown(delay_column(design), [DELAY]))
    if ROUNDING in nuisances:
        column, sizes = rounding_columns(design)
        numbered = [f"{ROUNDING} {number}" for number in range(1, len(sizes))]
        known = tuple(Prior(0.0, each**-2.0) for each in sizes.tolist())
        parts.append(Nuisances(column, (ROUNDING, *numbered), known))
    if TURNS in nuisances:
        column, prior = turn_columns(design, effects)
        parts.append(Nuisances(column, tuple(f"turn {each}" for each in range(len(prior))), tuple(prior)))
    if SWING in nuisances and waves:
        rate = np.deg2rad(design.blocks.speed_deg_s * design.blocks.moving)
        parts.append(swing(rate, waves))
    return reduce(Nuisances.and_also, parts)


def share_left(columns: FloatArray, others: FloatArray, weight: FloatArray) -> float:
    """Smallest share of any column's weighted squares that the others do not explain."""
    both = np.concatenate([others, columns], axis=1)
    gram = both.T @ (weight[:, np.newaxis] * both)
    split = others.shape[1]
    cross = gram[:split, split:]
    left = np.diag(gram[split:, split:] - cross.T @ solve_symmetric(gram[:split, :split], cross))
    own = np.maximum(np.diag(gram)[split:], 1e-12)
    return float(np.min(left / own))
