"""Second looks at a name whose look-alike is the better one: what cannot be, what follows a measured channel,
and what another convention tells without a change of the model.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace

import numpy as np

from hdbridge.diagnose.search import Search
from hdbridge.effects import CATALOGUE, Effect, Part, Start, aliases_of, unmet
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.linear import orthonormal


def plausible_only(search: Search, fitted: Fitted) -> Fitted:
    """With the best look-alike in the place of what is refused as it has come out, or with nothing."""
    estimator = search.estimator
    base = fitted.hypothesis.effects[: search.base]
    for place in range(search.base, len(fitted.hypothesis.effects)):
        effect = fitted.hypothesis.effects[place]
        reason = effect.implausible(estimator.data) or effect.unidentifiable(estimator.data)
        if not reason:
            continue
        search.refusals[effect.name] = reason
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
            if not search.refusal(each.hypothesis.effects[place])
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
                trial = estimator.fit(without)
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
            worse = trial.chi_square - fitted.chi_square
            driven = [each for each in trial.hypothesis.effects if type(each) is kind]
            if any(each.violations() for each in driven):
                continue
            start = trial.hypothesis.start
            lost = sum(estimator.channel_noise(each, start) @ each.coefficients() ** 2 for each in driven)
            if worse < scales.enter + scales.noisy * float(lost):
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


def waves_alike(estimator: Estimator, effects: Sequence[Effect], start: Start) -> Iterator[str]:
    """Other kinds of waves that have hardly parted from any of some effects of one kind, in all the record.

    Over the same angle it is enough that both may have the orders. On an arc of a turn different orders
    cancel each other, so what counts there is how large they are, not what they do.
    """
    data, most = estimator.data, estimator.scales.in_step
    effects = [each for each in effects if each.waves()]
    if not effects:
        return
    angle = effects[0].coordinate(data.motion, data.ratio).name
    for name in aliases_of(effects[0].name):
        kind = CATALOGUE.get(name)
        proposed = [] if kind is None else [*kind.proposals(data, ())]
        near = [each for each in proposed if each.waves() and each.part is not Part.LOOP]
        if not near:
            continue
        if near[0].coordinate(data.motion, data.ratio).name == angle:
            orders = {turns for each in near for turns, _, _ in each.waves()}
            if any(_share_in(each, orders) > most for each in effects):
                yield name
            continue
        seen = orthonormal(np.hstack([estimator.columns(each, start) for each in near]))
        for each in effects:
            does = estimator.columns(each, start) @ each.coefficients()
            does -= np.mean(does)
            if float(np.sum((seen.T @ does) ** 2)) > most * float(does @ does):
                yield name
                break


def _share_in(effect: Effect, orders: Container[float]) -> float:
    """Of its waves, the share of the squares that is in some orders."""
    squares = {turns: amplitude**2 for turns, amplitude, _ in effect.waves()}
    return sum(each for turns, each in squares.items() if turns in orders) / max(
        sum(squares.values()), 1e-300
    )


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
            trial.chi_square < fitted.chi_square + estimator.scales.enter
            and not trial.hypothesis.effects[place].violations()
        ):
            return trial
    return fitted
