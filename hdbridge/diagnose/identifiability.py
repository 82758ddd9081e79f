"""What a record, measured or only planned, could say about each cause: detection limits and look-alikes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hdbridge.diagnose.lookalikes import lookalikes, waves_alike
from hdbridge.diagnose.result import Identifiability
from hdbridge.effects import CATALOGUE, Effect, FloatArray, causes
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.linear import orthonormal
from hdbridge.estimation.screening import candidates

# What a record could show: these numbers decide what is said of that, and no name.
ENOUGH = 8_000
"""Points that are enough to distinguish shapes."""
NOT_APART = 0.95
"""Canonical correlation from which on two causes cannot be distinguished."""
SHARE_LEFT = 1e-4
"""Share of a column's squares below which nothing is left of it."""
WORST_ARCSEC = 30.0
"""A cause whose limit is higher than this counts as not detectable."""
INFLATION = 2.5
"""By how much correlated noise and unknown shapes raise a limit above that of white noise and a known
shape."""


def identifiability(
    estimator: Estimator, fitted: Fitted, base: Sequence[Effect]
) -> dict[str, Identifiability]:
    """For each cause of the catalogue."""
    best: dict[str, tuple[float, float, FloatArray, Effect]] = {}
    stride = -(-len(estimator.index) // ENOUGH)
    # Leaving points out changes what a basis spans over them: made orthonormal anew.
    basis = orthonormal(fitted.linearised.basis[::stride])
    weight = estimator.weight[::stride, np.newaxis]
    for candidate in candidates(estimator.data, base, screened=False):
        columns = estimator.columns(candidate, fitted.hypothesis.start)
        low, high = np.quantile(columns, [estimator.rare, 1.0 - estimator.rare], axis=0)
        columns, span = columns[::stride], high - low
        seen = span > 1e-12
        if not np.any(seen):
            continue
        unit = weight * columns[:, seen] / (0.5 * span[seen])  # one arcsec at its peak
        rest = unit - basis @ (basis.T @ unit)
        squares = np.sum(rest**2, axis=0)
        size, share = np.sqrt(stride * np.max(squares)), np.max(squares / np.sum(unit**2, axis=0))
        if candidate.name not in best or size > best[candidate.name][0]:
            best[candidate.name] = float(size), float(share), rest, candidate
    spans = {name: orthonormal(rest) for name, (_, _, rest, _) in best.items()}
    result: dict[str, Identifiability] = {}
    for cause in causes():
        if cause not in best:
            result[cause] = Identifiability(False, None, (), 0.0, _missing(estimator, cause))
            continue
        size, share, rest, example = best[cause]
        if share < SHARE_LEFT or size <= 0.0:
            result[cause] = Identifiability(False, None, (), share, "the model's own parameters take it over")
            continue
        limit = max(
            INFLATION * math.sqrt(estimator.scales.penalty * rest.shape[1] + estimator.scales.enter) / size,
            estimator.scales.floor_arcsec,
        )
        own = [*type(example).proposals(estimator.data, ())]  # any of them may be the one
        waves = set(waves_alike(estimator, own, fitted.hypothesis.start))
        alike = [
            name
            for name in best
            if name != cause and (name in waves or _correlation(spans[cause], spans[name]) > NOT_APART)
        ]
        result[cause] = Identifiability(limit <= WORST_ARCSEC, limit, tuple(alike), share)
    for candidate in candidates(estimator.data, ()):
        # What is not measured may look like what is.
        each = result[candidate.name]
        for kind, _ in lookalikes(candidate, estimator.data.ratio):
            if kind.channels - estimator.motion.available() and kind.name not in each.aliases:
                result[candidate.name] = replace(each, aliases=(*each.aliases, kind.name))
    return result


def _missing(estimator: Estimator, cause: str) -> str:
    lacking = CATALOGUE[cause].channels - estimator.data.points.motion.available()
    if lacking:
        return "not recorded: " + ", ".join(sorted(each.value for each in lacking))
    return "nothing in this record or model to see it by"


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Smallest canonical correlation of the smaller space with the larger: all of it has to look alike."""
    values = np.linalg.svd(one.T @ other, compute_uv=False)
    return float(np.min(values)) if len(values) else 0.0
