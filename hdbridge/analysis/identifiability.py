"""Determines the detection limit and aliases of each cause in a measured or planned record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from hdbridge.analysis.acceptance import Gate, gate, gate_of_change
from hdbridge.analysis.capability import Capability, Identifiability, capability
from hdbridge.analysis.changes import causes_of
from hdbridge.analysis.hypothesis import Estimator, Fitted, Hypothesis, with_memory
from hdbridge.analysis.linear import Effort, on_one_thread, orthonormal, side_by_side
from hdbridge.analysis.orders import NOT_APART
from hdbridge.analysis.prepared import gather
from hdbridge.analysis.probability import features, probability
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.screening import SHARE_LEFT, candidates
from hdbridge.analysis.search import lookalikes, waves_alike
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, Motion, Part, Sought, Start, causes
from hdbridge.axis.model import TransmissionModel
from hdbridge.motion.procedures.moves import AxisView, MotionLimits
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import legs_of
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.units import ARCSEC_PER_DEG

# Thresholds of identifiability; they do not affect findings.
ENOUGH = 8_000
"""Maximum number of points used in comparing the causes' columns."""
WORST_ARCSEC = 30.0
"""Detection limit above which a cause counts as undetectable."""
PEAKS = 80
"""Number of peaks tried, up to `WORST_ARCSEC`, each about 5 % larger than the last."""
VISIBLE = 0.36
"""Evidence that nine of ten instances of a cause provide, relative to the most visible instance with the same
peak, in standard deviations. Measured on 67 causes that were found in blind suites."""
POWER = 2.0
"""Margin of the evidence at the detection limit above the required evidence, standard deviations. With this
margin, noise hides 2 % of causes at the limit."""


def identifiability(
    estimator: Estimator, fitted: Fitted, base: Sequence[Effect], unexplained: bool
) -> dict[str, Identifiability]:
    """Returns the detection limit and aliases of each cause of the catalogue.

    ``estimator`` contains the record less the errors found in it, and ``fitted`` is the fit of the model to
    that record. ``unexplained`` is True if the record has an unexplained residual.
    """
    best, reasons = _examples(estimator, fitted, base)
    scales, spans = estimator.scales, {name: orthonormal(each.rest) for name, each in best.items()}
    usual = _usual_changes_arcsec(estimator, base, fitted.hypothesis.start)
    result: dict[str, Identifiability] = {}
    for cause in causes():
        if cause not in best:
            result[cause] = Identifiability(
                False, None, (), 0.0, reasons.get(cause) or _missing(estimator, cause)
            )
            continue
        example = best[cause]
        share, strength = example.share, example.strength
        if share < SHARE_LEFT or strength <= 0.0:
            result[cause] = Identifiability(False, None, (), share, "the model's own parameters absorb it")
            continue
        visible = VISIBLE * strength
        limit = max(
            (math.sqrt(scales.penalty * example.rest.shape[1] + scales.enter) + POWER) / visible,
            estimator.floor_arcsec + POWER / visible,
            _named_from(_injected(estimator, fitted, example, base), unexplained, scales),
            usual.get(cause, 0.0),
        )
        own = [*type(example.effect).proposals(estimator.data, ())]  # each is a possible instance
        waves = set(waves_alike(estimator, own, fitted.hypothesis.start))
        alike = [
            name
            for name in best
            if name != cause and (name in waves or _correlation(spans[cause], spans[name]) > NOT_APART)
        ]
        known = limit if limit < math.inf else None
        result[cause] = Identifiability(limit <= WORST_ARCSEC, known, tuple(alike), share)
    for cause, each in result.items():
        # A tone resembles a wave over an angle only at one frequency, which no example has.
        tones = [name for name in each.aliases if CATALOGUE[name].sought is Sought.TONE]
        for tone in tones:
            result[tone] = replace(result[tone], aliases=tuple(dict.fromkeys((*result[tone].aliases, cause))))
    for candidate in candidates(estimator.data, ()):
        # An effect that needs a missing channel may resemble a visible one.
        each = result[candidate.name]
        for kind, _ in lookalikes(candidate, estimator.data.ratio):
            if kind.channels - estimator.motion.available() and kind.name not in each.aliases:
                result[candidate.name] = replace(each, aliases=(*each.aliases, kind.name))
    return result


class _Example(NamedTuple):
    """Most visible candidate effect of a cause in a record."""

    effect: Effect
    per_arcsec: FloatArray
    """Coefficients with which the effect's peak is one arcsec, shape (p,)."""
    rest: FloatArray
    """Weighted columns with peaks of one arcsec, less the parts explained by the background, (m, k)."""
    strength: float
    """Square root of the chi square of an effect with a peak of one arcsec."""
    share: float
    """Largest fraction of a column's sum of squares that the background does not explain."""


def _examples(
    estimator: Estimator, fitted: Fitted, base: Sequence[Effect]
) -> tuple[dict[str, _Example], dict[str, str]]:
    """Returns the best example of each visible cause, and the reasons why other causes are invisible."""
    best: dict[str, _Example] = {}
    reasons: dict[str, str] = {}
    stride = -(-len(estimator.index) // ENOUGH)
    background = _Background(estimator, fitted, base, stride)
    start, weight = fitted.hypothesis.start, estimator.weight[::stride, np.newaxis]
    for candidate in candidates(estimator.data, base, screened=False):
        reasons[candidate.name] = candidate.unidentifiable(estimator.data)
        columns = _columns(estimator, candidate, base, start)
        low, high = np.quantile(columns, [estimator.rare, 1.0 - estimator.rare], axis=0)
        half_span = 0.5 * (high - low)
        seen = half_span > 1e-12
        if reasons[candidate.name] or not np.any(seen):
            continue
        unit = weight * columns[::stride, seen] / half_span[seen]
        rest = background.left(candidate, unit)
        if candidate.tracker().memory_deg > 0.0:
            before = background.left(candidate, weight * _before(estimator, candidate, base, start)[::stride])
            before = orthonormal(before)
            rest = rest - before @ (before.T @ rest)
        squares = np.sum(rest**2, axis=0)
        strength = float(np.sqrt(stride * np.max(squares)))
        if candidate.name not in best or strength > best[candidate.name].strength:
            per_arcsec = np.zeros(len(seen))
            column = np.flatnonzero(seen)[np.argmax(squares)]
            per_arcsec[column] = 1.0 / half_span[column]
            share = float(np.max(squares / np.sum(unit**2, axis=0)))
            best[candidate.name] = _Example(candidate, per_arcsec, rest, strength, share)
    return best, reasons


def _columns(estimator: Estimator, candidate: Effect, base: Sequence[Effect], start: Start) -> FloatArray:
    """Returns a candidate's columns in arcsec, shape (m, p).

    If the candidate is the change of a part, returns a single column, the change in the part's error.
    """
    columns = estimator.columns(candidate, start)
    if candidate.changes is None:
        return columns
    change = columns @ candidate.coefficients()
    if candidate.replaces:
        change = change - sum(
            estimator.columns(each, start) @ each.coefficients()
            for each in base
            if each.name == candidate.replaces
        )
    return np.asarray(change[:, np.newaxis])


def _before(estimator: Estimator, candidate: Effect, base: Sequence[Effect], start: Start) -> FloatArray:
    """Returns the changes in a candidate's columns with different initial elastic states, shape (m, k)."""
    own = _columns(estimator, candidate, base, start)
    others = [_columns(estimator, candidate, base, each) - own for each in Start if each is not start]
    return side_by_side(others, len(estimator.index))


def _injected(estimator: Estimator, fitted: Fitted, example: _Example, base: Sequence[Effect]) -> Gate:
    """Injects a cause with a peak of `WORST_ARCSEC` into the record, and runs its acceptance tests."""
    effect, start = example.effect, fitted.hypothesis.start
    contribution = WORST_ARCSEC * (_columns(estimator, effect, base, start) @ example.per_arcsec)
    if effect.changes is not None:
        given = replace(fitted, residual=fitted.residual + estimator.weight * contribution)
        return gate_of_change(estimator, fitted, given)
    record = copy(estimator)
    record.observed = estimator.observed + contribution
    trial = record.fit(fitted.hypothesis.plus(effect), effort=Effort(steps=1))
    return gate(record, trial, len(fitted.hypothesis.effects))


def _named_from(injected: Gate, unexplained: bool, scales: Scales) -> float:
    """Returns the smallest peak, arcsec, at which a cause passes its tests and is probable; or infinity."""
    per_arcsec = VISIBLE * math.sqrt(max(injected.robust, 0.0)) / WORST_ARCSEC
    for peak_arcsec in np.geomspace(scales.floor_arcsec, WORST_ARCSEC, PEAKS).tolist():
        robust = max(peak_arcsec * per_arcsec - POWER, 0.0) ** 2
        terms = features(replace(injected, robust=robust), unexplained)
        if robust >= injected.needed and probability(terms, scales) > 0.5:
            return float(peak_arcsec)
    return math.inf


def _usual_changes_arcsec(estimator: Estimator, base: Sequence[Effect], start: Start) -> dict[str, float]:
    """Returns, by cause, the smallest change of a loop that exceeds the usual deviation, arcsec."""
    scales = estimator.scales
    return {
        cause.name: 0.5
        * float(np.ptp(estimator.contribution(given, start)))
        * scales.calibrations
        * scales.calibrated
        for given in reversed(base)  # if there are several loops, use the first
        if given.part is Part.LOOP
        for cause in causes_of(given, given.fitted(2.0 * given.coefficients()))
    }


class _Background:
    """Columns that explain a record without new causes: model, earlier motion, turning-point errors."""

    def __init__(self, estimator: Estimator, fitted: Fitted, base: Sequence[Effect], stride: int) -> None:
        start = fitted.hypothesis.start
        before = [
            estimator.weighted(estimator.columns(each, other) - estimator.columns(each, start))
            for each in with_memory(base)
            for other in Start
            if other is not start
        ]
        further = side_by_side([*before, estimator.turn_discrepancy(base, start)], len(estimator.index))
        self._estimator, self._stride = estimator, stride
        self._columns = side_by_side(
            [fitted.tangent[::stride], further[::stride]], len(fitted.residual[::stride])
        )
        self._part = [None if each.effect < 0 else base[each.effect].part for each in fitted.parameters]
        self._part += [None] * further.shape[1]
        self._bases: dict[tuple[Part | None, str], FloatArray] = {}

    def left(self, candidate: Effect, columns: FloatArray) -> FloatArray:
        """Returns the part of a candidate's columns (m, k) that the background does not explain.

        Rows in which the candidate is not visible are zero. For a change of a part of the model, only the
        rest of the model belongs to the background.
        """
        stretch = candidate.shows(self._estimator.motion)
        rows = np.ones(len(columns), dtype=bool)
        if stretch is not None:
            rows = stretch.rows[self._estimator.index][:: self._stride]
        key = candidate.changes, stretch.otherwise if stretch else ""
        if key not in self._bases:
            kept = [part is None or part is not candidate.changes for part in self._part]
            self._bases[key] = orthonormal(self._columns[:, kept] * rows[:, np.newaxis])
        basis, columns = self._bases[key], columns * rows[:, np.newaxis]
        return np.asarray(columns - basis @ (basis.T @ columns))


def _missing(estimator: Estimator, cause: str) -> str:
    lacking = CATALOGUE[cause].channels - estimator.data.points.motion.available()
    if lacking:
        return "not recorded: " + ", ".join(sorted(each.value for each in lacking))
    return "nothing in this record or model shows it"


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Returns the smallest canonical correlation between two spaces, given by orthonormal bases."""
    values = np.linalg.svd(one.T @ other, compute_uv=False)
    return float(np.min(values)) if len(values) else 0.0


@on_one_thread
def examined(
    record: Record, model: TransmissionModel, legs: Sequence[Segment] = (), start: Start = Start.VIRGIN
) -> tuple[dict[str, Identifiability], Capability]:
    """Returns the identifiability of each cause in a record, present or not, and its summary."""
    data = gather(record, model.ratio, legs, expected=lambda motion: model.predict(motion, start))
    estimator = Estimator(data)
    fitted = estimator.fit(Hypothesis(model.effects, start), effort=Effort(steps=2))
    found = identifiability(estimator, fitted, model.effects, False)
    return found, capability(data, model.effects, found, estimator.scales)


# Planned records: identifiability in a simulated record.


PERIOD_S: Final = 0.04
NOISE_ARCSEC: Final = 0.5
"""Standard deviation of the assumed white noise of a planned record, with one sample every `PERIOD_S`."""
LIMITS: Final = MotionLimits(-400.0, 400.0, 20.0, 200.0, 4000.0)
"""Load-side motion limits that are assumed if no axis is given."""


def plan_report(plan: Plan, model: TransmissionModel, limits: MotionLimits = LIMITS) -> dict[str, Any]:
    """Returns the identifiability of each cause in a record of this plan, and the plan's duration."""
    view = AxisView(model.ratio, limits)
    tasks = plan.tasks(view)
    places: list[float] = []
    legs: list[Segment] = []
    for task in tasks.tasks:
        for move, path in legs_of(task.procedure, view, places[-1] if places else 0.0):
            count, first = max(1, round(path.duration_s / PERIOD_S)), len(places)
            places += [path.at(path.duration_s * i / count) for i in range(1, count + 1)]
            end_s = (len(places) - 1) * PERIOD_S
            legs.append(Segment(kind=move.kind, start_s=first * PERIOD_S, end_s=end_s, notes={}))
    time = np.arange(len(places), dtype=np.float64) * PERIOD_S
    motor = np.array(places) * model.ratio
    start = Start.FORWARD
    motion = Motion(motor, time_s=time)
    error = model.predict(motion, start)
    rng = np.random.default_rng(0)
    load = motor / model.ratio + (error + NOISE_ARCSEC * rng.standard_normal(len(time))) / ARCSEC_PER_DEG
    record = Record(
        {"time_s": time, "motor_position_deg": motor, "load_position_deg": load, "motor_target_deg": motor}
    )
    found, shown = examined(record, model, legs, start)
    return {
        "schema": "hdbridge.plan-diagnosis/1",
        "plan": plan.name,
        "duration_s": float(time[-1]),
        "noise_arcsec": NOISE_ARCSEC,
        "record": shown.as_dict(),
        "identifiability": {name: each.as_dict() for name, each in found.items()},
        "notes": list(tasks.notes),
    }
