"""Best-first search over theories: add, drop, swap; every theory within ten nats of the best is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from evidence.candidates import Screen
from evidence.fit import Evidence, Fitted
from evidence.noise import Wander
from evidence.smooth import coordinates
from evidence.theory import IN_TIME, Theory

from hdbridge.effects import Part, Start

TRIED = 4
"""Candidates that are fitted at each step: the best of as many causes."""
HOPELESS = -4.0
"""Nats: what promises less, linearised at zero, is not fitted."""
WORTH = 0.3
"""... nor what promises less than this share of the best."""
SURELY = 1.0
"""Nats by which a larger theory has to be better, so that a search ends."""
MOST = 4
"""Causes at most."""


class Search:
    """One search on one record."""

    def __init__(self, evidence: Evidence, progress: Callable[[str], None] = lambda _: None) -> None:
        self._evidence = evidence
        self._screen = Screen(evidence)
        self._progress = progress
        self.known: dict[object, Fitted] = {}
        """Every theory that was fitted, the best of each kind."""

    def run(self) -> Fitted:
        """The best theory; all others are in `known`."""
        effects = tuple(self._evidence.model.effects)
        starts = [self._fit(Theory(effects, len(effects), each)) for each in Start]
        best = max(starts, key=lambda each: each.log_evidence)
        self.known = {best.theory.key: best}
        best = self._climbed(best)
        best = self._with_unknown(best)
        for _ in range(2):
            other = self._swapped(best)
            if other is best:
                break
            best = self._climbed(other)
        return best

    def _fit(self, theory: Theory, like: Fitted | None = None) -> Fitted:
        """A theory at its best, from where it stands; not from scratch where its kind is known already."""
        wander: Wander | None = like.wander if like else None
        fitted = self._evidence.fit(theory, wander, like.slack if like else None)
        key = fitted.theory.key
        if key not in self.known or fitted.log_evidence > self.known[key].log_evidence:
            self.known[key] = fitted
        self._progress(f"{fitted.log_evidence:10.1f} {sorted(fitted.theory.names(self._evidence.parts))}")
        return fitted

    def _climbed(self, best: Fitted) -> Fitted:
        """With whatever raises the evidence, one at a time, and then without what does not any more."""
        while True:
            trials = [self._fit(each, best) for each in self._larger(best)]
            there = max(trials, key=lambda each: each.log_evidence, default=best)
            if there.log_evidence > best.log_evidence + SURELY:
                best = there
                continue
            there = self._pruned(best)
            if there is best:
                return best
            best = there

    def _larger(self, best: Fitted) -> list[Theory]:
        """Theories with one thing more that promise something."""
        theory = best.theory
        found: list[Theory] = []
        if len(theory.causes) < MOST:
            scores = self._screen.scores(best)[:TRIED]
            least = max(HOPELESS, WORTH * scores[0][0]) if scores else HOPELESS
            found = [theory.plus(each.effect, each.places) for promise, each in scores if promise > least]
        found += self._changes(best)
        return found

    def _changes(self, best: Fitted) -> list[Theory]:
        """Theories in which a part of the model has changed, or its loop obeys another law."""
        evidence, theory = self._evidence, best.theory
        has_loop = any(each.part is Part.LOOP for each in theory.effects[: theory.base])
        trials = [
            replace(theory, changed=theory.changed | {number})
            for number in range(len(evidence.parts))
            if number not in theory.changed
        ]
        if has_loop and not theory.lawless:
            trials.append(replace(theory, lawless=True))
        here = evidence.peek(theory, best)
        found = [each for each in trials if evidence.peek(each, best) - here > HOPELESS]
        if not theory.replaced:
            first = not theory.causes
            found += [each for each in theory.other_laws() if first or evidence.peek(each, best) > here]
        return found

    def _smaller(self, best: Fitted) -> list[Theory]:
        theory = best.theory
        found = [theory.without(at) for at in range(len(theory.causes))]
        found += [replace(theory, changed=theory.changed - {each}) for each in theory.changed]
        if theory.lawless:
            found.append(replace(theory, lawless=False))
        if theory.replaced:
            found += theory.other_laws()
        return found

    def _pruned(self, best: Fitted) -> Fitted:
        """Without what the evidence does not need; of one thing alone that is known already."""
        while len(smaller := self._smaller(best)) > 1 or best.theory.unknown:
            known = [self.known.get(each.key) or self._fit(each, best) for each in smaller]
            there = max(known, key=lambda each: each.log_evidence, default=best)
            if there.log_evidence <= best.log_evidence:
                return best
            best = there
        return best

    def _with_unknown(self, best: Fitted) -> Fitted:
        """With something unknown, where that raises the evidence once the catalogue has done what it can."""
        names = [IN_TIME, *coordinates(self._evidence.data)]
        promising = [IN_TIME]
        here = self._evidence.peek(best.theory, best)
        for each in names[1:]:
            if self._evidence.peek(replace(best.theory, unknown=each), best) > here:
                promising.append(each)
        trials = [self._fit(replace(best.theory, unknown=each), best) for each in promising]
        there = max(trials, key=lambda each: each.log_evidence)
        if there.log_evidence <= best.log_evidence:
            return best
        return self._climbed(self._pruned(there))

    def _swapped(self, best: Fitted) -> Fitted:
        """Whatever else does as well in the place of each cause; the best of all, itself where it stays."""
        found = best
        for smaller in self._smaller(best):
            without = self.known.get(smaller.key) or self._fit(smaller, best)
            for each in self._larger(without):
                if each.key not in self.known:
                    trial = self._fit(each, without)
                    found = max(found, trial, key=lambda one: one.log_evidence)
        return found
