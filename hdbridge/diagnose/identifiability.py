"""What a record, measured or only planned, could say about each cause: detection limits and look-alikes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hdbridge.diagnose.candidates import candidates
from hdbridge.diagnose.result import Identifiability
from hdbridge.diagnose.search import ENTER, FLOOR_ARCSEC, PENALTY
from hdbridge.effects import (
    CATALOGUE,
    Compliance,
    CountLoss,
    Effect,
    FloatArray,
    LocalDefect,
    MotorEncoderEccentricity,
    Step,
    SubdivisionalError,
    Vibration,
    causes,
)
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import orders_from
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.screening import Candidate

ENOUGH = 8_000
"""Points that are enough to distinguish shapes."""
NOT_APART = 0.95
"""Canonical correlation from which on two causes cannot be distinguished."""
SHARE_LEFT = 1e-4
WORST_ARCSEC = 30.0
"""A cause whose limit is higher than this counts as not detectable."""
INFLATION = 2.5
"""By how much correlated noise and unknown shapes raise a limit above that of white noise and a known
shape."""
ALWAYS = {"motor_order": ("motor_encoder_eccentricity",), "motor_encoder_eccentricity": ("motor_order",)}


def identifiability(
    estimator: Estimator, fitted: Fitted, base: Sequence[Effect]
) -> dict[str, Identifiability]:
    """For each cause of the catalogue."""
    left: dict[str, list[tuple[FloatArray, float, float, int]]] = {}
    stride = -(-len(estimator.index) // ENOUGH)
    # Leaving points out changes what a basis spans over them: made orthonormal anew.
    basis = _orthonormal(fitted.basis[::stride])
    weight = estimator.weight[::stride, np.newaxis]
    for candidate in _specimens(estimator, fitted, base):
        columns = estimator.columns(candidate.effect, fitted.hypothesis.start)[::stride]
        span = np.quantile(columns, 0.998, axis=0) - np.quantile(columns, 0.002, axis=0)
        seen = span > 1e-12
        if not np.any(seen):
            continue
        unit = weight * columns[:, seen] / (0.5 * span[seen])  # one arcsec at its peak
        rest = unit - basis @ (basis.T @ unit)
        share = float(np.max(np.sum(rest**2, axis=0) / np.sum(unit**2, axis=0)))
        size = float(np.sqrt(stride * np.max(np.sum(rest**2, axis=0))))
        left.setdefault(candidate.cause, []).append((rest, share, size, rest.shape[1]))
    names = list(left)
    best = {name: max(left[name], key=lambda each: each[2]) for name in names}
    spans = {name: _orthonormal(best[name][0]) for name in names}
    result: dict[str, Identifiability] = {}
    for cause in causes():
        if cause not in best:
            result[cause] = Identifiability(False, None, (), 0.0, _missing(estimator, cause))
            continue
        _, share, size, freedom = best[cause]
        if share < SHARE_LEFT or size <= 0.0:
            result[cause] = Identifiability(False, None, (), share, "the model's own parameters take it over")
            continue
        limit = max(INFLATION * math.sqrt(PENALTY * freedom + ENTER) / size, FLOOR_ARCSEC)
        alike = [
            name for name in names if name != cause and _correlation(spans[cause], spans[name]) > NOT_APART
        ]
        alike += [name for name in ALWAYS.get(cause, ()) if name not in alike]
        result[cause] = Identifiability(limit <= WORST_ARCSEC, limit, tuple(alike), share)
    if not estimator.data.points.motion.available() & frozenset(Compliance.channels):
        each = result["load_order"]
        if "compliance" not in each.aliases:
            result["load_order"] = Identifiability(
                each.detectable,
                each.detection_limit_arcsec,
                (*each.aliases, "compliance"),
                each.share_left,
                each.reason,
            )
    return result


def _specimens(estimator: Estimator, fitted: Fitted, base: Sequence[Effect]) -> list[Candidate]:
    data = estimator.data
    time = estimator.time_s
    ratio = data.ratio
    load = float(np.median(estimator.motion.motor_deg)) / ratio
    found = candidates(data, base)
    middle = float(np.quantile(time, 0.5))
    lines = round(
        360.0 / max(float(np.median(np.abs(np.diff(estimator.motion.motor_deg)))) / ratio * 2.7, 0.02)
    )
    fast = 0.137 / max(data.period_s, 1e-6)
    found += [
        Candidate(each.name, each)
        for each in (
            CountLoss(steps=(Step(time_s=middle, size_arcsec=1.0),)),
            LocalDefect(ratio=ratio, height_arcsec=1.0, centre_deg=load % 360.0, half_width_deg=3.6),
            Vibration(frequency_hz=min(max(fast, 0.3), 40.0), amplitude_arcsec=1.0, phase_deg=0.0),
            SubdivisionalError(lines_per_turn=max(lines, 1800), orders=orders_from([1])),
            MotorEncoderEccentricity(orders=orders_from([1, 2])),
        )
    ]
    for effect in fitted.hypothesis.effects[: len(base)]:
        if isinstance(effect, Hysteresis | HysteresisMemory):
            found += _loops(effect)
    return found


def _loops(law: Hysteresis | HysteresisMemory) -> list[Candidate]:
    """The loop itself stands for its parameters, the other law for memory."""
    other = HysteresisMemory if isinstance(law, Hysteresis) else Hysteresis
    return [
        Candidate("hysteresis_memory", other(**law.parameters())),
        Candidate("hysteresis_parameters", law.model_copy(update={"width_deg": 1.6 * law.width_deg})),
    ]


def _missing(estimator: Estimator, cause: str) -> str:
    lacking = CATALOGUE[cause].channels - estimator.data.points.motion.available()
    if lacking:
        return "not recorded: " + ", ".join(sorted(each.value for each in lacking))
    return "nothing in this record or model to see it by"


def _orthonormal(columns: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-8 * max(float(values[-1]), 1e-300)
    return np.asarray(columns @ (vectors[:, kept] / np.sqrt(values[kept])))


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Smallest canonical correlation of the smaller space with the larger: all of it has to look alike."""
    values = np.linalg.svd(one.T @ other, compute_uv=False)
    return float(np.min(values)) if len(values) else 0.0
