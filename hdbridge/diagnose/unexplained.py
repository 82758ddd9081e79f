"""What is left when no cause fits: how much, and what it depends on.

Non-parametric rivals that know nothing of causes (bins over load angle and direction, motor angle and
direction, time, travel since the last reversal, speed, torque, temperature) are fitted on every other stretch
of time and judged on the rest. Where the best of them takes a good deal away, there something is that the
catalogue does not have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from hdbridge.diagnose.holdout import stretches
from hdbridge.diagnose.result import Finding
from hdbridge.effects import BoolArray, FloatArray, IntArray, Part
from hdbridge.effects.kinematics import direction_of
from hdbridge.effects.path import since_reversal_deg
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.scales import Scales
from hdbridge.estimation.stretches import of_length
from hdbridge.units import DEG_PER_TURN

BLOCK_S = 0.2
EPISODES = 30
"""Stretches that a record is cut into, to see whether what is left is left everywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What is left."""

    arcsec: float
    """Root mean square beyond the noise, over short blocks."""
    fast_arcsec: float
    """The same over all points: what is too fast for short blocks as well."""
    standing_arcsec: float
    """The same at rest only; 0 where it never rests."""
    lives_in: str
    """Where most of it is; empty where nothing in particular."""
    explained_arcsec: float
    """Root mean square of what the best rival takes away on data it has not seen."""
    place: FloatArray
    """Abscissa of the picture, in the unit that `lives_in` says."""
    curve_arcsec: FloatArray
    shares: dict[str, float]
    """Of each rival: held-out share of the rest's variance."""


def rest(estimator: Estimator, fitted: Fitted) -> Rest:
    """Look at a residual."""
    residual = fitted.residual / estimator.weight
    arcsec = beyond_noise(estimator, residual)
    best = ("", 0.0, np.empty(0), np.empty(0))
    shares: dict[str, float] = {}
    odd = stretches(estimator) % 2 == 1
    smooth = _smoothed(estimator, residual)
    variance = float(np.mean(smooth**2)) + 1e-12
    for name, number, places in _coordinates(estimator):
        gain, curve = _gain(smooth, number, odd, len(places))
        shares[name] = max(gain / variance, 0.0)
        if gain > best[1]:
            best = (name, gain, places, curve)
    return Rest(
        arcsec,
        float(np.sqrt(max(float(np.mean(residual**2 - 1.0 / estimator.weight**2)), 0.0))),
        _standing(estimator, residual),
        best[0] or "time",
        float(np.sqrt(best[1])),
        best[2],
        best[3],
        shares,
    )


def is_unexplained(estimator: Estimator, left: Rest) -> bool:
    """Whether more is left than nobody need explain."""
    data, scales = estimator.data, estimator.scales
    # An axis rests anywhere within a count of its motor encoder, and noise wanders; nobody can explain
    # that.
    counts = data.motor_count_arcsec / np.sqrt(12.0)
    limit = float(np.hypot(scales.left_arcsec, 0.0 if data.commanded else counts))
    if left.arcsec > limit and left.explained_arcsec > 0.5 * scales.left_arcsec:
        return True
    # Where command and standstill distinguish noise and following error from the gear, fast things count.
    if data.commanded and data.standstill:
        floor = float(np.sqrt(np.mean(1.0 / estimator.weight**2)))
        if left.fast_arcsec > max(scales.fast_arcsec, floor) + left.standing_arcsec / 3.0:
            return True
    return bool(left.arcsec > np.linalg.norm((scales.plain_arcsec, counts, left.standing_arcsec)))


def many_of_one(findings: Sequence[Finding], scales: Scales) -> list[Finding] | None:
    """Several near-equal picks of one kind, more than usual: sidebands of something that is none of them."""
    for family in {each.cause for each in findings}:
        same = [each for each in findings if each.cause == family]
        kinds = [each.effect for each in same if each.effect is not None and not each.within]
        if not kinds or kinds[0].usual == 1:
            continue
        sizes = [piece.bound_arcsec() for each in kinds for piece in each.pieces()]
        if sum(each > scales.near * max(sizes) for each in sizes) > kinds[0].usual:
            return same
    return None


def without_doubtful_loops(
    findings: list[Finding], left: Rest, scales: Scales
) -> tuple[list[Finding], list[str]]:
    """Without a change of the loop's parameters that does less than what is left, unless that is the loop's
    too.
    """
    doubtful = [
        each
        for each in findings
        if each.within
        and each.effect is not None
        and each.effect.changes is Part.LOOP
        and each.effect.part is not Part.LOOP
        and "last reversal" not in left.lives_in
        and each.taken_arcsec**2 < scales.shadow * left.arcsec**2
    ]
    words = [f"{each.cause}: does less than what is left unexplained" for each in doubtful]
    return [each for each in findings if each not in doubtful], words


def elsewhere(estimator: Estimator, residual: FloatArray) -> BoolArray:
    """The points outside the tenth of the record's stretches in which most is left, shape (m,).

    What is left in one episode, say in small swings of a motor that sticks where it turns, casts no
    shadow on what is seen everywhere else. Without reversals an episode is a place, and all points count.
    """
    if estimator.data.reversals < 2:
        return np.ones(len(residual), dtype=np.bool_)
    number = np.floor(EPISODES * np.arange(len(residual)) / len(residual)).astype(np.intp)
    left = np.bincount(number, residual**2 * estimator.weight**2)
    return np.asarray(~np.isin(number, np.argsort(left)[-EPISODES // 10 :]))


def acts(estimator: Estimator, fitted: Fitted, place: int) -> BoolArray:
    """The points at which an effect is a good part of what it can be, shape (m,)."""
    effect = fitted.hypothesis.effects[place]
    values = estimator.columns(effect, fitted.hypothesis.start) @ effect.coefficients()
    values = np.abs(values - np.median(values))
    return np.asarray(values > estimator.scales.acts * float(np.quantile(values, 0.998)))


def beyond_noise(estimator: Estimator, residual: FloatArray, rows: BoolArray | slice = slice(None)) -> float:
    """Root mean square over blocks of `BLOCK_S`, less what white noise leaves there, arcsec."""
    time_s, residual, weight = estimator.time_s[rows], residual[rows], estimator.weight[rows]
    number = of_length(time_s, BLOCK_S)
    count = np.bincount(number)
    mean = np.bincount(number, residual) / count
    white = np.bincount(number, 1.0 / weight**2) / count**2
    return float(np.sqrt(max(float(np.mean(mean**2 - white)), 0.0)))


def _standing(estimator: Estimator, residual: FloatArray) -> float:
    """What moves from one short block to the next while the axis rests: no physics, but noise that
    wanders.
    """
    speed = estimator.motion.motor_speed_deg_s
    if speed is None:
        return 0.0
    still = (speed == 0.0)[estimator.index]
    if np.count_nonzero(still) < 50:
        return 0.0
    number = np.floor((estimator.time_s[still] - estimator.time_s[0]) / BLOCK_S).astype(np.intp)
    names, number = np.unique(number, return_inverse=True)
    mean = np.bincount(number, residual[still]) / np.bincount(number)
    step = np.diff(mean)[np.diff(names) == 1]
    return float(np.median(np.abs(step))) * 1.05 if len(step) else 0.0


def _smoothed(estimator: Estimator, residual: FloatArray) -> FloatArray:
    period = estimator.data.period_s * len(estimator.data.full) / len(estimator.data.points)
    return np.asarray(uniform_filter1d(residual, max(1, round(0.1 / period))))


def _gain(values: FloatArray, number: IntArray, odd: BoolArray, bins: int) -> tuple[float, FloatArray]:
    """Mean square that bin means from one half take away in the other, both ways round; and the bin means."""
    before = after = 0.0
    for train in (odd, ~odd):
        count = np.bincount(number[train], minlength=bins)
        mean = np.bincount(number[train], values[train], bins) / (count + 2.0)
        test = values[~train]
        before += float(np.sum(test**2))
        after += float(np.sum((test - mean[number[~train]]) ** 2))
    count = np.bincount(number, minlength=bins)
    curve = np.bincount(number, values, bins) / np.maximum(count, 1)
    return (before - after) / len(values), np.asarray(curve)


def _coordinates(estimator: Estimator) -> Iterator[tuple[str, IntArray, FloatArray]]:
    """Name, bin of each point, and the middle of each bin."""
    motion, index = estimator.motion, estimator.index
    motor = motion.motor_deg[index]
    load = motor / estimator.data.ratio
    direction = direction_of(motion)[index]
    back = (direction < 0).astype(np.intp)
    for name, angle, bins in (
        ("motor angle", np.mod(motor, DEG_PER_TURN), 72),
        ("load angle", np.mod(load, DEG_PER_TURN), 360),
    ):
        number = np.minimum((angle * (bins / DEG_PER_TURN)).astype(np.intp), bins - 1)
        middle = np.asarray((np.arange(bins) + 0.5) * (DEG_PER_TURN / bins), dtype=np.float64)
        yield name, number, middle
        yield f"{name} and direction", number + bins * back, np.tile(middle, 2)
    if float(np.ptp(load)) > 0.0:
        yield "position", *_ranged(load, 400)
    yield "time", *_ranged(estimator.time_s, 200, alternate=True)
    since = since_reversal_deg(motion.motor_deg)[index]
    number, middle = _ranged(np.log10(since + 0.05), 40)
    angles = np.asarray(np.power(10.0, middle) - 0.05, dtype=np.float64)
    yield "motor angle since the last reversal", number + 40 * back, np.tile(angles, 2)
    speed = motion.motor_speed_deg_s
    if speed is not None:
        yield ("speed", *_quantiles(speed[index], 40))
        yield "time since the last stop or start", *_ranged(np.log10(_since_change(estimator) + 0.02), 40)
    if motion.motor_acceleration_deg_s2 is not None:
        yield "acceleration", *_quantiles(motion.motor_acceleration_deg_s2[index], 40)
    for channel, values in motion.measured.items():
        if float(np.ptp(values)) > 0.0:
            yield channel.title, *_quantiles(values[index], 40)


def _ranged(values: FloatArray, bins: int, alternate: bool = False) -> tuple[IntArray, FloatArray]:
    low, span = float(np.min(values)), max(float(np.ptp(values)), 1e-12)
    number = np.minimum(((values - low) / span * bins).astype(np.intp), bins - 1)
    if alternate:  # bins of time that are wider than the stretches that are held out
        number = number // 8
        bins = -(-bins // 8)
    return number, np.asarray(low + (np.arange(bins) + 0.5) * (span / bins), dtype=np.float64)


def _quantiles(values: FloatArray, bins: int) -> tuple[IntArray, FloatArray]:
    edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    if len(edges) < 2:
        return np.zeros(len(values), dtype=np.intp), np.array([float(values[0])])
    number = np.clip(np.searchsorted(edges, values, "right") - 1, 0, len(edges) - 2)
    return number.astype(np.intp), np.asarray(0.5 * (edges[1:] + edges[:-1]))


def _since_change(estimator: Estimator) -> FloatArray:
    motion = estimator.motion
    assert motion.motor_speed_deg_s is not None
    assert motion.time_s is not None
    change = np.flatnonzero(np.diff(np.sign(motion.motor_speed_deg_s), prepend=np.nan) != 0.0)
    last = change[np.searchsorted(change, np.arange(len(motion)), "right") - 1]
    return np.asarray((motion.time_s - motion.time_s[last])[estimator.index])
