"""How sure a name is: a logistic formula of what speaks for it and against it.

The coefficients are fitted, with a ridge and each with the sign that it must have, by
tools/fit_probabilities.py on the findings of two blind suites and of records from formulas, whose causes are
known; what came of it in cross-validation stands in docs/diagnosis.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from hdbridge.estimation.scales import Scales

if TYPE_CHECKING:
    from hdbridge.diagnose.result import Finding

LEAST, MOST = 0.02, 0.97
"""Nothing is ruled out. And the rules were made on records that the formula is fitted to: elsewhere it is a
little less sure."""
STRONG = 2.5
"""Observed beyond twelve times the needed says that something is there, not what it is."""
MOST_EXCESS = 1.5
"""Beyond this, what counts is how much is left in addition to a finding and not how quiet the record is."""
COEFFICIENTS: Final = {
    "constant": -2.80,
    "strength": 1.88,
    "rank": 0.42,
    "size": 1.22,
    "excess": -1.19,
    "unexplained": -1.30,
    "not_recovered": -2.50,
}
"""Fitted to 128 names, 115 of them right, in 62 cases of the blind suites of seeds 11 and 2077 and in 40
records from formulas. For `not_recovered` it is what was set by hand: no such name was among them. Three more
terms (the margin over the next rival, a loop of free form, a change within the model) had come out as 0.01,
-0.17 and -0.05. They were dropped: without them no probability of 66 names in 52 fresh records moves by more
than 0.05.
"""


@dataclass(frozen=True, slots=True)
class Signs:
    """What speaks for one finding."""

    robust: float
    """Block-robust chi square."""
    needed: float
    recovered: float
    """Share of the variance that it takes away on held-out data."""


@dataclass(frozen=True, slots=True)
class Context:
    """What speaks against all findings of a record."""

    left_arcsec: float
    """Root mean square that is left beyond the noise."""
    excess: float
    """Chi square per point of the whole fit."""
    unexplained: bool


def features(
    finding: Finding, all_of_them: Sequence[Finding], context: Context, scales: Scales
) -> dict[str, float]:
    """The terms of the formula, by their names."""
    signs = finding.signs or Signs(finding.robust, scales.robust, 1.0)
    largest = max(each.robust for each in all_of_them)
    return {
        "constant": 1.0,
        "strength": min(math.log(max(signs.robust, 1e-9) / signs.needed), STRONG),
        "rank": math.log10(max(finding.robust / max(largest, 1e-9), 1e-4)),
        "size": math.log(max(finding.peak_arcsec, 1e-3) / max(scales.floor_arcsec, context.left_arcsec)),
        "excess": min(math.log(max(context.excess, 1.0)), MOST_EXCESS),
        "unexplained": float(context.unexplained),
        "not_recovered": float(signs.recovered <= 0.0),
    }


def weighed(findings: Sequence[Finding], context: Context, scales: Scales) -> list[Finding]:
    """The findings with the probability that each (or one of its aliases) is there."""
    terms = [features(each, findings, context, scales) for each in findings]
    return [
        replace(each, probability=_logistic(own), terms=own)
        for each, own in zip(findings, terms, strict=True)
    ]


def _logistic(terms: dict[str, float]) -> float:
    score = sum(COEFFICIENTS[name] * value for name, value in terms.items())
    return limited(1.0 / (1.0 + math.exp(-score)))


def limited(probability: float) -> float:
    """A probability that rules nothing out."""
    return min(max(probability, LEAST), MOST)
