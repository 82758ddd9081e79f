"""Second looks at a name whose look-alike is the better one: what follows a measured channel, and what
another convention tells without a change of the model.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace

import numpy as np

from hdbridge.diagnose.search import Search
from hdbridge.effects import CATALOGUE, Effect, Part, Start, aliases_of
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.linear import orthonormal
from hdbridge.estimation.screening import proposed


def with_measured(search: Search, fitted: Fitted) -> Fitted:
    """What looks like a measured channel's effect, and follows the channel, is that effect.

    A wave takes any phase, a wind-up only that of the torque: where it does as well but for what the noise of
    the channel takes from it, the wave would be a coincidence. Together the wave makes up for that noise, and
    takes most of what is the other's.
    """
    estimator, scales, base = search.estimator, search.scales, search.base
    hypothesis = fitted.hypothesis
    for place, effect in enumerate(hypothesis.effects[base:], base):
        for kind, piece in lookalikes(effect, estimator.data.ratio):
            others = [each for each in effect.pieces() if each != piece]
            without = hypothesis.instead(place, together(others)) if others else hypothesis.without(place)
            tried = [without]
            if not any(type(each) is kind for each in without.effects[base:]):
                # Each of its shapes: a spring that bends is not what a straight one leaves.
                own = proposed(kind, estimator.data, hypothesis.effects[:base])
                tried = [without.plus(each) for each in own]
            for trial in sorted((estimator.fit(each) for each in tried), key=search.cost):
                driven = [each for each in trial.hypothesis.effects if type(each) is kind]
                if any(each.violations() for each in driven):
                    continue
                start = trial.hypothesis.start
                lost = sum(estimator.channel_noise(each, start) @ each.coefficients() ** 2 for each in driven)
                if trial.chi_square - fitted.chi_square < scales.enter + scales.noisy * float(lost):
                    return trial
                break
    return fitted


def together(pieces: Sequence[Effect]) -> Effect:
    """One effect of several pieces of it."""
    whole = pieces[0]
    for each in pieces[1:]:
        both = whole.joined(each)
        assert both is not None, "pieces of one effect join"
        whole = both
    return whole


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
        own = [] if kind is None else [*kind.proposals(data, ())]
        near = [each for each in own if each.waves() and each.part is not Part.LOOP]
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
