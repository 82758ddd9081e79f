"""Changes since a twin was made: compares a new recording with its replay and names the causes.

All parameters are fitted together, each held to the twin's value with the twin's uncertainty as its prior.
Causes whose parameters are drawn away by more than chance are set free, and so are those that explain most
when moved alone. A cause is kept only if it has moved significantly, by as much as matters in practice, and
if the best fit without it is less likely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from typing import Any, Self

import numpy as np
from scipy.special import chdtrc

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.readings import median_deviation
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import (
    SOFT,
    fitted_rows,
    free_parameters,
    intervals_of,
    legs_of_rows,
    over_legs,
    softened,
    solve,
)
from hdbridge.twin.misfit import (
    CHANNELS,
    Data,
    Misfit,
    Replays,
    Scales,
    Values,
    coarse,
    counted,
    least_deviation,
    noise_floor,
    prepare,
    rounding,
)
from hdbridge.twin.naming import FALSE_ALARM, Finding, Moved, finding, put_back, told_apart
from hdbridge.twin.parameters import BY_NAME, Parameter, at_coordinates, by_cause, coordinates
from hdbridge.units import figure

# ----------------------------------------------------------------
# How sure a change against a twin is: by the new recording, and by what the twin's own recordings left open.

STRAY = 4.0
"""Limit at which residuals are clipped, in rms of their kind of leg: a motor that breaks away at a different
time is not a change of the axis."""


def growth(data: Data, residuals: Mapping[str, FloatArray], was: Mapping[str, Any]) -> dict[str, float]:
    """Returns, by channel, the rms residual relative to ``was`` (`scales_by_kind`).

    A row counts as no more than `STRAY` times the typical residual of its leg, because single rows may be
    readings that are wrong, but a whole leg is not.
    """
    found = {}
    for name, counts in counted(data).items():
        inside = counts > 0.0
        if inside.any():
            scale, now, legs = was[name][inside], np.abs(residuals[name][inside]), data.leg[inside]
            typical = np.zeros_like(now)
            for leg in np.unique(legs):
                typical[legs == leg] = median_deviation(now[legs == leg])
            now = np.minimum(now, STRAY * np.maximum(scale, typical))
            found[name] = math.sqrt(float(np.sum(now**2)) / float(np.sum(scale**2)))
    return found


def scales_by_kind(data: Data, known: Misfit, noise: Mapping[str, float]) -> dict[str, Any]:
    """Returns, by channel and row, the twin's own misfit on this kind of leg, or the noise if larger.

    A kind that the twin has not seen is compared with the largest of the others.
    """
    found = {}
    for name in CHANNELS:
        before = known.get(name, {})
        otherwise = max(before.values(), default=0.0)
        by_leg = np.array([max(before.get(kind, otherwise), noise[name]) for kind in data.kinds])
        found[name] = by_leg[data.leg.astype(np.intp)]
    return found


@dataclass(frozen=True, eq=False)
class Known:
    """The twin's own fit, as its file describes it."""

    names: tuple[str, ...]
    """Names of the fitted parameters."""
    covariance: FloatArray
    """Covariance of their coordinates, shape (p, p)."""
    noise: dict[str, float]
    """Scale of each channel's residuals."""
    misfit: Misfit = field(default_factory=dict)
    """Misfit to the twin's own recordings; empty in files of older versions."""
    of_axis: bool = True
    """True if the twin's values are the axis's."""

    @classmethod
    def of(cls, twin: Truth) -> Self:
        """Reads the provenance of a twin; InputError if it was not fitted."""
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
        """Returns a root of the covariance of these parameters' coordinates, shape (p, fitted).

        It is limited to the prior's width in every direction. Parameters that the twin has not fitted have no
        error in it.
        """
        spread = {each.name: each.spread for each in parameters}
        prior = np.array([spread.get(name, 1.0) for name in self.names])
        # Rounding in the file may have made the smallest eigenvalues negative.
        worth, directions = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        whole = prior[:, None] * directions * np.sqrt(np.clip(worth, 0.0, 1.0))
        root = np.zeros((len(parameters), len(self.names)))
        for row, each in enumerate(parameters):
            if each.name in self.names:
                root[row] = whole[self.names.index(each.name)]
        return root


# ----------------------------------------------------------------

CHECK_S = 17.0
"""Duration of the pieces on which a longer recording is checked."""
SIZES = (1.0, 2.5, 4.0, 6.0)
"""Trial changes of each parameter, in both directions, in units of its least change. Slopes do not cover
them: the ringing of a spring or load runs out of phase already at small changes."""
CONTENDERS = 2
"""Number of these trials at which a fit starts, in addition to the twin itself."""
STEPS = 8
"""Maximum steps in each stage of a fit."""
BLUNT = (0.1, 0.0)
"""Minimum error of a replay, as a share of the noise, in the two stages of a fit; rounding of the readings
comes in addition. The second stage starts at the end of the first, without the samples that are still too far
off. Rounding is not noise: treated as noise it biases delays and feed-forwards, because a smooth replay of
the true axis then leaves more than the nearest wrong one (see `hdbridge.twin.misfit`). The first stage is
blunt because the likelihood of a rounded reading is steep and gives no direction from far off."""
LOST = 0.25
"""Clipped mean square, in units of `SOFT` squared, above which a channel that has grown is worse."""
ROUNDS = 3
"""Maximum rounds of setting causes free. The first round nearly always finds all causes."""
DRAWS = 8
"""Number of rounded and noisy replays about a place, drawn from the twin's posterior. The recording is
compared with their mean, and their scatter weights each sample: the moment at which a stuck motor breaks away
depends on a thousandth of a count and is no evidence."""
TOLERANCE = 0.5
"""Tolerated error of a twin's values beyond their intervals (95 %), as a share of the least change. Two
errors that cancel in the twin's own recordings no longer cancel after a third parameter has changed; without
this tolerance their residual would be reported as another change."""
LEAST_SUSPECT = 0.25
"""Share of `TOLERATED` that the linearised fit must explain for a suspect; slopes do not cover phase loss."""
TOLERATED = (1.0 / 3.0) ** 2
"""Minimum mean square that a cause must explain in some channel, in squares of its noise: a twin may be off
by a third of the noise, which nobody at the bench would see."""
WARMTH = "temperature"
OWN = ("load friction", WARMTH, "current limit", "velocity feed-forward")
"""Parameters checked in addition to those that a fit changes; the temperature unless twin and recording have
it."""
GROWN = 1.5
"""Ratio of two misfits above which an axis has changed; smaller ones come from noise and different legs."""
EXPLAINED = 0.25
"""Minimum share of the growth, in squares, that a cause named by ratio explains. A servo that is not the
axis's is off by a share of every change, so the cause is not required to explain all of it."""
REST = 0.5
"""Minimum share of the misfit left by the first cause that a second cause must explain."""
MOST_NAMED = 2
"""Maximum number of causes named by ratio."""
NOTICEABLE = 2.5
"""Change that a check must be able to show, in units of a parameter's least change."""


@dataclass(frozen=True, slots=True)
class Check:
    """Result of a check: the changes, and the growth of the misfit that they leave."""

    changes: tuple[Finding, ...]
    growth_before: Mapping[str, float]
    """Ratio, by channel, of the twin's misfit to this recording and to its own recordings."""
    growth_after: Mapping[str, float]
    """`growth_before` after the changes."""
    unseen: tuple[str, ...] = ()
    """Causes of which even a large change would not show, in this motion or with this twin."""
    blind: bool = False
    """True if no change of any cause would show."""

    @property
    def sentence(self) -> str:
        """Summary in words: the changes, channels whose misfit has grown, and causes that cannot show."""
        found = ["Nothing has changed since the twin was made"]
        if self.changes:
            found = [f"Changed since the twin was made: {'. '.join(map(str, self.changes))}"]
        elif self.unexplained:
            found = ["Something has changed since the twin was made that no change of a cause explains"]
        elif self.blind:
            found = ["The twin explains too little of this axis to show a change"]
        found += [
            f"The twin leaves {figure(times, 3)} times as much of the {name} as when it was made"
            for name, times in self.unexplained.items()
        ]
        if self.unseen and not self.blind:
            found.append(f"This recording would not show a change in: {', '.join(self.unseen)}")
        return f"{'. '.join(found)}."

    @property
    def unexplained(self) -> dict[str, float]:
        """Channels whose misfit has grown in spite of the changes, with their ratios."""
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
    # A recorded temperature is not a change.
    known_warmth = BY_NAME[WARMTH].path in twin.intervals and all(
        each.commands.start_c is not None for each in data.pieces
    )
    parameters = free_parameters(twin, [each for each in OWN if not (known_warmth and each == WARMTH)])
    with Replays(data, workers) as replays:
        (before,) = replays([twin])
        was = scales_by_kind(data, known.misfit, scale)
        grown = growth(data, before, was)
        if not known.of_axis:
            return _by_ratio(replays, twin, was, parameters, grown, progress)
        search = _Search(replays, twin, known, scale, parameters)
        best = search.found(progress)
        (after,) = replays([best.truth])
        if search.worsens(best):
            best, after = search.unchanged, before
    progress(1.0)
    changes = tuple(search.change(cause, best) for cause in best.causes)
    return Check(changes, grown, growth(data, after, was), search.unseen(best))


def _by_ratio(
    replays: Replays,
    twin: Truth,
    was: Mapping[str, Any],
    parameters: Sequence[Parameter],
    grown: dict[str, float],
    progress: Callable[[float], None],
) -> Check:
    """Checks against a twin that does not explain its axis, in units of the misfit that it was made with.

    Each cause is fitted alone, then with the best one. A cause is named if it explains most of the growth and
    no other cause does so equally well within the scatter of the legs.
    """
    data = replays.data
    groups = by_cause(parameters)
    unseen = tuple(cause for cause, own in groups.items() if not _shows(replays, twin, own, was))
    blind = len(unseen) == len(groups)
    if max(grown.values(), default=0.0) <= GROWN:
        return Check((), grown, grown, unseen, blind)
    legs = legs_of_rows(data, fitted_rows(data, everything=True))
    named: list[str] = []
    best, left, now = twin, _excess(grown), grown
    for number in range(MOST_NAMED):
        fits = {}
        for cause in (each for each in groups if each not in named):
            own = tuple(each for name in (*named, cause) for each in groups[name])
            fits[cause] = solve(
                replays, best, own, STEPS, np.array(coordinates(twin, own)), known=Scales(was),
                everything=True, tempered=True, linear=False,
            )  # fmt: skip
            progress((number + len(fits) / len(groups)) / MOST_NAMED)
        cause, fit = min(fits.items(), key=lambda each: each[1].cost)
        after = growth(data, fit.residuals, was)
        explained = left - _excess(after)
        certain = all(
            other is fit or told_apart(fit.vector, other.vector - fit.vector, legs) for other in fits.values()
        )
        if not certain or explained < max(EXPLAINED * _excess(grown), REST * left if named else 0.0):
            break
        named, best, left, now = [*named, cause], fit.truth, _excess(after), after
        if max(now.values()) <= GROWN:
            break
    progress(1.0)
    return Check(tuple(_ratio(groups[cause], twin, best) for cause in named), grown, now, unseen)


def _excess(grown: Mapping[str, float]) -> float:
    """Returns the sum of the channels' growth in squares, relative to the twin's own misfit."""
    return sum(max(each**2 - 1.0, 0.0) for each in grown.values())


def _shows(replays: Replays, twin: Truth, own: Sequence[Parameter], was: Mapping[str, Any]) -> bool:
    """Returns True if a noticeable change of one of the parameters would make the misfit grow."""
    moved = [
        _shifted(twin, each, way * NOTICEABLE * each.least_change) for each in own for way in (-1.0, 1.0)
    ]
    here, *there = replays([twin, *moved])
    for found in there:
        # The change is uncorrelated with the twin's residuals, so squares add.
        change = {name: np.hypot(found[name] - here[name], was[name]) for name in CHANNELS}
        if max(growth(replays.data, change, was).values(), default=0.0) > GROWN:
            return True
    return False


def _ratio(own: Sequence[Parameter], before: Truth, after: Truth) -> Finding:
    """Reports a change as a ratio, because neither value is the axis's."""
    off = np.subtract(coordinates(after, own), coordinates(before, own))
    sizes = np.abs(off) / [each.least_change for each in own]
    moved = [
        Moved(each.name, each.unit, 0.0, by)
        if each.linear
        else Moved(each.name, "times what it was", 1.0, math.exp(by))
        for each, by in zip(own, off.tolist(), strict=True)
    ]
    return Finding(own[0].cause, tuple(compress(moved, sizes >= min(1.0, np.max(sizes)))))


@dataclass(frozen=True, eq=False)
class _Place:
    """The twin with the parameters of some causes fitted, and the linearised residuals there."""

    causes: tuple[str, ...]
    truth: Truth
    off: FloatArray
    """Distance of each coordinate from the twin's, shape (p,)."""
    slopes: FloatArray
    """Derivatives of the scaled residuals with respect to all coordinates, shape (n, p)."""
    left: FloatArray
    """Scaled residuals, shape (n,)."""
    apart: FloatArray
    """Standard deviation of rounded and noisy replays there, in scales, at least 1; shape (n,)."""


@dataclass(frozen=True, eq=False)
class _Moved:
    """Change of a cause's parameters: distances of their coordinates from the twin's, and covariance."""

    parameters: list[Parameter]
    off: FloatArray
    covariance: FloatArray

    @property
    def distance(self) -> float:
        """Mahalanobis distance, squared."""
        return float(self.off @ np.linalg.solve(self.covariance, self.off))

    @property
    def errors(self) -> FloatArray:
        """Standard errors, shape (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)


class _Search:
    """Search for the causes that explain a recording, starting from the twin."""

    def __init__(
        self,
        replays: Replays,
        twin: Truth,
        known: Known,
        scale: dict[str, float],
        parameters: tuple[Parameter, ...],
    ) -> None:
        self._replays, self._twin, self._scale = replays, twin, scale
        self._every = parameters
        self._prior = np.array(coordinates(twin, parameters))
        self._causes = tuple(dict.fromkeys(each.cause for each in parameters))
        self._least = np.array([each.least_change for each in parameters])
        self._spread = np.array([each.spread for each in parameters])
        self._known = known.root(parameters)
        self._root = np.hstack([self._known, np.diag(TOLERANCE / NORMAL_95 * self._least)])
        self._reached: list[_Place] = []
        self._rows = fitted_rows(replays.data, everything=True)
        self._legs = legs_of_rows(replays.data, self._rows)
        self._channels = np.repeat(np.arange(len(CHANNELS)), len(self._rows) // len(CHANNELS))[self._rows]

    def at(self, causes: tuple[str, ...], truth: Truth) -> _Place:
        """Linearises the residuals at a truth that was fitted with these causes free."""
        scale = Scales(self._scale)
        here = solve(self._replays, truth, self._every, 0, self._prior, known=scale, everything=True)
        rng = np.random.default_rng(0)
        low, high = np.array([each.bounds for each in self._every]).T
        places = [
            np.clip(here.place + self._known @ rng.standard_normal(self._known.shape[1]), low, high)
            for _ in range(DRAWS)
        ]
        truths = [at_coordinates(truth, self._every, each.tolist()) for each in places]
        drawn = self._replays(truths, range(1, DRAWS + 1))
        left = np.stack(
            [
                softened(shown, scale, self._rows) - here.jacobian @ (each - here.place)
                for each, shown in zip(places, drawn, strict=True)
            ]
        )
        apart = np.maximum(np.std(left, axis=0, ddof=1), 1.0)
        slopes, mean = here.jacobian / apart[:, None], np.mean(left, axis=0) / apart
        return _Place(causes, truth, here.place - self._prior, slopes, mean, apart)

    @cached_property
    def unchanged(self) -> _Place:
        """The twin without changes."""
        return self.at((), self._twin)

    def found(self, progress: Callable[[float], None]) -> _Place:
        """Finds the causes that the recording requires, and the place with their fitted parameters."""
        unchanged = self.unchanged
        suspects = [cause for cause in self._causes if self._suspect(cause, unchanged)]
        if np.any(self._squares(unchanged.left) > SOFT**2):
            # Slopes are invalid so far off: a load that rings at another frequency is out of phase.
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
            more = tuple(dict.fromkeys([*best.causes, *pulled, *starts]))
            for start in (best.truth, *starts.values()):
                self._settle(more, start, best)
            step, last = self._needed(more), self._as(best.causes)
            if not step.causes or self._evidence(last) <= self._evidence(step):
                best = last
                break
            best, starts = step, {}
        return best if best.causes else unchanged

    def worsens(self, place: _Place) -> bool:
        """Returns True if a place improves one channel at the cost of another, so it is not a change."""
        now, was = (
            self._squares(np.minimum(np.abs(each.left), SOFT)) / SOFT**2 for each in (place, self.unchanged)
        )
        return bool(np.any(now > np.maximum(was, LOST)))

    def change(self, cause: str, best: _Place) -> Finding:
        """Returns the finding of a cause, with intervals of its parameters."""
        moved = self._moved(cause, best)
        now = np.array(coordinates(self._twin, moved.parameters)) + moved.off
        after = at_coordinates(best.truth, moved.parameters, now.tolist())
        intervals = intervals_of(moved.parameters, now, moved.covariance)
        return finding(moved.parameters, self._twin, after, intervals)

    def unseen(self, best: _Place) -> tuple[str, ...]:
        """Returns the causes whose parameters the recording does not determine better than the prior."""
        return tuple(
            cause
            for cause in self._causes
            if cause not in best.causes
            and np.all(
                NORMAL_95 * self._moved(cause, best, cause).errors > self._spread[self._numbers(cause)]
            )
        )

    def _numbers(self, *causes: str) -> list[int]:
        """Returns the numbers of the parameters of some causes."""
        return [number for number, each in enumerate(self._every) if each.cause in causes]

    def _needed(self, causes: tuple[str, ...]) -> _Place:
        """Removes causes that the other causes and the twin's uncertainty can replace."""
        best, tried = self._as(causes), set[str]()
        while rest := set(best.causes) - tried:
            cause = min(rest, key=lambda each: self._moved(each, best).distance)
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
        """Fits some causes freely, and all other parameters within the twin's uncertainty."""
        parameters = tuple(
            replace(each, spread=float(spread))
            for each, spread in zip(self._every, self._spreads(causes), strict=True)
        )
        steps, least = rounding(self._replays.data.axis), least_deviation(self._replays.data)
        # Rounding is not noise here: it is in the likelihood.
        fine = {
            name: max(least[name], math.sqrt(max(self._scale[name] ** 2 - steps[name] ** 2 / 12.0, 0.0)))
            for name in CHANNELS
        }
        apart, fit = near.apart, None
        for share in BLUNT:
            off = {name: max(fine[name], share * self._scale[name]) for name in CHANNELS}
            known = Scales(self._scales_of(apart, off), steps)
            fit = solve(
                self._replays, start, parameters, STEPS, self._prior, known=known, everything=True, near=fit,
                tempered=True, linear=False,
            )  # fmt: skip
            # Samples that are still beyond `SOFT` cannot be explained and would bias all parameters.
            start, apart = fit.truth, np.where(np.abs(fit.vector) > SOFT, np.inf, apart)
        self._reached.append(self.at(causes, start))

    def _spreads(self, causes: tuple[str, ...]) -> FloatArray:
        """Returns the prior standard deviation of each parameter about the twin if these causes are free."""
        held = np.sqrt(np.sum(np.square(self._root), axis=1))
        held[self._numbers(*causes)] = np.inf
        return np.asarray(np.minimum(held, self._spread), dtype=np.float64)

    def _without(self, cause: str, kept: tuple[str, ...], at: _Place) -> Truth:
        """Returns the truth with a cause reset to the twin and the others moved to their linear optimum.

        Without that move, the others would still compensate for the removed change, and a fit from there
        might not converge.
        """
        own = np.isin(np.arange(len(self._every)), self._numbers(cause))
        weak = np.diag(1.0 / self._spreads(kept)[~own])
        rows = np.vstack([at.slopes[:, ~own], weak])
        # Relative to the twin's values, so that the prior's mean is zero.
        left = np.concatenate([at.left - at.slopes @ at.off, np.zeros(len(weak))])
        others = [each for each in self._every if each.cause != cause]
        off = -np.linalg.lstsq(rows, left, rcond=None)[0]
        low, high = np.array([each.bounds for each in others]).T
        there = np.clip(self._prior[~own] + off, low, high)
        return at_coordinates(self._put_back(cause, at.truth), others, there.tolist())

    def _put_back(self, cause: str, truth: Truth) -> Truth:
        """Returns a truth with a cause's parameters reset to the twin's."""
        return put_back(self._twin, truth, [each for each in self._every if each.cause == cause])

    def _pull(self, numbers: Sequence[int], at: _Place) -> float:
        """Returns the squared Mahalanobis distance of parameters from the twin, by the twin's covariance."""
        off, root = at.off[numbers], self._root[numbers]
        return float(off @ np.linalg.solve(root @ root.T, off))

    def _pulled(self, cause: str, best: _Place) -> bool:
        """Returns True if a cause that is held to the twin has moved by more than chance."""
        own = self._numbers(cause)
        return float(chdtrc(len(own), self._pull(own, best))) < FALSE_ALARM / len(self._causes)

    def _contenders(self, best: _Place, suspects: Sequence[str]) -> dict[str, Truth]:
        """Returns suspects that explain more than they cost by one moved parameter, with these truths."""
        moves = [
            (each, way * size * each.least_change)
            for each in self._every
            if each.cause in suspects
            for size in SIZES
            for way in (-1.0, 1.0)
        ]
        truths = [self._twin, *(_shifted(self._twin, each, by) for each, by in moves)]
        scale = Scales(self._scales_of(best.apart))
        lefts = (softened(found, scale, self._rows) for found in self._replays(truths))
        here, *costs = (0.5 * float(left @ left) for left in lefts)
        nearest: dict[str, tuple[float, Truth]] = {}
        for (each, _), cost, there in zip(moves, costs, truths[1:], strict=True):
            price = 0.5 * self._price(each.cause)
            if cost + price < nearest.get(each.cause, (here, there))[0]:
                nearest[each.cause] = (cost + price, there)
        ranked = sorted(nearest, key=lambda cause: nearest[cause][0])
        return {cause: nearest[cause][1] for cause in ranked[:CONTENDERS]}

    def _scales_of(self, apart: FloatArray, scale: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Returns the scale of each row by channel: ``scale`` (default: the noise) times ``apart``."""
        scale = self._scale if scale is None else scale
        rows = np.ones(len(self._rows))
        rows[self._rows] = apart
        by_channel = zip(CHANNELS, np.split(rows, len(CHANNELS)), strict=True)
        return {name: scale[name] * each for name, each in by_channel}

    def _moved(self, cause: str, at: _Place, *more: str, trusted: bool = False) -> _Moved:
        """Estimates a cause's change by generalised least squares, with the place's causes free.

        The others are held to the twin by a root of its covariance. ``trusted``: without the tolerance for
        errors of the twin beyond its covariance. Residuals that are correlated within legs inflate the
        standard errors.
        """
        free, count = self._numbers(*at.causes, *more), len(self._every)
        root, slopes = self._known if trusted else self._root, at.slopes
        left = at.left - slopes @ np.where(np.isin(np.arange(count), free), 0.0, at.off)
        gram = slopes.T @ slopes
        noise = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
        variance = max(1.0, float(noise @ noise) / max(len(left) - count, 1))
        seen = gram @ root
        inner = variance * np.eye(root.shape[1]) + root.T @ seen
        # Residual weights are the slopes times this matrix.
        weights = ((np.eye(count) - root @ np.linalg.solve(inner, seen.T)) / variance)[:, free]
        held = self._spread[free] ** -2.0
        inverse = np.linalg.inv(weights.T @ gram[:, free] + np.diag(held))
        by = -inverse @ (weights.T @ (slopes.T @ left) + held * at.off[free])
        white = variance * np.diag(gram)
        by_leg = np.sum(np.square(over_legs(slopes * noise[:, None], self._legs)), axis=0)
        louder = np.sqrt(np.maximum(np.divide(by_leg, white, out=np.ones(count), where=white > 0.0), 1.0))
        spread = variance * gram * np.outer(louder, louder) + seen @ seen.T
        covariance = inverse @ (weights.T @ spread @ weights + np.diag(held)) @ inverse
        own = [place for place, number in enumerate(free) if self._every[number].cause == cause]
        numbers = [free[place] for place in own]
        parameters = [self._every[number] for number in numbers]
        return _Moved(parameters, at.off[numbers] + by[own], covariance[np.ix_(own, own)])

    def _price(self, cause: str) -> float:
        """Returns the penalty of a cause for its number of parameters (Schwarz criterion, BIC)."""
        return len(self._numbers(cause)) * math.log(max(len(self._replays.data.leg), 2))

    def _suspect(self, cause: str, best: _Place) -> bool:
        """Returns True if a cause may be relevant by the linearised fit."""
        slopes = best.slopes[:, self._numbers(*best.causes, cause)]
        after = best.left - slopes @ np.linalg.lstsq(slopes, best.left, rcond=None)[0]
        explained = self._squares(best.left) - self._squares(after)
        return bool(np.any(explained > LEAST_SUSPECT * TOLERATED)) and self._certain(
            self._moved(cause, best, cause, trusted=True)
        )

    def _matters(self, cause: str, found: _Place) -> bool:
        """Returns True if a cause explains more than the tolerated error of a twin."""
        back, scale = self._put_back(cause, found.truth), Scales(self._scales_of(found.apart))
        with_it, without = (softened(each, scale, self._rows) for each in self._replays([found.truth, back]))
        return bool(np.any(self._squares(without) - self._squares(with_it) > TOLERATED))

    def _as(self, causes: tuple[str, ...]) -> _Place:
        """Returns the most likely of all places reached so far, evaluated with exactly these causes free.

        A fit does not always reach its minimum, and the residuals of a sticking motor are partly random, so
        judging each set of causes only at the end of its own fit would be unfair. The result of a fit with
        more causes also supports fewer if the rest hardly moved, and a parameter that drifted in a fit with
        fewer may be a cause.
        """
        return min((replace(each, causes=causes) for each in self._reached), key=self._evidence)

    def _evidence(self, at: _Place) -> float:
        """Returns the negative log posterior of a place with the penalty of its causes; smaller is better.

        A place with scattered replays predicts less and is penalised for it. Residuals are clipped at `SOFT`:
        larger ones come from a motor that broke away at another time, and a few would outweigh all others.
        """
        left = np.minimum(np.abs(at.left), SOFT)
        others = self._numbers(*(each for each in self._causes if each not in at.causes))
        wide = 2.0 * float(np.sum(np.log(at.apart)))
        return 0.5 * (float(left @ left) + wide + self._pull(others, at) + sum(map(self._price, at.causes)))

    def _squares(self, left: FloatArray) -> FloatArray:
        """Returns the mean square by channel."""
        counts = np.bincount(self._channels, minlength=len(CHANNELS))
        sums = np.bincount(self._channels, np.square(left), minlength=len(CHANNELS))
        return np.asarray(sums / np.maximum(counts, 1), dtype=np.float64)

    def _certain(self, moved: _Moved) -> bool:
        """Returns True if a change is significant."""
        return float(chdtrc(len(moved.off), moved.distance)) < FALSE_ALARM / len(self._causes)

    def _significant(self, cause: str, at: _Place) -> bool:
        """Returns True if a cause's change is significant and as large as matters in practice."""
        moved = self._moved(cause, at)
        large = np.abs(moved.off) > np.maximum(self._least[self._numbers(cause)], 2.0 * moved.errors)
        return self._certain(moved) and bool(np.any(large))


def _shifted(truth: Truth, parameter: Parameter, by: float) -> Truth:
    """Returns the truth with one coordinate moved, within its bounds."""
    low, high = parameter.bounds
    (now,) = coordinates(truth, [parameter])
    return at_coordinates(truth, [parameter], [min(max(now + by, low), high)])
