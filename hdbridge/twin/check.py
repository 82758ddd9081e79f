"""What has changed since a twin was made: a new recording against its replay, named cause by cause.

All parameters are fitted together, each held to where the twin has it as closely as the twin can be trusted.
Those that are drawn from there by more than chance are set free, with all of their cause, and so are those
that explain most when they are moved alone. Then one cause after the other has to earn its place next to the
rest: it has to have moved by more than the new recording and the twin leave open, and by as much as matters,
and what would make up for it has to be less likely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy.special import chdtrc

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.fitting import free_parameters
from hdbridge.twin.least_squares import SOFT, Fitted, fitted_rows, legs_of_rows, over_legs, solve, told
from hdbridge.twin.misfit import CHANNELS, Data, coarse, counted, prepare, rounding
from hdbridge.twin.naming import FALSE_ALARM, Finding, Moved, finding, told_apart
from hdbridge.twin.noise import Scales, least_deviation, noise_floor
from hdbridge.twin.parameters import BY_NAME, Parameter, at_coordinates, coordinates
from hdbridge.twin.replays import Replays
from hdbridge.twin.result import Values

# ----------------------------------------------------------------
# How sure a change against a twin is: by the new recording, and by what the twin's own recordings left open.

Misfit = Mapping[str, Mapping[str, float]]
"""By channel, in its unit, and kind of leg: rms of what a replay leaves of the recording."""
STRAY = 4.0
"""A sample that leaves more than this times the rms of its kind counts as that: a motor that breaks away at a
different time is no change of the axis."""


def misfit_of(data: Data, residuals: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """What residuals leave of each recorded channel, by kind of leg."""
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    found: dict[str, dict[str, float]] = {}
    for name, counts in counted(data).items():
        for kind in dict.fromkeys(data.kinds):
            inside = (counts > 0.0) & (kinds == kind)
            if inside.any():
                rms = math.sqrt(float(np.mean(np.square(residuals[name][inside]))))
                found.setdefault(name, {})[kind] = float(f"{rms:.6g}")
    return found


def growth(
    data: Data, residuals: Mapping[str, FloatArray], known: Misfit, noise: Mapping[str, float]
) -> dict[str, float]:
    """By channel: rms of what is left over what was left of the same kinds of leg when the twin was made.

    A kind that the twin has not seen is held against the largest of the others; below the ``noise`` nothing
    is left.
    """
    was, found = scales_by_kind(data, known, noise), {}
    for name, counts in counted(data).items():
        inside = counts > 0.0
        if inside.any():
            scale = was[name][inside]
            now = np.minimum(np.abs(residuals[name][inside]), STRAY * scale)
            found[name] = math.sqrt(float(np.sum(now**2)) / float(np.sum(scale**2)))
    return found


def scales_by_kind(data: Data, known: Misfit, noise: Mapping[str, float]) -> dict[str, Any]:
    """By channel, for each row: the misfit of its kind of leg as it was, or the noise if that is more."""
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    found: dict[str, Any] = {}
    for name in CHANNELS:
        before = known.get(name, {})
        otherwise = max(before.values(), default=0.0)
        by_kind = {kind: max(before.get(kind, otherwise), noise[name]) for kind in dict.fromkeys(data.kinds)}
        found[name] = np.array([by_kind[str(kind)] for kind in kinds])
    return found


@dataclass(frozen=True, eq=False)
class Known:
    """What a twin's file says of its own fit."""

    names: tuple[str, ...]
    """Of the parameters that were fitted."""
    covariance: FloatArray
    """Of their coordinates."""
    noise: dict[str, float]
    """Scale of each channel's residuals."""
    misfit: Misfit = field(default_factory=dict)
    """What the twin left of its own recordings; empty in files of older versions."""
    of_axis: bool = True
    """Whether the twin's values are the axis's."""

    @classmethod
    def of(cls, twin: Truth) -> Self:
        """InputError where the twin was not fitted."""
        about: Any = twin.provenance.get("fit")
        if not isinstance(about, dict):
            raise InputError(
                f"the truth '{twin.name}' does not say how sure it is (provenance.fit); expected a twin that "
                "was fitted: make one with hdbridge twin"
            )
        names = tuple(about["parameters"])
        covariance = np.array(about["covariance"], dtype=np.float64)
        of_axis = Values.of(twin) is not Values.REPLAY
        return cls(names, covariance, dict(about["noise"]), about.get("misfit", {}), of_axis)

    def root(self, parameters: Sequence[Parameter]) -> FloatArray:
        """A root of the covariance of these parameters' coordinates, shape (p, fitted).

        In no direction is it wider than the prior, whatever the residuals of a few legs say. A parameter that
        the twin has not fitted has no error there.
        """
        spread = {each.name: each.spread for each in parameters}
        prior = np.array([spread.get(name, 1.0) for name in self.names])
        # A file has some digits of it: what they leave of the smallest eigenvalues may be below zero.
        worth, directions = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        whole = prior[:, None] * directions * np.sqrt(np.clip(worth, 0.0, 1.0))
        root = np.zeros((len(parameters), len(self.names)))
        for row, each in enumerate(parameters):
            if each.name in self.names:
                root[row] = whole[self.names.index(each.name)]
        return root


@dataclass(frozen=True, eq=False)
class Change:
    """What a recording says of some coordinates, the others being the twin's."""

    by: FloatArray
    """How far they are from where the slopes were taken."""
    covariance: FloatArray


def change_of(
    places: Sequence[int],
    slopes: FloatArray,
    left: FloatArray,
    legs: FloatArray,
    root: FloatArray,
    precision: FloatArray,
    off: FloatArray,
) -> Change:
    """Generalised least squares of the coordinates at these places.

    ``left`` are the scaled residuals, ``slopes`` their derivatives by all coordinates, ``legs`` the number
    of each residual's leg, ``root`` a root of the twin's covariance. The prior has this ``precision`` about
    a point from which all coordinates are ``off`` already.
    """
    count = slopes.shape[1]
    gram, some = slopes.T @ slopes, list(places)
    noise = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    variance = max(1.0, float(noise @ noise) / max(len(left) - count, 1))
    seen = gram @ root
    inner = variance * np.eye(root.shape[1]) + root.T @ seen
    # The weights of the residuals are the slopes times this.
    weights = ((np.eye(count) - root @ np.linalg.solve(inner, seen.T)) / variance)[:, some]
    held = np.diag(precision[some])
    inverse = np.linalg.inv(weights.T @ gram[:, some] + held)
    by = -inverse @ (weights.T @ (slopes.T @ left) + precision[some] * off[some])
    louder = _louder(slopes, noise, legs, variance)
    spread = variance * gram * np.outer(louder, louder) + seen @ seen.T
    covariance = inverse @ (weights.T @ spread @ weights + held) @ inverse
    return Change(np.asarray(by, dtype=np.float64), np.asarray(covariance, dtype=np.float64))


def _louder(slopes: FloatArray, noise: FloatArray, legs: FloatArray, variance: float) -> FloatArray:
    """By coordinate, how much more residuals that go together within a leg weigh than white ones."""
    white = variance * np.sum(np.square(slopes), axis=0)
    squares = np.sum(np.square(over_legs(slopes * noise[:, None], legs)), axis=0)
    times = np.divide(squares, white, out=np.ones_like(white), where=white > 0.0)
    return np.asarray(np.sqrt(np.maximum(times, 1.0)), dtype=np.float64)


# ----------------------------------------------------------------

CHECK_S = 20.0
"""A longer recording is checked on pieces that take about so long."""
SIZES = (1.0, 2.5, 4.0, 6.0)
"""Each parameter is moved by so many of the changes that matter, either way: what a spring or a load rings by
goes out of step at a small share of a larger change already, and slopes say nothing of it."""
CONTENDERS = 2
"""So many such places a fit begins at, in addition to the twin's own."""
STEPS = 8
"""Steps in each stage of a fit."""
BLUNT = (0.1, 0.0)
"""The stages: a replay counts as off by at least this share of the noise, in addition to the rounding of the
readings. The second stage begins where the first ended, without the samples that are still too far off.
Rounding is not noise: treated as noise it draws delays and feed-forwards away from their true values, because
a smooth replay of the true axis then leaves more than the nearest wrong one (see `likelihood`). The first
stage is blunt because the walls of a count are steep, and give no direction from far off."""
LOST = 0.25
"""A channel of which a larger share of the samples has come to be beyond `SOFT` has become worse."""
ROUNDS = 3
"""So often the causes that are drawn away are set free. In the first round they are nearly always all."""
DRAWS = 8
"""Rounded and noisy replays about a place, within what the twin leaves open. A recording is held against
their mean: rounding is no noise (see `likelihood`). And a sample counts by how far they are apart: how a
motor breaks away after it has stuck hangs on a thousandth of a count, and says nothing."""
TOLERANCE = 0.5
"""A twin's values may be off by what its fit leaves open, and by so much of the least change that matters
(95 %). Two values that make up for each other in its own recordings do so no longer once a third has changed:
were they held where they are, what they leave would be told as a change of something else."""
LEAST_SUSPECT = 0.25
"""Share of that which the slopes have to promise: they say little of what goes out of step."""
TOLERATED = (1.0 / 3.0) ** 2
"""Mean square that a cause has to explain of some channel, in squares of its noise: what adds less than a
third of the noise to every channel nobody at the bench would see, and a twin may be off by as much."""
OWN = ("load friction", "temperature", "current limit", "velocity feed-forward")
"""Looked at in addition to what a fit changes."""
KNOWN_WARMTH = "temperature"
"""... of which this one is no unknown where both twin and recording tell the temperature."""
GROWN = 1.5
"""Ratio of two misfits of one axis that is a change: without one they differ by their noise and by the legs
that were recorded."""
EXPLAINED = 0.25
"""Share of the growth, in squares, that a named cause may leave: a misfit changes with the axis."""
MOST_NAMED = 2
"""Causes that are named by ratios, at most."""
NOTICEABLE = 2.5
"""Multiple of the least change that matters which a check has to be able to show."""


@dataclass(frozen=True, slots=True)
class Check:
    """What has changed, and what of it the twin explains."""

    changes: tuple[Finding, ...]
    misfit_before: Mapping[str, float]
    """By channel, rms of what the twin leaves, over the scale that it was made with."""
    misfit_after: Mapping[str, float]
    """The same with the changes."""
    unseen: tuple[str, ...] = ()
    """Causes of which even a large change would not have shown, in this motion or against this twin."""
    growth_before: Mapping[str, float] = field(default_factory=dict)
    """By channel, what the twin leaves of this recording over what it left of its own."""
    growth_after: Mapping[str, float] = field(default_factory=dict)
    """The same with the changes."""
    blind: bool = False
    """No change of any cause would have shown."""

    @property
    def sentence(self) -> str:
        """One sentence for somebody at the bench; others of what grew, and of what would not have shown."""
        found = ["Nothing has changed since the twin was made"]
        if self.changes:
            found = [f"Changed since the twin was made: {'. '.join(each.text for each in self.changes)}"]
        elif self.unexplained or self.grown:
            found = ["Something has changed since the twin was made that no change of a cause explains"]
        elif self.blind:
            found = ["The twin explains too little of this axis to show a change"]
        found += [
            f"Unexplained: {name}, {times:.0f} times what the twin was off by when it was made"
            for name, times in self.unexplained.items()
        ]
        found += [
            f"The twin leaves {times:.1f} times as much of the {name} as when it was made"
            for name, times in self.grown.items()
            if name not in self.unexplained
        ]
        if self.unseen and not self.blind:
            found.append(f"A change of {', '.join(self.unseen)} would not have shown")
        return f"{'. '.join(found)}."

    @property
    def unexplained(self) -> dict[str, float]:
        """What is left with the changes of the channels that are beyond doubt off, as `misfit_after`."""
        return {name: times for name, times in self.misfit_after.items() if times > SOFT}

    @property
    def grown(self) -> dict[str, float]:
        """The channels of which more is left, with the changes, than when the twin was made."""
        return {name: times for name, times in self.growth_after.items() if times > GROWN}


def check(
    recording: Recording,
    axis: AxisConfig,
    twin: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Check:
    """Reports what has changed between a twin and the axis that the recording shows.

    The misfit of a twin is first compared with the one stored when it was made. A twin whose values are the
    axis's names causes by the noise; any other names them by the ratio of both misfits.
    InputError if the twin was not fitted, or the recording has no command.
    """
    known = Known.of(twin)
    data = coarse(prepare(recording, axis, twin), CHECK_S)
    floor = noise_floor(data)
    scale = {name: max(known.noise.get(name, 0.0), floor[name]) for name in CHANNELS}
    parameters = free_parameters(twin, _own(data, twin))
    with Replays(data, workers) as replays:
        (before,) = replays([twin])
        grown = growth(data, before, known.misfit, scale)
        if not known.of_axis:
            return _by_ratio(replays, twin, known.misfit, scale, parameters, grown, progress)
        search = _Search(replays, twin, known, scale, parameters)
        best = search.found(progress)
        (after,) = replays([best.truth])
        if search.worsens(best):
            best, after = search.unchanged, before
        was, now = _in_scales(before, scale), _in_scales(after, scale)
    progress(1.0)
    gain = (_rms(before, scale), _rms(after, scale))
    changes = tuple(search.change(cause, best, gain) for cause in best.causes)
    left = growth(data, after, known.misfit, scale)
    return Check(changes, was, now, search.unseen(best), grown, left)


def _by_ratio(
    replays: Replays,
    twin: Truth,
    misfit: Misfit,
    noise: Mapping[str, float],
    parameters: Sequence[Parameter],
    grown: dict[str, float],
    progress: Callable[[float], None],
) -> Check:
    """What has changed against a twin that does not explain its axis, by the misfit that it was made with.

    Each cause is fitted alone, in units of that misfit, then with the best one. A cause is named if it
    explains most of the growth, and no other does as well within the scatter of the legs.
    """
    data = replays.data
    groups: dict[str, tuple[Parameter, ...]] = {}
    for each in parameters:
        groups[each.cause] = (*groups.get(each.cause, ()), each)
    unseen = tuple(cause for cause, own in groups.items() if not _shows(replays, twin, own, misfit, noise))
    blind = len(unseen) == len(groups)
    if max(grown.values(), default=0.0) <= GROWN:
        return Check((), {}, {}, unseen, grown, grown, blind)
    scale, legs = (
        Scales(scales_by_kind(data, misfit, noise)),
        legs_of_rows(data, fitted_rows(data, everything=True)),
    )
    named: list[str] = []
    best: Fitted | None = None
    left, now = _excess(grown), grown
    for number in range(MOST_NAMED):
        fits = {}
        for cause in (each for each in groups if each not in named):
            own = tuple(each for name in (*named, cause) for each in groups[name])
            start, prior = best.truth if best else twin, np.array(coordinates(twin, own))
            fits[cause] = solve(
                replays, start, own, prior, STEPS, known=scale, everything=True, tempered=True
            )
            progress((number + len(fits) / len(groups)) / MOST_NAMED)
        cause = min(fits, key=lambda each: fits[each].cost)
        now_grown = growth(data, fits[cause].residuals, misfit, noise)
        near = fits[cause].vector
        rivals = [
            each
            for each, fit in fits.items()
            if each != cause and not told_apart(near, fit.vector - near, legs)
        ]
        if rivals or _excess(now_grown) > EXPLAINED * left:
            break
        named, best, left, now = [*named, cause], fits[cause], _excess(now_grown), now_grown
        if max(now.values()) <= GROWN:
            break
    progress(1.0)
    changes = tuple(_ratio(groups[cause], twin, best.truth) for cause in named) if best else ()
    return Check(changes, {}, {}, unseen, grown, now)


def _excess(grown: Mapping[str, float]) -> float:
    """By how much the squares of the channels exceed what the twin was made with, in units of that."""
    return sum(max(each**2 - 1.0, 0.0) for each in grown.values())


def _shows(
    replays: Replays, twin: Truth, own: Sequence[Parameter], misfit: Misfit, noise: Mapping[str, float]
) -> bool:
    """Whether the misfit would grow if one of the parameters changed by a noticeable amount."""
    moved = [
        _shifted(twin, each, way * NOTICEABLE * each.least_change) for each in own for way in (-1.0, 1.0)
    ]
    here, *there = replays([twin, *moved])
    data = replays.data
    was = scales_by_kind(data, misfit, noise)
    for found in there:
        # What changes adds to what the twin leaves: by chance they have nothing in common.
        change = {name: np.hypot(found[name] - here[name], was[name]) for name in CHANNELS}
        if max(growth(data, change, misfit, noise).values(), default=0.0) > GROWN:
            return True
    return False


def _ratio(own: Sequence[Parameter], before: Truth, after: Truth) -> Finding:
    """A change by its ratio: neither value is the axis's."""
    moved = []
    for each in own:
        (was,), (now,) = coordinates(before, [each]), coordinates(after, [each])
        if each.linear:
            moved.append((abs(now - was) / each.least_change, Moved(each.name, each.unit, 0.0, now - was)))
        else:
            times = Moved(each.name, "times what it was", 1.0, math.exp(now - was))
            moved.append((abs(now - was) / each.least_change, times))
    size = max(size for size, _ in moved)
    shown = tuple(each for times, each in moved if times >= min(1.0, size))
    channels = tuple(name for name in CHANNELS if any(name in each.shows_in for each in own))
    return Finding(own[0].cause, shown, channels, size, (1.0, 1.0))


def _own(data: Data, twin: Truth) -> list[str]:
    """Those of `OWN` that neither twin nor recording tells: a warmer gear is no other one."""
    path = ".".join(BY_NAME[KNOWN_WARMTH].path)
    told = path in twin.intervals and all(each.commands.start_c is not None for each in data.pieces)
    return [each for each in OWN if not (told and each == KNOWN_WARMTH)]


@dataclass(frozen=True, eq=False)
class _Place:
    """The twin with some causes' parameters fitted, and what the recording says there of all parameters."""

    causes: tuple[str, ...]
    truth: Truth
    off: FloatArray
    """How far each parameter is from the twin's."""
    slopes: FloatArray
    """The scaled residuals' derivatives by all of them."""
    left: FloatArray
    """The scaled residuals."""
    apart: FloatArray
    """How far rounded and noisy replays are apart there, in scales; 1 at least."""


@dataclass(frozen=True, eq=False)
class _Moved:
    """A cause's parameters: where they are among all, how far from the twin's, and how sure that is."""

    places: list[int]
    off: FloatArray
    covariance: FloatArray

    @property
    def distance(self) -> float:
        """In squared standard deviations."""
        return float(self.off @ np.linalg.solve(self.covariance, self.off))


class _Search:
    """The causes that may be taken in, and what each earns."""

    def __init__(
        self,
        replays: Replays,
        twin: Truth,
        known: Known,
        scale: dict[str, float],
        parameters: tuple[Parameter, ...],
    ) -> None:
        self._replays, self._twin, self._scale = replays, twin, scale
        self._steps, least = rounding(replays.data.axis), least_deviation(replays.data)
        rounded = {name: step / 12.0**0.5 for name, step in self._steps.items()}
        self._fine = {
            name: max(least[name], math.sqrt(max(scale[name] ** 2 - rounded[name] ** 2, 0.0)))
            for name in CHANNELS
        }
        self._every = parameters
        self._causes = tuple(dict.fromkeys(each.cause for each in parameters))
        tolerated = TOLERANCE / NORMAL_95 * np.array([each.least_change for each in parameters])
        self._known = known.root(parameters)
        self._reached: list[_Place] = []
        self._root = np.hstack([self._known, np.diag(tolerated)])
        self._rows = fitted_rows(replays.data, everything=True)
        self._legs = legs_of_rows(replays.data, self._rows)
        self._channels = np.repeat(np.arange(len(CHANNELS)), len(self._rows) // len(CHANNELS))[self._rows]

    def at(self, causes: tuple[str, ...], truth: Truth) -> _Place:
        """What the recording says at a truth, to which these causes have led."""
        twin = np.array(coordinates(self._twin, self._every))
        here = solve(self._replays, truth, self._every, twin, 0, known=Scales(self._scale), everything=True)
        rng = np.random.default_rng(0)
        low, high = np.array([each.bounds for each in self._every]).T
        places = [
            np.clip(here.place + self._known @ rng.standard_normal(self._known.shape[1]), low, high)
            for _ in range(DRAWS)
        ]
        drawn = self._replays.drawn([at_coordinates(truth, self._every, each.tolist()) for each in places])
        left = np.stack(
            [
                told(shown, Scales(self._scale), self._rows) - here.jacobian @ (each - here.place)
                for each, shown in zip(places, drawn, strict=True)
            ]
        )
        apart = np.maximum(np.std(left, axis=0, ddof=1), 1.0)
        slopes, mean = here.jacobian / apart[:, None], np.mean(left, axis=0) / apart
        return _Place(causes, truth, here.place - twin, slopes, mean, apart)

    @cached_property
    def unchanged(self) -> _Place:
        """The twin as it was made."""
        return self.at((), self._twin)

    def found(self, progress: Callable[[float], None]) -> _Place:
        """The causes without which the recording cannot be told, and what they have come to."""
        unchanged = self.unchanged
        suspects = [cause for cause in self._causes if self._suspect(cause, unchanged)]
        if np.any(self._squares(unchanged.left) > SOFT**2):
            # So far off slopes say nothing: a load that rings at another frequency is out of step.
            suspects = list(self._causes)
        if not suspects:
            return unchanged
        self._reached.append(unchanged)
        starts = self._contenders(unchanged, suspects)
        self._settle((), self._twin, unchanged)
        best = self._as(())
        for done in range(ROUNDS):
            progress((done + 0.5) / ROUNDS)
            pulled = [each for each in self._causes if each not in best.causes and self._pulled(each, best)]
            if not pulled and best.causes:
                break
            more = tuple(dict.fromkeys([*best.causes, *pulled, *(cause for cause, _ in starts)]))
            for start in (best.truth, *(start for _, start in starts)):
                self._settle(more, start, best)
            step, last = self._needed(more), self._as(best.causes)
            if not step.causes or self._evidence(last) <= self._evidence(step):
                best = last
                break
            best, starts = step, []
        return best if best.causes else unchanged

    def worsens(self, place: _Place) -> bool:
        """Whether one channel is better at the cost of another: that is none of what has changed."""
        now, was = (
            self._squares(np.minimum(np.abs(each.left), SOFT)) / SOFT**2 for each in (place, self.unchanged)
        )
        return bool(np.any(now > np.maximum(was, LOST)))

    def _needed(self, causes: tuple[str, ...]) -> _Place:
        """The place without the causes that others, and what the twin leaves open, make up for."""
        best, tried = self._as(causes), set[str]()
        while rest := sorted(set(best.causes) - tried, key=lambda cause: self._moved(cause, best).distance):
            cause = rest[0]
            kept = tuple(each for each in best.causes if each != cause)
            self._settle(kept, self._without(cause, kept, best), best)
            best, without = self._as(best.causes), self._as(kept)
            idle = not self._significant(cause, best) or not self._matters(cause, best)
            if idle or self._evidence(without) < self._evidence(best):
                best = without
            else:
                tried.add(cause)
        return best

    def _settle(self, causes: tuple[str, ...], start: Truth, near: _Place) -> None:
        """Reach the place of some causes, all other parameters along within what the twin leaves open."""
        parameters = tuple(
            replace(each, spread=float(spread))
            for each, spread in zip(self._every, self._spreads(causes), strict=True)
        )
        prior, apart = np.array(coordinates(self._twin, parameters)), near.apart
        fit: Fitted | None = None
        for share in BLUNT:
            fit = solve(
                self._replays,
                start,
                parameters,
                prior,
                STEPS,
                known=self._rounded(apart, share),
                everything=True,
                near=fit,
                tempered=True,
            )
            # Those that are still beyond `SOFT` would draw all parameters along, which none can tell.
            start, apart = fit.truth, np.where(np.abs(fit.vector) > SOFT, np.inf, apart)
        self._reached.append(self.at(causes, start))

    def _rounded(self, apart: FloatArray, blunt: float) -> Scales:
        """What readings are rounded to, and how far off replays are beyond that, row by row."""
        off = {name: max(self._fine[name], blunt * self._scale[name]) for name in CHANNELS}
        return Scales(self._scales_of(apart, off), self._steps)

    def _spreads(self, causes: tuple[str, ...]) -> FloatArray:
        """By parameter, how far it may be from the twin's where these causes have changed."""
        open_by = np.sqrt(np.sum(np.square(self._root), axis=1))
        return np.array(
            [
                each.spread if each.cause in causes else min(each.spread, float(most))
                for each, most in zip(self._every, open_by, strict=True)
            ]
        )

    def _without(self, cause: str, kept: tuple[str, ...], at: _Place) -> Truth:
        """Where the slopes say that all others go if a cause is put back.

        Left where they are, they would make up for a change that there is no more: so far off that a fit
        from there may never come back.
        """
        own = np.array([each.cause == cause for each in self._every])
        weak = np.diag(1.0 / self._spreads(kept)[~own])
        rows = np.vstack([at.slopes[:, ~own], weak])
        # As if from the twin's values on, so that the prior is about nothing.
        left = np.concatenate([at.left - at.slopes @ at.off, np.zeros(len(weak))])
        others = [each for each in self._every if each.cause != cause]
        off = -np.linalg.lstsq(rows, left, rcond=None)[0]
        low, high = np.array([each.bounds for each in others]).T
        there = np.clip(np.array(coordinates(self._twin, others)) + off, low, high)
        return at_coordinates(self._put_back(cause, at.truth), others, there.tolist())

    def _put_back(self, cause: str, truth: Truth) -> Truth:
        """A truth with a cause's parameters as the twin has them."""
        own = [each for each in self._every if each.cause == cause]
        return at_coordinates(truth, own, coordinates(self._twin, own))

    def _pull(self, numbers: Sequence[int], at: _Place) -> float:
        """How far parameters have gone along, in squared standard deviations of what the twin leaves open."""
        off, root = at.off[numbers], self._root[numbers]
        return float(off @ np.linalg.solve(root @ root.T, off))

    def _pulled(self, cause: str, best: _Place) -> bool:
        """Whether a cause has gone along by more than chance."""
        own = [number for number, each in enumerate(self._every) if each.cause == cause]
        return float(chdtrc(len(own), self._pull(own, best))) < FALSE_ALARM / len(self._causes)

    def change(self, cause: str, best: _Place, gain: tuple[float, float]) -> Finding:
        """What is said of a cause."""
        moved = self._moved(cause, best)
        parameters = [self._every[place] for place in moved.places]
        now = np.array(coordinates(self._twin, parameters)) + moved.off
        reach = NORMAL_95 * np.sqrt(np.diag(moved.covariance))
        intervals = {
            each.name: (each.value(float(at - r)), each.value(float(at + r)))
            for each, at, r in zip(parameters, now, reach, strict=True)
        }
        after = at_coordinates(best.truth, parameters, now.tolist())
        return finding(parameters, self._twin, after, intervals, moved.distance, gain)

    def unseen(self, best: _Place) -> tuple[str, ...]:
        """The causes of which no parameter's change is known to better than what was possible before."""
        found = []
        for cause in (each for each in self._causes if each not in best.causes):
            moved = self._moved(cause, best, cause)
            spread = np.array([self._every[place].spread for place in moved.places])
            if np.all(NORMAL_95 * np.sqrt(np.diag(moved.covariance)) > spread):
                found.append(cause)
        return tuple(found)

    def _contenders(self, best: _Place, suspects: Sequence[str]) -> list[tuple[str, Truth]]:
        """The suspects of which a parameter, moved alone, explains more than it costs, and where it does."""
        moves = [
            (each, way * size * each.least_change)
            for each in self._every
            if each.cause in suspects
            for size in SIZES
            for way in (-1.0, 1.0)
        ]
        truths = [self._twin, *(_shifted(self._twin, each, by) for each, by in moves)]
        scale = self._scales_of(best.apart)
        here, *costs = (self._cost(found, scale) for found in self._replays(truths))
        nearest: dict[str, tuple[float, Truth]] = {}
        for (each, _), cost, there in zip(moves, costs, truths[1:], strict=True):
            price = 0.5 * self._price(each.cause)
            if cost + price < nearest.get(each.cause, (here, there))[0]:
                nearest[each.cause] = (cost + price, there)
        ranked = sorted(nearest, key=lambda cause: nearest[cause][0])
        return [(cause, nearest[cause][1]) for cause in ranked[:CONTENDERS]]

    def _cost(self, found: dict[str, FloatArray], scale: dict[str, Any]) -> float:
        left = told(found, Scales(scale), self._rows)
        return 0.5 * float(left @ left)

    def _scales_of(self, apart: FloatArray, scale: Mapping[str, float] | None = None) -> dict[str, Any]:
        """The scale of each channel, the noise's unless it is another, row by row."""
        scale = self._scale if scale is None else scale
        rows = np.ones(len(self._rows))
        rows[self._rows] = apart
        by_channel = zip(CHANNELS, np.split(rows, len(CHANNELS)), strict=True)
        return {name: scale[name] * each for name, each in by_channel}

    def _moved(self, cause: str, at: _Place, *more: str, trusted: bool = False) -> _Moved:
        """How far a cause has moved next to the place's own, all other parameters as the twin leaves them.

        ``trusted``: a twin is off by no more than it says.
        """
        free = [number for number, each in enumerate(self._every) if each.cause in (*at.causes, *more)]
        precision = np.array([each.spread for each in self._every]) ** -2.0
        along = np.where(np.isin(np.arange(len(self._every)), free), 0.0, at.off)
        left = at.left - at.slopes @ along
        root = self._known if trusted else self._root
        found = change_of(free, at.slopes, left, self._legs, root, precision, at.off)
        own = [number for number, place in enumerate(free) if self._every[place].cause == cause]
        places = [free[number] for number in own]
        return _Moved(places, at.off[places] + found.by[own], found.covariance[np.ix_(own, own)])

    def _price(self, cause: str) -> float:
        """What a cause costs by its number of parameters (Schwarz)."""
        count = sum(each.cause == cause for each in self._every)
        return count * math.log(max(len(self._replays.data.leg), 2))

    def _suspect(self, cause: str, best: _Place) -> bool:
        """Whether the slopes leave it open that a cause explains what matters."""
        free = [number for number, each in enumerate(self._every) if each.cause in (*best.causes, cause)]
        slopes = best.slopes[:, free]
        after = best.left - slopes @ np.linalg.lstsq(slopes, best.left, rcond=None)[0]
        explained = self._squares(best.left) - self._squares(after)
        return bool(np.any(explained > LEAST_SUSPECT * TOLERATED)) and self._certain(
            self._moved(cause, best, cause, trusted=True)
        )

    def _matters(self, cause: str, found: _Place) -> bool:
        """Whether a cause explains more than a twin may leave."""
        back = self._put_back(cause, found.truth)
        with_it, without = (
            told(each, Scales(self._scales_of(found.apart)), self._rows)
            for each in self._replays([found.truth, back])
        )
        return bool(np.any(self._squares(without) - self._squares(with_it) > TOLERATED))

    def _as(self, causes: tuple[str, ...]) -> _Place:
        """The place that says most for these causes and no others, of all that have been reached.

        A fit does not always come to its minimum, and where a motor sticks there is chance in what it leaves:
        were causes judged each where its own fit has come to, that would decide. What a fit with more causes
        has found speaks for fewer, too, if the rest of them has hardly moved there; and what went along in
        a fit with fewer may be a cause.
        """
        return min((replace(each, causes=causes) for each in self._reached), key=self._evidence)

    def _evidence(self, at: _Place) -> float:
        """What a place leaves, how far it is from the twin, and what its causes cost: less is better.

        Minus the log likelihood. Where replays are further apart a place foretells less, and pays for it. A
        sample that is further off than `SOFT` says no more than one that is as far off: it comes of a motor
        that broke away at another time, and a few of them would outweigh all others.
        """
        left = np.minimum(np.abs(at.left), SOFT)
        others = [number for number, each in enumerate(self._every) if each.cause not in at.causes]
        along = self._pull(others, at)
        wide = 2.0 * float(np.sum(np.log(at.apart)))
        return 0.5 * (float(left @ left) + wide + along + sum(map(self._price, at.causes)))

    def _squares(self, left: FloatArray) -> FloatArray:
        """Mean square by channel."""
        counts = np.bincount(self._channels, minlength=len(CHANNELS))
        sums = np.bincount(self._channels, np.square(left), minlength=len(CHANNELS))
        return np.asarray(sums / np.maximum(counts, 1), dtype=np.float64)

    def _certain(self, moved: _Moved) -> bool:
        """Whether a cause has moved beyond what is open."""
        return float(chdtrc(len(moved.places), moved.distance)) < FALSE_ALARM / len(self._causes)

    def _significant(self, cause: str, at: _Place) -> bool:
        """... and by as much as matters."""
        moved = self._moved(cause, at)
        off, spread = np.abs(moved.off), np.sqrt(np.diag(moved.covariance))
        least = np.array([self._every[place].least_change for place in moved.places])
        return self._certain(moved) and bool(np.any((off > least) & (off > 2.0 * spread)))


def _shifted(truth: Truth, parameter: Parameter, by: float) -> Truth:
    """The truth with one coordinate moved, within its bounds."""
    low, high = parameter.bounds
    (now,) = coordinates(truth, [parameter])
    return at_coordinates(truth, [parameter], [min(max(now + by, low), high)])


def _in_scales(found: Mapping[str, FloatArray], scale: Mapping[str, float]) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(np.square(found[name])))) / scale[name] for name in CHANNELS}


def _rms(found: Mapping[str, FloatArray], scale: Mapping[str, float]) -> float:
    return math.sqrt(sum(each**2 for each in _in_scales(found, scale).values()) / len(CHANNELS))
