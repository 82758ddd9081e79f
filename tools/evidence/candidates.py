"""What may be added to a theory: what the catalogue proposes, and what is sought over all places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from evidence.fit import Evidence, Fitted, Linearised
from evidence.theory import Theory

from hdbridge.diagnose import matched_filters
from hdbridge.effects import CATALOGUE, Effect, FloatArray, Part, Sought, causes, unmet
from hdbridge.estimation import linearised
from hdbridge.estimation.hypothesis import Hypothesis
from hdbridge.estimation.shapes import free_shapes
from hdbridge.estimation.terms import FOUND


@dataclass(frozen=True, slots=True)
class Candidate:
    """One effect that may be added."""

    effect: Effect
    places: float
    """At how many places it was looked for; a place that is a free shape counts by its prior."""


@dataclass(frozen=True, slots=True, eq=False)
class _Residual:
    """What a matched filter looks at."""

    hypothesis: Hypothesis
    zeros: FloatArray
    residual: FloatArray
    linearised: linearised.Linearised


class Screen:
    """The whitened columns of all that a grid covers, made once per theory's base and noise."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self._offered: dict[object, list[Candidate]] = {}
        self._whitened: dict[object, list[tuple[FloatArray, FloatArray, FloatArray]]] = {}

    def offered(self, theory: Theory) -> list[Candidate]:
        """Everything that the catalogue proposes beside a model."""
        data, base = self._evidence.data, self._evidence.model.effects
        key = (theory.start, theory.replaced)
        if key not in self._offered:
            available = data.motion.available()
            kinds = [CATALOGUE[each] for each in causes()]
            found = [
                each
                for kind in kinds
                if kind.sought is None and kind.changes is not Part.LOOP and kind.part is not Part.LOOP
                for each in kind.proposals(data, theory.effects[: len(base)])
                if not unmet([each], available)
            ]
            count = Counter(each.name for each in found)
            self._offered[key] = [
                Candidate(each, 1.0 if free_shapes(each, FOUND) else count[each.name]) for each in found
            ]
        return self._offered[key]

    def scores(self, fitted: Fitted) -> list[tuple[float, Candidate]]:
        """What each promises to add to the log evidence, odds included; best first, one for each cause."""
        evidence, theory = self._evidence, fitted.theory
        here = evidence.linearised(theory, fitted.wander)
        beside = here.posterior(fitted.slack)
        kernel = evidence.noise(fitted.wander)
        present = {each.name for each in theory.effects if each.usual == 1}
        key = (theory.start, theory.replaced, fitted.wander)
        offered = self.offered(theory)
        if key not in self._whitened:
            self._whitened[key] = [self._prepared(theory, each.effect, kernel.solve) for each in offered]
        trials = list(zip(offered, self._whitened[key], strict=True))
        for each in self._sought(fitted, here, beside.mean):
            trials.append((each, self._prepared(theory, each.effect, kernel.solve)))
        trials = [each for each in trials if each[0].effect.name not in present]
        solved = np.hstack([each[1][1] for each in trials])
        cross = here.against(solved)
        residual = here.left(here.mean)
        best: dict[str, tuple[float, Candidate]] = {}
        at = 0
        for candidate, (columns, whitened, gram) in trials:
            part = slice(at, at := at + columns.shape[1])
            moment = whitened.T @ residual
            gain = beside.gain(cross[:, part], gram, moment)
            gain += float(np.log(evidence.scales.odds) - np.log(candidate.places))
            if candidate.effect.name not in best or gain > best[candidate.effect.name][0]:
                best[candidate.effect.name] = (gain, candidate)
        return sorted(best.values(), key=lambda each: -each[0])

    def _prepared(
        self, theory: Theory, effect: Effect, solve: object
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        columns = self._evidence.estimator.columns(effect, theory.start)
        peak = np.max(np.abs(columns), axis=0, initial=0.0)
        size = self._evidence.scales.size_arcsec
        columns = columns * np.divide(size, peak, out=np.zeros_like(peak), where=peak > 0.0)
        whitened = solve(columns)  # type: ignore[operator]
        return columns, whitened, columns.T @ whitened

    def _sought(self, fitted: Fitted, here: Linearised, mean: FloatArray) -> Iterator[Candidate]:
        """Steps, bumps and lines, found on what the theory leaves, as if the noise were white."""
        evidence, theory = self._evidence, fitted.theory
        weight = evidence.estimator.weight
        scale = here.deviation * np.array([1.0, *fitted.slack])[here.group]
        tangent = here.columns() * weight[:, np.newaxis]
        known = np.divide(1.0, scale**2, out=np.full(len(scale), 1e12), where=scale > 0.0)
        residual = weight * here.left(mean)
        left = _Residual(
            Hypothesis(theory.effects, theory.start),
            mean[: evidence.data.full.zeros],
            residual,
            linearised.Linearised(tangent, residual, np.stack([known, np.zeros(len(known))], axis=1)),
        )
        for each in matched_filters.found(evidence.estimator, left):  # type: ignore[arg-type]
            places = 1.0
            if not free_shapes(each, FOUND):
                is_line = each.sought is Sought.LINE
                places = matched_filters.BINS / 2 if is_line else float(len(left.residual))
            yield Candidate(each, places)
