"""Probability of a finding: a logistic formula of the evidence for and against it.

`Scales` holds its coefficients. tools/fit_probabilities.py fits them, with a ridge and with fixed signs, on
the findings of two blind suites and of records from formulas, whose causes are known. docs/diagnosis.md
reports the cross-validation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hdbridge.analysis.findings import Finding
from hdbridge.analysis.scales import Scales

UNPROVEN = 0.5
"""Highest probability of a cause that does not predict data that were held out."""


@dataclass(frozen=True, slots=True)
class Context:
    """Evidence against all findings of a record."""

    left_arcsec: float
    """Root mean square of the residual beyond the noise."""
    excess: float
    """Chi square per point of the whole fit."""
    unexplained: bool


def coefficients(scales: Scales) -> dict[str, float]:
    """Returns the log odds per unit of each term, by name."""
    return {
        "constant": scales.odds,
        "strength": scales.odds_strength,
        "rank": scales.odds_rank,
        "size": scales.odds_size,
        "excess": scales.odds_excess,
        "unexplained": scales.odds_unexplained,
    }


def features(finding: Finding, largest: float, context: Context, scales: Scales) -> dict[str, float]:
    """Returns the terms of the formula by name; ``largest`` is the chi square of the largest finding."""
    gate = finding.gate
    assert gate is not None, "only an unexplained residual has no gate"
    return {
        "constant": 1.0,
        "strength": math.log(min(max(gate.robust, 1e-9) / gate.needed, scales.strong)),
        "rank": math.log10(max(finding.robust / max(largest, 1e-9), 1e-4)),
        "size": math.log(max(finding.peak_arcsec, 1e-3) / max(scales.floor_arcsec, context.left_arcsec)),
        "excess": math.log(min(max(context.excess, 1.0), scales.large)),
        "unexplained": float(context.unexplained),
    }


def weighed(findings: Sequence[Finding], context: Context, scales: Scales) -> list[Finding]:
    """Returns the findings with the probability that each (or one of its aliases) is present."""
    largest = max((each.robust for each in findings), default=0.0)
    terms = [features(each, largest, context, scales) for each in findings]
    return [
        replace(each, probability=min(probability(own, scales), 1.0 if each.gains else UNPROVEN), terms=own)
        for each, own in zip(findings, terms, strict=True)
    ]


def probability(terms: Mapping[str, float], scales: Scales) -> float:
    """Returns the probability from the terms of the formula."""
    score = sum(each * terms[name] for name, each in coefficients(scales).items())
    return min(1.0 / (1.0 + math.exp(-score)), scales.surest)
