"""Second looks at a name whose look-alike is the better one: what cannot be, what follows a measured channel,
and what another convention tells without a change of the model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdbridge.diagnose.search import Search
from hdbridge.effects import CATALOGUE, MEASURED, Effect, aliases_of, unmet
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.observed import Observed
from hdbridge.observations.reading import third_deviation


def plausible_only(search: Search, fitted: Fitted) -> Fitted:
    """With the best look-alike in the place of what is implausible as it has come out, or with nothing."""
    estimator = search.estimator
    base = fitted.hypothesis.effects[: search.base]
    for place in range(search.base, len(fitted.hypothesis.effects)):
        effect = fitted.hypothesis.effects[place]
        if not effect.implausible(estimator.data):
            continue
        without = estimator.fit(fitted.hypothesis.without(place))
        present = {each.name for each in without.hypothesis.effects}
        trials = [
            estimator.fit(fitted.hypothesis.instead(place, each))
            for name in aliases_of(effect.name)
            if name not in present and CATALOGUE[name].changes is None and CATALOGUE[name].sought is None
            for each in CATALOGUE[name].proposals(estimator.data, base)
            if not unmet([each], estimator.motion.available())
        ]
        fine = [
            each
            for each in trials
            if search.makes_sense(each.hypothesis.effects[place])
            and search.peak(each, place) >= search.scales.floor_arcsec
        ]
        best = min(fine, key=search.cost, default=without)
        return plausible_only(
            search, best if search.cost(best) + search.scales.enter < search.cost(without) else without
        )
    return fitted


def with_measured(estimator: Estimator, fitted: Fitted, base: int) -> Fitted:
    """What looks like a measured channel's effect, and follows the channel, is that effect.

    A wave takes any phase, a wind-up only that of the torque: where it does as well but for what the noise of
    the channel takes from it, the wave would be a coincidence. Together the wave makes up for that noise, and
    takes most of what is the other's.
    """
    effects, scales = fitted.hypothesis.effects, estimator.scales
    for place in range(base, len(effects)):
        for kind, piece in lookalikes(effects[place], estimator.data.ratio):
            others = [each for each in effects[place].pieces() if each != piece]
            rest = None
            for each in others:
                rest = each if rest is None else rest.joined(each)
            hypothesis = fitted.hypothesis
            without = hypothesis.without(place) if rest is None else hypothesis.instead(place, rest)
            present = [i for i, each in enumerate(without.effects) if i >= base and type(each) is kind]
            if present:
                trial, neither = estimator.fit(without), without.without(present[0])
            else:
                proposed = [
                    each
                    for each in kind.proposals(estimator.data, effects[:base])
                    if not unmet([each], estimator.motion.available())
                ]
                if not proposed:
                    continue
                # Each of its shapes: a spring that bends is not what a straight one leaves.
                trials = [estimator.fit(without.plus(each)) for each in proposed]
                fine = [each for each in trials if not each.hypothesis.effects[-1].violations()]
                trial = min(fine or trials, key=lambda each: each.chi_square + scales.penalty * each.free())
                neither = without
            own = estimator.fit(neither).chi_square - fitted.chi_square
            worse = trial.chi_square - fitted.chi_square
            driven = [each for each in trial.hypothesis.effects if type(each) is kind]
            if any(each.violations() for each in driven):
                continue
            if worse < scales.twin * own + scales.noisy * sum(
                _lost_to_noise(estimator, each) for each in driven
            ):
                return trial
    return fitted


def lookalikes(effect: Effect, ratio: float) -> list[tuple[type[Effect], Effect]]:
    """Kinds that look like a piece of an effect where their channel was not measured, and the piece."""
    result = []
    for name in aliases_of(effect.name):
        look = CATALOGUE[name].unmeasured(ratio) if name in CATALOGUE else None
        if look is None or look.name != effect.name:
            continue
        names = look.named_coefficients()
        result += [(CATALOGUE[name], each) for each in effect.pieces() if each.named_coefficients() == names]
    return result


def of_one_angle(data: Observed, one: Effect, other: Effect) -> bool:
    """Whether two kinds are waves over the same angle: no record distinguishes orders that both may have."""
    same = one.coordinate(data.motion, data.ratio).name == other.coordinate(data.motion, data.ratio).name
    return bool(same and one.waves() and other.waves() and other.name in aliases_of(one.name))


def as_calibrated(estimator: Estimator, fitted: Fitted, given: tuple[Effect, ...]) -> Fitted:
    """What can be told by several conventions, by the one that leaves the ``given`` model as it was.

    As it was, where there is none; see `Effect.retold`.
    """
    effects = fitted.hypothesis.effects
    for place in range(len(given), len(effects)):
        told = effects[place].retold(effects, given, estimator.data)
        if told is None:
            continue
        trial = estimator.fit(replace(fitted.hypothesis, effects=told))
        if (
            trial.chi_square < fitted.chi_square + estimator.scales.same
            and not trial.hypothesis.effects[place].violations()
        ):
            return trial
    return fitted


def _lost_to_noise(estimator: Estimator, effect: Effect) -> float:
    """Chi square that an effect leaves because its channel was measured with noise."""
    motion = estimator.motion
    shifted = {
        each: motion.measured[each] + third_deviation(np.diff(motion.measured[each], 3))
        for each in MEASURED
        if each in effect.needs()
    }
    moved = replace(motion, measured={**motion.measured, **shifted})
    change = (effect.predict(moved) - effect.predict(motion))[estimator.index]
    return float(np.sum((estimator.weight * change) ** 2))
