"""What a search says: causes with their probabilities, sizes and aliases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from evidence.fit import Evidence, Fitted
from evidence.scales import Scales
from evidence.search import Search
from scipy.special import logsumexp

from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

KEPT = 10.0
"""Nats below the best, down to which a theory counts."""
NAMED = 0.5
"""What is more likely there than not is named."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found."""

    cause: str
    probability: float
    nats: float
    """By how much the evidence falls without it, as far as the search has seen."""
    aliases: tuple[str, ...]
    """What takes its place among the theories that were kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Findings, those that matter most first, and all that was considered."""

    findings: tuple[Finding, ...]
    probabilities: dict[str, float]
    """Of everything in any theory that was kept."""
    best: Fitted
    fits: int


def explained(record: Record, model: TransmissionModel, scales: Scales | None = None) -> Result:
    """Search one record for what differs from a model."""
    evidence = Evidence(record, model, scales)
    search = Search(evidence)
    best = search.run()
    return weighed(evidence, list(search.known.values()), best)


def weighed(evidence: Evidence, theories: Sequence[Fitted], best: Fitted) -> Result:
    """Probabilities from the theories that were fitted."""
    names = [each.theory.names(evidence.parts) for each in theories]
    nats = np.array([each.log_evidence for each in theories])
    weights = nats - best.log_evidence
    kept = np.flatnonzero(weights > -KEPT)
    share = np.exp(weights[kept] - logsumexp(weights[kept]))
    probabilities: dict[str, float] = {}
    for i, weight in zip(kept, share, strict=True):
        for name in names[i]:
            probabilities[name] = probabilities.get(name, 0.0) + float(weight)
    found = []
    top = best.theory.names(evidence.parts)
    for name, probability in probabilities.items():
        if probability >= NAMED:
            without = [nats[i] for i in range(len(nats)) if name not in names[i]]
            others = sorted({each for i in kept if name not in names[i] for each in names[i] - top})
            fall = best.log_evidence - max(without, default=-np.inf)
            found.append(Finding(name, min(probability, 1.0), float(fall), tuple(others)))
    found.sort(key=lambda each: -each.nats)
    return Result(tuple(found), probabilities, best, evidence.fits)
