"""Greedy search for causes.

Each round screens all candidates, fits the best few in full and adds the best one. `Scales` defines the
required gain of a cause. After each of the first additions, the hysteresis law is chosen again. At the end,
causes whose gain has fallen below the required gain are removed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from hdbridge.analysis.acceptance import all_pieces_seen, evident, gate
from hdbridge.analysis.hypothesis import Estimator, Fitted, Hypothesis
from hdbridge.analysis.linear import orthonormal, unknown
from hdbridge.analysis.screening import Score, Screen, candidates, filtered, proposed, score_of
from hdbridge.axis.effects import (
    CATALOGUE,
    Channel,
    Effect,
    FloatArray,
    Motion,
    Part,
    Sought,
    Start,
    aliases_of,
    in_place,
)
from hdbridge.units import DEG_PER_TURN

MOST = 6
BEST = 3
"""Limits on the run time: at most `MOST` additions, and at most `BEST` causes fitted for each addition."""
LAW_ROUNDS = 3
"""Number of initial additions after each of which the hysteresis law is chosen again."""


class Search:
    """Search for causes in one record, starting from the effects of a given model."""

    def __init__(self, estimator: Estimator, base: Sequence[Effect]) -> None:
        self.estimator = estimator
        self.scales = estimator.scales
        self.base = len(base)
        """Number of baseline effects, which are the first effects of every hypothesis."""
        self._base = tuple(base)
        self._screens: dict[object, Screen] = {}
        self.refusals: dict[str, str] = {}
        """Reason for rejecting each cause that improved the fit, by cause."""
        self._stopped: set[str] = set()
        """Causes that failed a test of the result and are not added again."""
        law = next((each for each in self._base if each.part is Part.LOOP), None)
        if law is not None:
            estimator.loop_sign = -1.0 if law.coefficients()[0] < 0.0 else 1.0

    def run(self, begun: Fitted) -> Fitted:
        """Adds causes to the fit of the model alone (`begun`), best first, then removes superfluous ones."""
        fitted = self.with_best_law(self._with_best_sign(begun))
        for number in range(MOST):
            found = self._best_addition(fitted)
            if number < LAW_ROUNDS and fitted.hypothesis.nuisances is None:
                loose = self._with_free_loop(fitted, found)
                if loose is not None:
                    fitted = self.with_best_law(loose)
                    continue
            if found is None:
                break
            left = found.chi_square
            slow = left > self.scales.slow * fitted.chi_square
            fitted = found
            if number >= self.scales.few - 1 and slow and left > self.scales.large * len(found.residual):
                break  # many small effects approximate a cause that is not in the catalogue
            if number < LAW_ROUNDS:
                fitted = self.with_best_law(fitted)
        if len(fitted.hypothesis.effects) - self.base <= self.scales.few:
            fitted = self._swapped(fitted)
        return self.with_best_law(self.eliminated(fitted, self._least, []))

    def instead(self, fitted: Fitted, stopped: Iterable[str]) -> Fitted:
        """Replaces the causes in ``stopped``, which failed a test of the result, by other causes."""
        self._stopped.update(stopped)
        while len(fitted.hypothesis.effects) < self.base + MOST:
            found = self._best_addition(fitted)
            if found is None:
                break
            fitted = found
        return self.with_best_law(self.eliminated(fitted, self._least, []))

    def begun(self) -> Fitted:
        """Fits the model alone, with the best initial elastic state."""
        fits = [self.estimator.fit(Hypothesis(self._base, start)) for start in Start]
        return min(fits, key=lambda each: each.chi_square)

    def _with_best_sign(self, known: Fitted) -> Fitted:
        """Fits the model with the better sign of the hysteresis loop.

        The sign is reversed if this explains more than the model's sign together with the best cause. Play,
        for example, also makes the load lag.
        """
        loops = [each for each in known.hypothesis.effects if each.part is Part.LOOP]
        if self.estimator.data.reversals < 2 or not loops or any(each.coefficients()[0] for each in loops):
            return known  # a coefficient other than zero confirms the model's sign
        self.estimator.loop_sign *= -1.0
        other = self.begun()
        self.estimator.loop_sign *= -1.0
        rival = self._best_addition(known) or known
        if self.cost(other) + self.scales.enter < self.cost(rival):
            self.estimator.loop_sign *= -1.0
        return self.begun()

    def with_best_law(self, fitted: Fitted) -> Fitted:
        """Replaces the hysteresis law by an alternative law if that fits better.

        A law other than the model's must be better by the required gain of a cause.
        """
        for place, effect in enumerate(fitted.hypothesis.effects[: self.base]):
            laws = in_place(effect, CATALOGUE.values()) if effect.part is Part.LOOP else ()
            if laws:
                trials = [self.estimator.fit(fitted.hypothesis.instead(place, law)) for law in laws]
                return min(
                    (fitted, *trials), key=lambda each: each.chi_square + self._toll_of_law(each, place)
                )
        return fitted

    def _toll_of_law(self, fitted: Fitted, place: int) -> float:
        same = type(fitted.hypothesis.effects[place]) is type(self._base[place])
        return 0.0 if same else self.scales.enter + self.scales.penalty

    def _with_free_loop(self, fitted: Fitted, found: Fitted | None) -> Fitted | None:
        """Adds a free-form hysteresis to the fit; returns None if the best cause explains more."""
        free = self.estimator.free_loop(fitted.hypothesis.start)
        loose = self.estimator.fit(replace(fitted.hypothesis, nuisances=free))
        added = loose.free() - fitted.free()
        gain = fitted.chi_square - loose.chi_square - self.scales.penalty * added - self.scales.enter
        rival = 0.0 if found is None else fitted.chi_square - found.chi_square
        return loose if gain > max(rival, 0.0) else None

    # --- revision

    def _swapped(self, fitted: Fitted) -> Fitted:
        """Replaces each finding in turn by the best alternative if that lowers the cost.

        The comparison includes the entry penalty of every addition that built the finding, because the
        replacement is a single addition.
        """
        for place in range(self.base, len(fitted.hypothesis.effects)):
            if place >= len(fitted.hypothesis.effects):
                break  # the replacement was merged into an existing finding
            further = self._additions(fitted.hypothesis.effects[place]) - 1
            most = self.cost(fitted) + self.scales.enter * further
            without = self.with_best_law(self.estimator.fit(fitted.hypothesis.without(place)))
            other = self._best_addition(without)
            if other is not None and self.cost(other) < most:
                fitted = other
        return fitted

    def _additions(self, effect: Effect) -> int:
        """Returns the number of additions that built a finding.

        Orders are added one at a time, or in groups if a cause proposes groups.
        """
        offered = next(iter(type(effect).proposals(self.estimator.data, ())), effect)
        return max(1, len(effect.pieces()) // max(1, len(offered.pieces())))

    def eliminated(
        self, fitted: Fitted, worst: Callable[[Fitted], tuple[int, str] | None], reasons: list[str]
    ) -> Fitted:
        """Removes causes one by one, with a refit after each, until ``worst`` returns None.

        ``worst`` returns the index of the cause to remove and the reason. The reason is appended to
        ``reasons``.
        """
        while len(fitted.hypothesis.effects) > self.base and (found := worst(fitted)) is not None:
            place, why = found
            reasons.append(f"{fitted.hypothesis.effects[place].name}: {why}")
            fitted = self.estimator.fit(fitted.hypothesis.without(place))
        return fitted

    def _least(self, fitted: Fitted) -> tuple[int, str] | None:
        """Returns the weakest cause if its gain is insufficient or its peak is below the floor; else None."""
        effects = fitted.hypothesis.effects
        gains = {
            place: self._lacking(fitted, place).chi_square - fitted.chi_square
            for place in range(self.base, len(effects))
        }
        toll = {each: self.scales.penalty * len(fitted.places(each)) + self.scales.enter for each in gains}
        place = min(gains, key=lambda each: gains[each] - toll[each])
        small = self.peak(fitted, place) < self.estimator.floor_arcsec
        # The law error of a large effect resembles a small effect of the same kind.
        alike = [each for each in gains if each != place and effects[each].name == effects[place].name]
        share = effects[place].inexact * max((gains[each] for each in alike), default=0.0)
        needed = max(toll[place], self.scales.leftover * max(gains.values()), share)
        return None if gains[place] > needed and not small else (place, "")

    def _lacking(self, fitted: Fitted, place: int) -> Fitted:
        """Fits without an effect, but with its incidental columns, which other causes may also produce."""
        effect, hypothesis = fitted.hypothesis.effects[place], fitted.hypothesis.without(place)
        columns = sorted(set(range(len(effect.coefficients()))) - set(evident(effect)))
        if columns:
            stays = self.estimator.columns(effect, hypothesis.start)[:, columns]
            more = unknown(stays, [f"{effect.name} {each}" for each in columns])
            known = hypothesis.nuisances
            hypothesis = replace(hypothesis, nuisances=more if known is None else known.and_also(more))
        return self.estimator.fit(hypothesis)

    # --- addition of a cause

    def _best_addition(self, fitted: Fitted) -> Fitted | None:
        """Adds the best acceptable cause and refits; returns None if no cause improves the fit enough.

        Rejections are not final, because a rejected cause may be acceptable after a later addition.
        """
        scores = [each for each in self._scores(fitted) if each.effect.name not in self._stopped]
        refused = set[object]()
        while shortlist := self._shortlist(fitted, [each for each in scores if _key(each) not in refused]):
            best: tuple[float, Fitted] | None = None
            for score in shortlist:
                cause = score.effect.name
                trial = self._with(fitted, score)
                toll = self.scales.penalty * max(trial.free() - fitted.free(), 1) + self.scales.enter
                net = self._gain(fitted, trial, cause) - toll
                none = net <= 0.0 or self._too_small(trial, cause)
                reason = "" if none else self._refusal(trial, cause)
                if reason:
                    self.refusals[cause] = reason
                if none or reason:
                    refused.add(_key(score))
                elif best is None or net > best[0]:
                    best = (net, trial)
            if best is not None:
                return best[1]
        return None

    def _gain(self, fitted: Fitted, trial: Fitted, cause: str) -> float:
        """Returns the decrease in chi square due to the last effect with the name ``cause`` in ``trial``."""
        place = _last(trial, cause)
        incidental = trial.hypothesis.effects[place].incidental
        lacking = self._lacking(trial, place).chi_square if incidental else math.inf
        return min(lacking, fitted.chi_square) - trial.chi_square

    def _too_small(self, trial: Fitted, cause: str) -> bool:
        """Returns True if the peak of the last effect of this cause is too small to be relevant."""
        return self.peak(trial, _last(trial, cause)) < self.estimator.floor_arcsec

    def _refusal(self, trial: Fitted, cause: str, as_alias: bool = False) -> str:
        """Returns the reason to reject the last effect of this cause; empty if it is acceptable.

        The effect must be physically possible and visible in the record. An alias need not be identifiable,
        and the record need not determine its size.
        """
        place = _last(trial, cause)
        effect = trial.hypothesis.effects[place]
        other = effect.reparametrised(trial.hypothesis.effects, self._base, self.estimator.data)
        trial = trial if other is None else trial.having(other)
        effect = trial.hypothesis.effects[place]
        reason = self.refusal(effect, as_alias)
        if not reason and not as_alias and self._extrapolated(trial, place):
            reason = "the record shows too little of it to determine its size"
        elif (
            not reason and Channel.TIME in effect.needs() and effect.shows(self.estimator.motion) is not None
        ):
            # A time-dependent effect can occur at any time. If it fails its acceptance tests, it imitates
            # some other cause, which would not be found with this one in the fit.
            reason = gate(self.estimator, trial, place).reason
            if not reason and not all_pieces_seen(self.estimator, trial, place):
                reason = "part of it may be an error of a larger one"
        return reason

    def _extrapolated(self, trial: Fitted, place: int) -> bool:
        """Returns True if an effect or a component of it far exceeds its visible net contribution.

        Components of one effect, two effects, or an effect and a change of the model can cancel at the
        positions that the record covers. The net contribution is therefore the smallest sum of all effects of
        this kind with any other effect.
        """
        effects, start = trial.hypothesis.effects, trial.hypothesis.start
        contribution = [self.estimator.contribution(each, start) for each in effects]
        for at, given in enumerate(self._base):
            contribution[at] = contribution[at] - self.estimator.contribution(given, start)
        alike = [at for at in range(self.base, len(effects)) if effects[at].name == effects[place].name]
        both = [np.sum([contribution[each] for each in {*alike, at}], axis=0) for at in range(len(effects))]
        seen, own = min(map(self.estimator.half_span, both)), self.estimator.half_span(contribution[place])
        return max(effects[place].largest_piece_arcsec(), own) > self.scales.extrapolated * seen

    def refusal(self, effect: Effect, as_alias: bool = False) -> str:
        """Returns the reason to reject an effect with its fitted parameters; empty if it is acceptable.

        An alias is rejected only if it is physically impossible, not if it is unidentifiable.
        """
        if violations := effect.violations():
            return f"it fits best with impossible parameters: {violations[0]}"
        data = self.estimator.data
        return effect.implausible(data) or ("" if as_alias else effect.unidentifiable(data))

    def reported_refusals(self, fitted: Fitted) -> list[str]:
        """Returns the rejections to report.

        These concern aliases of the causes found, and causes that would still improve the ``fitted``
        hypothesis enough, according to their linearised gain.
        """
        if not self.refusals:
            return []
        causes = {each.name for each in fitted.hypothesis.effects[self.base :]}
        asked = {alias for cause in causes for alias in aliases_of(cause)}
        asked |= {
            each.effect.name
            for each in self._scores(fitted)
            if each.gain > self.scales.penalty * each.freedom + self.scales.enter
        }
        reported = asked - causes
        return [f"{cause}: {why}" for cause, why in self.refusals.items() if cause in reported]

    def peak(self, fitted: Fitted, *places: int) -> float:
        """Returns half the peak-to-peak sum of the effects at ``places``, arcsec, excluding rare extremes."""
        effects, start = fitted.hypothesis.effects, fitted.hypothesis.start
        return self.estimator.half_span(
            np.sum([self.estimator.contribution(effects[at], start) for at in places], axis=0)
        )

    def _shortlist(self, fitted: Fitted, scores: Sequence[Score], left_out: str = "") -> list[Score]:
        """Returns, for each of the best causes, the best candidate with each number of parameters.

        A candidate with more parameters may become better only when its shape parameters are fitted.
        """
        passed = {each.name for each in fitted.hypothesis.effects if each.usual == 1} | {left_out}
        net = {id(each): each.gain - self.scales.penalty * each.freedom for each in scores}
        best: dict[tuple[str, int], Score] = {}
        for each in sorted(scores, key=lambda each: -net[id(each)]):
            enough = net[id(each)] > self.scales.enter and each.effect.name not in passed
            explained = each.effect.waves() and each.share < self.scales.wave_share_left
            if enough and not explained:
                best.setdefault((each.effect.name, each.freedom), each)
        causes = list(dict.fromkeys(cause for cause, _ in best))[:BEST]
        return [each for (cause, _), each in best.items() if cause in causes]

    def _scores(self, fitted: Fitted) -> list[Score]:
        fit, causes = fitted.linearised, fitted.without_parts(self.base)
        scores = self._screen(fitted).scores(fit, causes)
        for effect in filtered(self.estimator, fitted):
            columns = self.estimator.columns(effect, fitted.hypothesis.start)
            scores.append(score_of(effect, self.estimator.weighted(columns), fit, causes))
        return scores

    def _screen(self, fitted: Fitted) -> Screen:
        base = fitted.hypothesis.effects[: self.base]
        key = (fitted.hypothesis.start, tuple(type(each) for each in base))
        if key not in self._screens:
            offered = candidates(self.estimator.data, base)
            self._screens.clear()
            self._screens[key] = Screen(self.estimator, offered, fitted.hypothesis.start)
        return self._screens[key]

    def cost(self, fitted: Fitted) -> float:
        """Returns chi square plus the penalty for the free parameters."""
        return fitted.chi_square + self.scales.penalty * fitted.free()

    def alternatives_to_change(self, fitted: Fitted, place: int, given: Effect) -> list[str]:
        """Returns the causes that explain the data as well as a change of the model's part at ``place``."""
        with self.held({place}):
            return self.equal_alternatives(fitted, self.with_given(fitted, place, given), given.name)

    def with_given(self, fitted: Fitted, place: int, given: Effect) -> Fitted:
        """Refits with the model part at ``place`` fixed exactly as ``given``."""
        with self.held({place}):
            return self.estimator.fit(fitted.hypothesis.instead(place, given))

    @contextmanager
    def held(self, places: Set[int]) -> Iterator[None]:
        """Fixes the model parts at ``places`` at their given values (context manager)."""
        known = self.estimator.calibrated
        self.estimator.calibrated = tuple(each.as_given() if each.place in places else each for each in known)
        try:
            yield
        finally:
            self.estimator.calibrated = known

    def equal_alternatives(self, fitted: Fitted, without: Fitted, cause: str) -> list[str]:
        """Returns other causes that fit nearly as well as ``cause``, best first.

        ``without`` is the fit without that cause.
        """
        most = self.cost(fitted) + self.margin(fitted, without)
        best: dict[str, Fitted] = {}
        for score in self._shortlist(without, self._scores(without), cause):
            name = score.effect.name
            trial = self._with(without, score)
            if self.cost(trial) >= (self.cost(best[name]) if name in best else most):
                continue
            if self._gain(without, trial, name) < self.scales.enter:
                continue
            if not (self._too_small(trial, name) or self._refusal(trial, name, as_alias=True)):
                best[name] = trial
        return sorted(best, key=lambda each: best[each].chi_square)

    def margin(self, fitted: Fitted, without: Fitted) -> float:
        """Returns the margin of cost within which an alternative counts as fitting as well as ``fitted``.

        ``without`` is the fit without the cause to be replaced.
        """
        # A residual above the noise means that neither fit is complete, so the margin is wider.
        excess = max(fitted.chi_square / max(len(fitted.residual) - fitted.free(), 1), 1.0)
        return self.scales.enter * excess + self.scales.alias * (without.chi_square - fitted.chi_square)

    def _with(self, fitted: Fitted, score: Score) -> Fitted:
        return self.estimator.fit(joined(fitted.hypothesis, score.effect, self.base))


def joined(hypothesis: Hypothesis, effect: Effect, base: int) -> Hypothesis:
    """Adds an effect to a hypothesis; merges it into an existing finding if the two can be joined."""
    for place in range(base, len(hypothesis.effects)):
        both = hypothesis.effects[place].joined(effect)
        if both is not None:
            return hypothesis.instead(place, both)
    return hypothesis.plus(effect)


def _last(fitted: Fitted, cause: str) -> int:
    """Returns the index of the last effect of this cause."""
    effects = fitted.hypothesis.effects
    return next(i for i in range(len(effects) - 1, -1, -1) if effects[i].name == cause)


def _key(score: Score) -> object:
    """Returns the key of a candidate: kind, coefficient names and degrees of freedom."""
    effect = score.effect
    if effect.sought is not None:
        return effect.name
    return (effect.name, tuple(each.name for each in effect.named_coefficients()), score.freedom)


# Replacement of a finding by an alias that describes it better.


def with_measured(search: Search, fitted: Fitted) -> Fitted:
    """Replaces a wave by a similar effect of a measured channel if that effect fits as well.

    A wave can have any phase, but a wind-up has the phase of the torque. If the wind-up fits as well, apart
    from the loss due to the channel's noise, it is the cause. If both were fitted together, the wave would
    compensate for that noise and absorb most of the wind-up.
    """
    estimator, scales, base = search.estimator, search.scales, search.base
    hypothesis = fitted.hypothesis
    for place, effect in enumerate(hypothesis.effects[base:], base):
        for kind, piece in lookalikes(effect, estimator.data.ratio):
            others = [each for each in effect.pieces() if each != piece]
            without = hypothesis.instead(place, together(others)) if others else hypothesis.without(place)
            bare = estimator.fit(without)
            tried = [bare]
            if not any(type(each) is kind for each in without.effects[base:]):
                # All proposals are tried, because a non-linear spring differs from a linear one.
                own = proposed(kind, estimator.data, hypothesis.effects[:base])
                tried = [estimator.fit(without.plus(each)) for each in own]
            for trial in sorted(tried, key=search.cost):
                driven = [each for each in trial.hypothesis.effects if type(each) is kind]
                if any(each.violations() for each in driven):
                    continue
                start = trial.hypothesis.start
                lost = sum(estimator.channel_noise(each, start) @ each.coefficients() ** 2 for each in driven)
                most = search.cost(fitted) + search.margin(fitted, bare) + scales.noisy * float(lost)
                if search.cost(trial) < most:
                    return trial
                break
    return fitted


def together(pieces: Sequence[Effect]) -> Effect:
    """Joins several components into one effect."""
    whole = pieces[0]
    for each in pieces[1:]:
        both = whole.joined(each)
        assert both is not None, "pieces of one effect join"
        whole = both
    return whole


def lookalikes(effect: Effect, ratio: float) -> list[tuple[type[Effect], Effect]]:
    """Returns the kinds that would resemble a component of the effect if their channel were not recorded.

    Each kind is paired with that component.
    """
    result = []
    for name in aliases_of(effect.name):
        look = CATALOGUE[name].unmeasured(ratio) if name in CATALOGUE else None
        if look is None or look.name != effect.name:
            continue
        names = look.named_coefficients()
        result += [(CATALOGUE[name], each) for each in effect.pieces() if each.named_coefficients() == names]
    return result


def waves_alike(estimator: Estimator, effects: Sequence[Effect], start: Start) -> Iterator[str]:
    """Yields the other kinds of waves that are not separable from one of the effects, which are of one kind.

    Kinds over the same angle are similar if both can have the same orders. Over a fraction of a turn
    different orders cancel, so their amplitudes are compared, not their sum. A wave over an angle is compared
    with a wave in time at the frequency that corresponds to the median speed, because at a single speed the
    two are the same.
    """
    data, most = estimator.data, estimator.scales.in_step
    effects = [each for each in effects if each.waves()]
    if not effects:
        return
    angle = effects[0].coordinate(data.motion, data.ratio).name

    def span(near: Sequence[Effect]) -> FloatArray:
        return orthonormal(np.hstack([estimator.columns(each, start) for each in near]))

    def alike(effect: Effect, seen: FloatArray) -> bool:
        contribution = estimator.columns(effect, start) @ effect.coefficients()
        contribution -= np.mean(contribution)
        return float(np.sum((contribution @ seen) ** 2)) > most * float(contribution @ contribution)

    for name in aliases_of(effects[0].name):
        kind = CATALOGUE.get(name)
        if kind is not None and kind.sought is Sought.TONE:
            if any(alike(each, span(at)) for each in effects if (at := in_time(kind, each, data.motion))):
                yield name
            continue
        own = [] if kind is None else [*kind.proposals(data, ())]
        near = [each for each in own if each.waves() and each.part is not Part.LOOP]
        if near and near[0].coordinate(data.motion, data.ratio).name == angle:
            orders = {turns for each in near for turns, _, _ in each.waves()}
            if any(_share_in(each, orders) > most for each in effects):
                yield name
        elif near:
            seen = span(near)
            if any(alike(each, seen) for each in effects):
                yield name


def in_time(kind: type[Effect], effect: Effect, motion: Motion) -> list[Effect]:
    """Returns tones of a ``kind`` with the frequencies that an effect's waves have at the median speed."""
    speed = motion.motor_speed_deg_s
    if speed is None or not np.any(speed):
        return []
    example = kind.candidate(1.0)
    turns_s = float(np.median(np.abs(speed[speed != 0.0]))) / DEG_PER_TURN
    return [
        example.fitted(example.coefficients(), {kind.shape[0].name: turns * turns_s})
        for turns, _, _ in effect.waves()
    ]


def _share_in(effect: Effect, orders: Container[float]) -> float:
    """Returns the fraction of an effect's summed squared amplitudes that the given orders contribute."""
    squares = {turns: amplitude**2 for turns, amplitude, _ in effect.waves()}
    return sum(each for turns, each in squares.items() if turns in orders) / max(
        sum(squares.values()), 1e-300
    )


def as_calibrated(estimator: Estimator, fitted: Fitted, given: tuple[Effect, ...]) -> Fitted:
    """Chooses the one of several equivalent parametrisations that keeps the ``given`` model.

    Returns ``fitted`` unchanged if there is no equivalent one. See `Effect.reparametrised`.
    """
    effects = fitted.hypothesis.effects
    for place in range(len(given), len(effects)):
        reparametrised = effects[place].reparametrised(effects, given, estimator.data)
        if reparametrised is None:
            continue
        trial = estimator.fit(replace(fitted.hypothesis, effects=reparametrised))
        if (
            trial.chi_square < fitted.chi_square + estimator.scales.enter
            and not trial.hypothesis.effects[place].violations()
        ):
            return trial
    return fitted
