"""Probability of a finding: a logistic function of the evidence for and against it.

`Scales` contains the coefficients. tools/fit_probabilities.py fits them, by ridge regression with fixed
signs, to findings with known causes from blind suites of bench plans and everyday records. docs/how-well.md
has the figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from hdbridge.analysis.acceptance import Gate
from hdbridge.analysis.findings import Finding
from hdbridge.analysis.scales import Scales

UNPROVEN = 0.5
"""Maximum probability of a cause that does not predict held-out data."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior of the causes, from other joints of a fleet (`hdbridge.fleet.prior`)."""

    right: Mapping[str, float]
    """Probability, by cause, that a finding of this cause is correct in a joint of this group."""
    words: Mapping[str, str]
    """Description of the prior by cause, for the output."""
    ranges: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict)
    """Median and standard deviation of a parameter over the joints, by cause and parameter name."""

    def log_odds(self, cause: str, scales: Scales) -> float:
        """Returns the log odds of a cause, less those in the records to which the formula was fitted."""
        share = self.right.get(cause, scales.right)
        return math.log(share / (1.0 - share)) - math.log(scales.right / (1.0 - scales.right))

    def narrowed(self, finding: Finding) -> Finding:
        """Combines a finding's parameters with their ranges in the fleet, unless the two disagree."""
        parameters = {
            name: each.combined(*self.ranges[finding.cause, name])
            if (finding.cause, name) in self.ranges
            else each
            for name, each in finding.parameters.items()
        }
        return replace(finding, parameters=parameters, prior=self.words.get(finding.cause, ""))


def coefficients(scales: Scales) -> dict[str, float]:
    """Returns the coefficient of each term, log odds per unit, by name."""
    return {
        "constant": scales.odds,
        "strength": scales.odds_strength,
        "rank": scales.odds_rank,
        "unexplained": scales.odds_unexplained,
    }


def features(gate: Gate, unexplained: bool, rank: float = 1.0) -> dict[str, float]:
    """Returns the terms of the formula by name.

    ``unexplained`` is True if the record has an unexplained residual. ``rank`` is the finding's decrease in
    chi square relative to that of the largest finding.
    """
    return {
        "constant": 1.0,
        "strength": math.log(max(gate.robust, 1e-9) / gate.needed),
        "rank": math.log10(max(rank, 1e-4)),
        "unexplained": float(unexplained),
    }


def weighed(
    findings: Sequence[Finding], unexplained: bool, scales: Scales, prior: Prior | None = None
) -> list[Finding]:
    """Returns the findings with the probability that each, or one of its aliases, is present."""
    largest = max((each.robust for each in findings), default=0.0)
    weighed = []
    for each in findings:
        assert each.gate is not None, "only an unexplained residual has no gate"
        rank = each.robust / max(largest, 1e-9)
        terms = features(each.gate, unexplained, rank)
        more = prior.log_odds(each.cause, scales) if prior else 0.0
        most = 0.0 if each.refuted else 1.0 if each.gains else UNPROVEN
        likely = min(probability(terms, scales, more), most)
        found = replace(each, probability=likely, terms=terms)
        weighed.append(prior.narrowed(found) if prior else found)
    return weighed


def probability(terms: Mapping[str, float], scales: Scales, prior: float = 0.0) -> float:
    """Returns the probability from the terms of the formula and the log odds of a prior."""
    return updated(sum(each * terms[name] for name, each in coefficients(scales).items()), prior, scales)


def updated(score: float, prior: float, scales: Scales) -> float:
    """Returns the probability from the log odds of the record (``score``) and of a prior.

    A prior cannot make a finding probable that the record alone does not support.
    """
    alone, most = 1.0 / (1.0 + math.exp(-score)), scales.surest
    if prior and alone < scales.named_from:
        most = 0.5
    return min(1.0 / (1.0 + math.exp(-score - prior)), most)
