"""From a measurement and a model to a diagnosis: the steps in their order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.diagnose import changes
from hdbridge.diagnose.acceptance import Gate, gate
from hdbridge.diagnose.backward import reconsidered
from hdbridge.diagnose.experiment import for_unexplained, next_experiment
from hdbridge.diagnose.extend import as_named, extended_model, supported
from hdbridge.diagnose.holdout import held_out
from hdbridge.diagnose.identifiability import identifiability
from hdbridge.diagnose.lookalikes import (
    as_calibrated,
    lookalikes,
    plausible_only,
    waves_alike,
    with_measured,
)
from hdbridge.diagnose.parameters import covariance, parameters_of
from hdbridge.diagnose.precise import precisely
from hdbridge.diagnose.probability import Context, Signs, weighed
from hdbridge.diagnose.result import UNWEIGHED, Diagnosis, Figures, Finding, Traces
from hdbridge.diagnose.search import Search, Trail
from hdbridge.diagnose.systematic import confounded
from hdbridge.diagnose.unexplained import (
    Rest,
    acts,
    beyond_noise,
    elsewhere,
    is_unexplained,
    many_of_one,
    rest,
    without_doubtful_loops,
)
from hdbridge.diagnose.unfitted import unfitted
from hdbridge.effects import Channel, FloatArray, Part, Start, unmet
from hdbridge.effects.base import missing_error
from hdbridge.effects.kinematics import direction_of
from hdbridge.effects.torque import beyond_limit
from hdbridge.estimation.calibration import calibrated
from hdbridge.estimation.hypothesis import Estimator, Fitted, Hypothesis
from hdbridge.estimation.observed import gather
from hdbridge.estimation.scales import Scales
from hdbridge.estimation.stretches import about_zeros
from hdbridge.model import TransmissionModel
from hdbridge.observations.cuts import observed
from hdbridge.observations.foreign import check_once, check_records, zeros_apart_arcsec
from hdbridge.records.given import Given, agreed_ratio, by_name
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording

FIT_FIRST = "none yet: fit a model first (hdbridge fit), then diagnose with it"


def diagnose(
    recording: Given,
    model: TransmissionModel,
    *,
    independent_zeros: bool = False,
    progress: Callable[[str], None] = lambda _: None,
    scales: Scales | None = None,
) -> Diagnosis:
    """Say how the model differs from one or several recordings, and why; ``.as_dict()`` is the document.

    ``independent_zeros`` says that the encoders' zeros were lost between them. ``progress`` receives what is
    being done, in words. ``scales`` are the numbers that
    decide, where they shall be others. InputError where a
    recording is too short, was made by no axis of the model's ratio, or lacks a channel that the model needs.
    """
    recordings = by_name(recording)
    agreed_ratio(recordings, [(str(model.path or "the model"), model.ratio)])
    check_once(list(recordings), [each.record for each in recordings.values()])
    check_records({name: each.record for name, each in recordings.items()}, model.ratio)
    whole = Recording.joined(list(recordings.values()))
    record, legs = whole.record, whole.segments
    remarks = (
        () if independent_zeros else _of_zeros(observed(record, model.ratio).record.parts(), model.ratio)
    )
    lacking = unmet(model.effects, record.motion().available() | {Channel.LOAD_ANGLE})
    for name, channels in lacking.items():
        if channels:
            raise missing_error(name, channels)
    progress("preparing the record")
    data = gather(
        record, model.ratio, legs, independent_zeros, lambda motion: model.predict(motion, Start.VIRGIN)
    )
    estimator = Estimator(data, scales or Scales())
    estimator.calibrated = calibrated(
        model.effects,
        model.uncertainty,
        lambda effect: estimator.columns(effect, Start.VIRGIN),
        estimator.scales,
    )
    search = Search(estimator, model.effects)
    first = unfitted(estimator, model.effects)
    held = beyond_limit(model.effects, data.full.motion)
    data = replace(data, remarks=(*((first,) if first else ()), *held, *data.remarks))
    estimator.data = data
    progress("searching for causes")
    trail = reconsidered(search, search.run())
    progress("judging what was found")
    found = _Judge(estimator, search, trail, model, record, bool(first)).diagnosis()
    return replace(found, remarks=(*remarks, *found.remarks))


def _of_zeros(parts: Sequence[Record], ratio: float) -> tuple[str, ...]:
    """A remark where the zeros of the recordings do not agree."""
    apart = zeros_apart_arcsec(parts, ratio)
    if apart is None:
        return ()
    return (
        f"the zeros of the records are {apart:.0f} arcsec apart, more than their own errors: if the "
        "encoders' zeros were lost between them, say so (on the command line: --independent-zeros)",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    fitted: Fitted
    """Without a loop of free form."""
    findings: list[Finding]
    left: Rest
    spread: FloatArray
    considered: list[str]


@dataclass(frozen=True, slots=True, eq=False)
class _Judge:
    estimator: Estimator
    search: Search
    trail: Trail
    model: TransmissionModel
    record: Record
    unfitted: bool
    """Whether the model lacks most of what the axis has."""

    def diagnosis(self) -> Diagnosis:
        estimator, trail, base = self.estimator, self.trail, self.trail.base
        fitted, considered = self._named_only(trail.fitted)
        fitted, more = self._without_doubtful(fitted)
        considered += more
        fitted = plausible_only(self.search, fitted)
        fitted = with_measured(estimator, fitted, trail.base)
        fitted = as_calibrated(estimator, fitted, self.model.effects)
        judged = self._likely_only(fitted)
        fitted, left, spread = judged.fitted, judged.left, judged.spread
        usual = {each.cause for each in judged.findings if _ordinary(each)}
        findings = [each for each in judged.findings if each.cause not in usual]
        considered += [*judged.considered, *(f"{cause}: no more than usual" for cause in sorted(usual))]
        known = {each.cause for each in findings} | {each.split(":")[0] for each in considered}
        refused = self.search.told_refusals(fitted)
        considered += [each for each in refused if each.split(":")[0] not in known]
        findings = self._with_unexplained(findings, left)
        reason = "diagnosis: " + (", ".join(each.cause for each in findings) or "nothing found, refitted")
        given, refitted = (
            self._as_given(),
            estimator.fit(Hypothesis(self.model.effects, fitted.hypothesis.start)),
        )
        honest = as_named(estimator, fitted, self.model.effects, {each.cause for each in findings})
        if honest is not fitted:
            fitted, spread = honest, covariance(estimator, honest)
        alone = {each.cause for each in findings if each.left_alone}
        sound = supported(estimator, fitted, self.model.effects, alone)
        fitted = replace(fitted, hypothesis=replace(fitted.hypothesis, effects=sound))
        named = {each.cause for each in findings if not each.within}
        chosen = [place for place in range(base, len(sound)) if sound[place].name in named]
        extended = extended_model(self.model, fitted, chosen, spread, reason, base)
        after = self._about_zeros(estimator.told(extended.effects, fitted.hypothesis.start))
        fitted = replace(fitted, residual=after * estimator.weight)
        points = estimator.data.points
        return Diagnosis(
            baseline=_figures(given),
            refitted=_figures(refitted.residual / estimator.weight),
            extended=_figures(after),
            noise_floor_arcsec=float(np.sqrt(np.mean(points.sigma_arcsec[estimator.index] ** 2))),
            findings=tuple(findings),
            identifiability=identifiability(estimator, fitted, self.model.effects),
            by_kind=self._by_kind(given, after),
            remarks=estimator.data.remarks,
            model=extended,
            traces=self._traces(fitted, given),
            considered=tuple(dict.fromkeys(considered)),
            scales=estimator.scales,
        )

    def _likely_only(self, fitted: Fitted) -> _Judged:
        """The findings, without those that are not likely enough to be named; they leave the fit too."""
        considered: list[str] = []
        nuisance = self.estimator.nuisance
        while True:
            judged = self._judged(fitted)
            doubted = [
                each for each in judged.findings if each.probability < self.estimator.scales.named_from
            ]
            considered += [f"{each.cause}: more likely something else" for each in doubted]
            effects = {id(each.effect) for each in doubted}
            kept = fitted.hypothesis
            for place in range(len(kept.effects) - 1, self.trail.base - 1, -1):
                if id(kept.effects[place]) in effects:
                    kept = kept.without(place)
            if kept == fitted.hypothesis:  # what is left of them are changes of the baseline, which it keeps
                likely = [each for each in judged.findings if each not in doubted]
                return replace(judged, findings=likely, considered=[*considered, *judged.considered])
            self.estimator.nuisance = nuisance
            fitted = self.estimator.fit(kept)

    def _judged(self, fitted: Fitted) -> _Judged:
        """What a hypothesis finds, and how sure that is."""
        estimator, base = self.estimator, self.trail.base
        precise = precisely(estimator, fitted)
        spread = covariance(estimator, precise)
        findings = [
            replace(self._finding(fitted, place), parameters=parameters_of(estimator, precise, place, spread))
            for place in range(base, len(fitted.hypothesis.effects))
        ]
        findings += changes.findings(
            self.search, self.model, replace(self.trail, fitted=fitted), precise, spread
        )
        findings.sort(key=lambda each: -each.robust)
        excess = fitted.chi_square / max(len(fitted.residual) - fitted.count(), 1)
        if estimator.nuisance.shape[1]:  # a model cannot hold a free-form loop: figures are without it
            estimator.nuisance = estimator.nuisance[:, :0]
            fitted = estimator.fit(fitted.hypothesis)
        left = rest(estimator, fitted)
        unknown = is_unexplained(estimator, left) or many_of_one(findings, self.estimator.scales) is not None
        considered: list[str] = []
        if unknown:
            findings, considered = without_doubtful_loops(findings, left, estimator.scales)
        findings = weighed(findings, Context(left.arcsec, excess, unknown), estimator.scales)
        if estimator.data.reversals < 2:  # speed, torque, place and time go together: useful, but no proof
            findings = [
                replace(each, probability=min(each.probability, estimator.scales.one_way))
                for each in findings
            ]
        return _Judged(fitted, findings, left, covariance(estimator, fitted), considered)

    def _named_only(self, fitted: Fitted) -> tuple[Fitted, list[str]]:
        """Take out what a gate stops, weakest first, and fit again."""
        considered: list[str] = []
        while len(fitted.hypothesis.effects) > self.trail.base:
            gates: dict[int, Gate] = {
                place: gate(self.estimator, fitted, place)
                for place in range(self.trail.base, len(fitted.hypothesis.effects))
            }
            stopped = [place for place in gates if not gates[place].passed]
            if not stopped:
                break
            place = min(stopped, key=lambda each: gates[each].robust / gates[each].needed)
            considered.append(f"{fitted.hypothesis.effects[place].name}: {gates[place].reason}")
            fitted = self.estimator.fit(fitted.hypothesis.without(place))
        return fitted, considered

    def _without_doubtful(self, fitted: Fitted) -> tuple[Fitted, list[str]]:
        """Take out names that do less than what is left unexplained in addition: it may well be its
        shadow.
        """
        considered: list[str] = []
        while len(fitted.hypothesis.effects) > self.trail.base:
            left = rest(self.estimator, fitted)
            if not is_unexplained(
                self.estimator, replace(left, fast_arcsec=0.0)
            ):  # what is fast casts no shadow
                break
            residual = fitted.residual / self.estimator.weight
            apart = elsewhere(self.estimator, residual)
            share = {}
            for place, effect in enumerate(fitted.hypothesis.effects[self.trail.base :], self.trail.base):
                if (effect.sought is not None and effect.sought.is_line) or effect.ordinary_arcsec:
                    continue  # what is left has no such line, and casts no shadow there; or any axis has it
                rows = acts(self.estimator, fitted, place)
                if np.any(rows & apart):
                    rows &= apart
                without = self.estimator.fit(fitted.hypothesis.without(place))
                lost = without.residual[rows] / self.estimator.weight[rows]
                does = float(np.mean(lost**2) - np.mean(residual[rows] ** 2))
                left_arcsec = beyond_noise(self.estimator, residual, rows)
                share[place] = (does / max(left_arcsec**2, 1e-12), without)
            place = min(share, key=lambda each: share[each][0], default=-1)
            if place < 0 or share[place][0] > self.estimator.scales.shadow:
                break
            considered.append(
                f"{fitted.hypothesis.effects[place].name}: does less than what is left unexplained"
            )
            fitted = share[place][1]
        return fitted, considered

    def _finding(self, fitted: Fitted, place: int) -> Finding:
        effect = fitted.hypothesis.effects[place]
        without = self.estimator.fit(fitted.hypothesis.without(place))
        judged = gate(self.estimator, fitted, place)
        gain = held_out(self.estimator, fitted, without)
        aliases = self._aliases(fitted, without, place)
        own = without.chi_square - fitted.chi_square
        return Finding(
            cause=effect.name,
            probability=UNWEIGHED,
            aliases=aliases,
            parameters={},
            gain=gain,
            experiment=next_experiment(effect.name, aliases),
            peak_arcsec=self.search.peak(fitted, place),
            robust=own,
            effect=effect,
            signs=Signs(judged.robust, judged.needed),
        )

    def _aliases(self, fitted: Fitted, without: Fitted, place: int) -> tuple[str, ...]:
        """Other causes that do nearly as well in its place."""
        effect = fitted.hypothesis.effects[place]
        aliases = self.search.as_well(fitted, without, effect.name)
        alike = waves_alike(self.estimator, [effect], fitted.hypothesis.start)
        aliases += [each for each in alike if each not in aliases]
        available = self.estimator.motion.available()
        for kind, _ in lookalikes(effect, self.estimator.data.ratio):
            if kind.channels - available and kind.name not in aliases:
                aliases.append(kind.name)
        beside = confounded(self.estimator, fitted, place)
        aliases += [each.name for each in beside if each.name not in aliases]
        return tuple(aliases)

    def _with_unexplained(self, findings: list[Finding], left: Rest) -> list[Finding]:
        scales = self.estimator.scales
        many = many_of_one(findings, scales)
        if many is None and not is_unexplained(self.estimator, left):
            return findings
        size = left.arcsec if many is None else max(each.peak_arcsec for each in many)
        lives = left.lives_in
        if many is not None:
            effect = many[0].effect
            if effect is not None and effect.waves():
                lives = effect.coordinate(self.estimator.motion, self.estimator.data.ratio).name
            findings = [each for each in findings if each not in many]
        unknown = Finding(
            cause="unexplained",
            probability=min(1.0 / (1.0 + (scales.floor_arcsec / max(size, 1e-9)) ** 2), scales.surest),
            aliases=(),
            parameters={},
            gain=None,
            left_arcsec=left.arcsec,
            experiment=FIT_FIRST if self.unfitted else for_unexplained(lives),
            peak_arcsec=size,
            lives_in=lives,
            note=f"{left.arcsec:.2g} arcsec rms beyond the noise are left",
        )
        loops = [each for each in findings if each.effect is not None and each.effect.changes is Part.LOOP]
        if many is None and loops and "last reversal" in lives and left.foretold(scales):
            # The law that is nearest to the truth is not the truth: one finding, with what it leaves.
            told = replace(
                loops[0],
                note=f"the loop has another shape than either law: {left.arcsec:.2g} arcsec rms are left",
                lives_in=lives,
            )
            return [told if each is loops[0] else each for each in findings]
        largest = max((each.peak_arcsec for each in findings), default=0.0)
        return [*findings, unknown] if largest > scales.leads * size else [unknown, *findings]

    def _as_given(self) -> FloatArray:
        """Residual of the model as it is, but for the zeros; with the start that suits it best."""
        tried = (self._about_zeros(self.estimator.told(self.model.effects, start)) for start in Start)
        return min(tried, key=lambda error: float(error @ error))

    def _about_zeros(self, told_arcsec: FloatArray) -> FloatArray:
        """What a prediction for the usable points leaves of them, about the zeros that suit it best."""
        estimator = self.estimator
        return about_zeros(estimator.observed - told_arcsec, estimator.zero, estimator.weight**2)

    def _by_kind(self, given: FloatArray, after: FloatArray) -> dict[str, tuple[Figures, Figures]]:
        estimator = self.estimator
        kinds = estimator.data.points.kind[estimator.index]
        direction = direction_of(estimator.motion)[estimator.index]
        masks = {name: kinds == i for i, name in enumerate(estimator.data.kinds)}
        masks |= {"forward": direction > 0, "backward": direction < 0}
        return {
            name: (_figures(given[rows], about_zero=True), _figures(after[rows], about_zero=True))
            for name, rows in masks.items()
            if np.count_nonzero(rows) > 10
        }

    def _traces(self, fitted: Fitted, given: FloatArray) -> Traces:
        estimator = self.estimator
        points = estimator.data.points
        speed = points.motion.motor_speed_deg_s
        assert speed is not None
        measured = estimator.observed - estimator.level - fitted.zeros[estimator.zero]
        return Traces(
            time_s=estimator.time_s,
            motor_deg=estimator.motion.motor_deg[estimator.index],
            measured_arcsec=measured,
            model_arcsec=measured - given,
            extended_arcsec=measured - fitted.residual / estimator.weight,
            direction=direction_of(estimator.motion)[estimator.index],
            speed_deg_s=speed[estimator.index],
            motion=estimator.motion,
            rows=estimator.index,
            samples=estimator.data.full.motion,
            runs=estimator.data.runs,
            start=fitted.hypothesis.start,
        )


def _ordinary(finding: Finding) -> bool:
    """Whether any axis has as much of it."""
    return finding.effect is not None and finding.peak_arcsec < finding.effect.ordinary_arcsec


def _figures(values: FloatArray, about_zero: bool = False) -> Figures:
    rms = float(np.sqrt(np.mean(values**2)))
    return Figures(rms, 3.0 * (rms if about_zero else float(np.std(values))))
