"""Nuisance columns, fitted so that measurement errors do not bias the model.

Delay: at a single speed, a delay of the load encoder looks like hysteresis.

Rounding: if a motor creeps from count to count, or rests just short of a count, its reading is wrong by a
fraction of a count *in the direction of motion*. This error also looks like hysteresis, and depends on speed.

Turning points: each is known only to within a count and the travel between two samples (its reach). A narrow
or steep hysteresis is known only as accurately as its turning points. The coefficient of a turning point's
column is a bounded fraction of its reach. With fine encoders and fast sampling these columns vanish.

Load oscillation: the load on the gear's spring amplifies the error that excites it, more at higher speed. It
is separable from the orders if there are two speeds. At a single speed the amplitudes are less certain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import pairwise

import numpy as np

from hdbridge.analysis.blocks import AVERAGED_COUNTS_S, LOCKED_COUNTS, Design
from hdbridge.analysis.linear import Nuisances, Prior, solve_symmetric, unknown
from hdbridge.axis.effects import Effect, FloatArray, IntArray
from hdbridge.units import ARCSEC_PER_DEG

DELAY = "delay_ms"
ROUNDING = "rounding"
TURNS = "turns"
SWING = "swing_ms2"
SWING_LAG = "swing_ms3"
TEXTS = {
    DELAY: "delay of the load encoder's samples relative to the motor encoder's",
    ROUNDING: "lag of the motor behind its reading at rest, in the direction of its last motion",
    SWING: "oscillation of the load beyond the error that excites it, per acceleration of the load",
}
UNITS = {DELAY: "ms", ROUNDING: "counts", SWING: "ms\N{SUPERSCRIPT TWO}"}
SWING_MS2 = 25.0
"""Prior standard deviation of the load oscillation: 1 / (2 pi f)^2 for a load with natural frequency
f = 32 Hz."""
SWING_MS3 = 50.0
"""Prior standard deviation of the oscillation's damping term, 2 z / (2 pi f)^3, with damping ratio z."""
SWING_COUNT_ARCSEC = 2.0
"""Upper limit of a motor count, referred to the load, for which the load oscillation is fitted. The sawtooth
error of a coarser encoder also depends on speed and looks like an oscillation."""
MOST_TURNS = 80
SMALLEST_TURN = 1e-3
COUNTS = 0.29
"""Standard deviation of a uniform distribution over a count or a turning point's reach, relative to that
range."""
SPEEDS_COUNTS_S = (
    0, 25, *range(50, 800, 50), *range(800, 1600, 100), *range(1600, 3200, 200),
    3200, 4800, 6400, 12800, np.inf,
)  # fmt: skip
"""Edges of the speed classes, counts per second. Within a class the rounding error is constant; rest is a
separate class. If a drive receives and returns whole counts in the same cycles, it lags by a constant
fraction of a count at constant speed. In simulated servos, the reading error is 0.08 to 0.22 counts (rms over
speeds) from 300 to 12,000 counts per second. With a lag of 5 ms the error repeats every 200 counts per
second; a class is a quarter of this."""
SHARE = 0.1
"""Minimum fraction of a nuisance column's sum of squares that other columns leave unexplained; below it, the
nuisance is omitted."""


def zeros(zero: IntArray, number: int) -> Nuisances:
    """Returns a zero-offset column for each encoder zero; ``zero`` (b,) is the zero number of each block."""
    return unknown(zero[:, np.newaxis] == np.arange(number), [f"zero {each}" for each in range(number)])


def delay_column(design: Design) -> FloatArray:
    """Returns the error due to a load encoder delay of one millisecond, shape (b, 1), arcsec."""
    blocks, samples = design.blocks, design.samples
    column = -blocks.speed_deg_s * blocks.moving / samples.ratio * ARCSEC_PER_DEG / 1000.0
    return np.asarray(column)[:, np.newaxis]


def rounding_columns(design: Design) -> tuple[FloatArray, FloatArray]:
    """Returns rounding-error columns, arcsec per count, and their prior standard deviations, counts.

    The columns, shape (b, classes + 2), belong to rest, all motion, and each speed class. They have the sign
    of an error in the direction of motion.
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
    """Returns a column for each relevant turning point, shape (b, turns), and the priors of the coefficients.

    A column is the change of the error if the turning point lies further out by its reach. A turning point
    lies anywhere within its count, and between its sample and the intersection of straight lines through the
    neighbouring samples; its expected position is halfway.
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
    """Returns True if a column of this name belongs to a turning point."""
    return name.startswith("turn ")


def swing(
    rate: FloatArray,
    waves: Iterable[tuple[float, FloatArray, FloatArray]],
    mean: Callable[[FloatArray], FloatArray] = lambda columns: columns,
) -> Nuisances:
    """Returns two columns of the load oscillation beyond its exciting waves, arcsec/ms^2 and arcsec/ms^3.

    ``rate`` (n,) is the motor speed, radians per second. ``waves`` contains, for each order, the order, its
    contribution (n,), and its contribution a quarter period later. ``mean`` averages columns (n, 2) like the
    observations. A load on a spring with natural frequency f and damping ratio z responds to a cos(w t), well
    below f, with (1 + (w / 2 pi f)^2) a cos(w t) + 2 z (w / 2 pi f)^3 a sin(w t). The response is larger than
    the excitation and lags in both directions.
    """
    columns = np.zeros((len(rate), 2))
    for order, wave, later in waves:
        columns[:, 0] += (1e-3 * order * rate) ** 2 * wave
        columns[:, 1] += (1e-3 * order * rate) ** 3 * later
    known = tuple(Prior(0.0, each**-2) for each in (SWING_MS2, SWING_MS3))
    return Nuisances(mean(columns), (SWING, SWING_LAG), known)


def speeds_differ(speed_deg_s: FloatArray, count: FloatArray) -> bool:
    """Returns True if the speeds differ enough to separate the load oscillation from the exciting orders.

    More than the fraction `SHARE` of the squared speed's sum of squares must remain after a fit of its mean.
    ``count`` (n,) weights the speeds.
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
    """Returns the columns of the zero offsets and of the named nuisances; for ``waves`` see `swing`."""
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
    """Returns the smallest fraction of a column's weighted sum of squares that ``others`` do not explain."""
    both = np.concatenate([others, columns], axis=1)
    gram = both.T @ (weight[:, np.newaxis] * both)
    split = others.shape[1]
    cross = gram[:split, split:]
    left = np.diag(gram[split:, split:] - cross.T @ solve_symmetric(gram[:split, :split], cross))
    own = np.maximum(np.diag(gram)[split:], 1e-12)
    return float(np.min(left / own))
