"""Diagnoses a measurement against a model: all steps in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from hdbridge.analysis import changes
from hdbridge.analysis.acceptance import gate
from hdbridge.analysis.calibrated import calibrated
from hdbridge.analysis.capability import Capability, Identifiability, capability
from hdbridge.analysis.checks import check_once, check_records, zeros_apart_arcsec
from hdbridge.analysis.cuts import observed
from hdbridge.analysis.extend import as_named, extended_model, supported
from hdbridge.analysis.findings import (
    UNWEIGHED,
    Diagnosis,
    Figures,
    Finding,
    Traces,
    for_unexplained,
    next_experiment,
)
from hdbridge.analysis.gain import held_out, of_written
from hdbridge.analysis.hypothesis import Estimator, Fitted, Hypothesis
from hdbridge.analysis.identifiability import identifiability
from hdbridge.analysis.linear import Nuisances, on_one_thread
from hdbridge.analysis.parameters import confounded, covariance, parameters_of, precisely
from hdbridge.analysis.prepared import Observed, gather
from hdbridge.analysis.probability import Prior, weighed
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.search import (
    Search,
    as_calibrated,
    lookalikes,
    waves_alike,
    with_measured,
)
from hdbridge.analysis.swing import (
    Base,
    Swing,
    between_samples,
    noise_bounded,
    settled,
    visible_swing,
    without,
)
from hdbridge.analysis.unexplained import (
    Rest,
    is_unexplained,
    many_of_one,
    of_the_loop,
    rest,
    unfitted,
)
from hdbridge.axis.effects import Channel, Effect, FloatArray, Part, Start, missing_channels
from hdbridge.axis.effects.kinematics import direction_of
from hdbridge.axis.effects.motion import missing_error
from hdbridge.axis.effects.torque import beyond_limit
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record
from hdbridge.records.recording import Given, Recording, agreed_ratio, by_name
from hdbridge.units import figure

LOSES = "it does not predict what is left out"
UNDETERMINED = "the record does not determine its size"
UNWRITTEN = "it cannot be written into the model"
FIT_FIRST = "none yet: fit a model first (hdbridge fit), then diagnose with it"


@on_one_thread
def diagnose(
    recording: Given,
    model: TransmissionModel,
    *,
    independent_zeros: bool = False,
    progress: Callable[[str], None] = lambda _: None,
    scales: Scales | None = None,
    prior: Prior | None = None,
) -> Diagnosis:
    """Finds the causes of the difference between a model and one or several recordings.

    Set ``independent_zeros`` if the encoders lost their zeros between recordings. ``progress`` receives a
    description of each step. ``scales`` overrides the decision thresholds, and ``prior`` is the fleet's prior
    for the causes. Raises InputError if a recording is too short, does not match the model's ratio, or lacks
    a channel that the model needs.
    """
    recordings = by_name(recording)
    stated_by = str(model.path or "the model")
    agreed_ratio(recordings, [(stated_by, model.ratio)])
    check_once(list(recordings), [each.record for each in recordings.values()])
    check_records({name: each.record for name, each in recordings.items()}, model.ratio, stated_by)
    whole = Recording.joined(list(recordings.values()))
    record, legs = whole.record, whole.segments
    remarks = (
        () if independent_zeros else _of_zeros(observed(record, model.ratio).record.parts(), model.ratio)
    )
    lacking = missing_channels(model.effects, record.motion().available() | {Channel.LOAD_ANGLE})
    for name, channels in lacking.items():
        if channels:
            raise missing_error(name, channels)
    progress("preparing the record")
    data = gather(
        record, model.ratio, legs, independent_zeros, lambda motion: model.predict(motion, Start.VIRGIN)
    )
    scales = scales or Scales()
    progress("searching for causes")
    base = Base.of(data, model.effects)
    between = between_samples(base, scales)
    swing = visible_swing(base, between, scales)
    search, found = _searched(data, model, scales, between, swing)
    if swing is None or not between.names:  # a larger cause may mask them
        # Inertial wind-up is the slow part of the load oscillation and of the motion between samples, so the
        # base excludes it.
        lawful = search.estimator.lawful(found).hypothesis
        others = [each for each in lawful.effects if each.channels != {Channel.ACCELERATION}]
        base, before = Base.of(data, others), (between.names, swing)
        between = between if between.names else between_samples(base, scales)
        swing = swing or visible_swing(base, between, scales)
        if (between.names, swing) != before:
            search, found = _searched(data, model, scales, between, swing)
    progress("assessing the findings")
    diagnosis = _Judge(search, model, prior).of(found)
    return replace(diagnosis, remarks=(*remarks, *diagnosis.remarks))


def _searched(
    data: Observed, model: TransmissionModel, scales: Scales, between: Nuisances, swing: Swing | None
) -> tuple[Search, Fitted]:
    """Returns the search and its result, for the data after subtraction of the load oscillation."""
    if swing is not None:
        data = without(data, swing)
    soft = swing is not None and swing.soft
    between = between.without(lambda _: soft)
    data = replace(data, load_swings=bool(between.names) or (swing is not None and not soft))
    search = _search(data, model, scales, between)
    begun = search.begun()
    if not soft:
        search = _search(settled(search.estimator, begun, model.effects, swing), model, scales, between)
        begun = search.begun()
    if (quieter := noise_bounded(search.estimator, begun)) is not search.estimator.data:
        search = _search(quieter, model, scales, between)
        begun = search.begun()
    estimator = search.estimator
    first = unfitted(estimator, model.effects)
    held = beyond_limit(model.effects, data.full.motion)
    dynamics = () if swing is None else (swing.remark(),)
    of_record = (*((first,) if first else ()), *held, *data.remarks, *dynamics)
    estimator.data = replace(estimator.data, remarks=of_record)
    return search, search.run(begun)


def _search(data: Observed, model: TransmissionModel, scales: Scales, between: Nuisances) -> Search:
    estimator = Estimator(data, scales)
    estimator.calibrated = calibrated(
        model.effects, model.uncertainty, lambda effect: estimator.columns(effect, Start.VIRGIN), scales
    )
    between = replace(between, columns=estimator.at_points(between.columns))
    estimator.unknown = estimator.unknown.and_also(between).and_also(estimator.begins_of(model.effects))
    return Search(estimator, model.effects)


def _of_zeros(parts: Sequence[Record], ratio: float) -> tuple[str, ...]:
    """Returns a remark if the zero offsets of the recordings differ by more than their own errors."""
    apart = zeros_apart_arcsec(parts, ratio)
    if apart is None:
        return ()
    return (
        f"the zero offsets of the records are {apart:.0f} arcsec apart, more than their own errors: if the "
        "encoders' zeros were lost between them, say so (on the command line: --independent-zeros)",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    whole: Fitted
    """Fit that may contain a free-form loop."""
    fitted: Fitted
    """Fit without a free-form loop."""
    findings: list[Finding]
    left: Rest
    unexplained: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Judge:
    search: Search
    model: TransmissionModel
    prior: Prior | None = None
    considered: list[str] = field(default_factory=list)
    """Causes that were considered but not reported, each with the reason."""

    @property
    def estimator(self) -> Estimator:
        return self.search.estimator

    def of(self, fitted: Fitted) -> Diagnosis:
        """Derives the diagnosis from the result of the search."""
        estimator, given = self.estimator, self.model.effects
        while (passed := self.search.eliminated(fitted, self._stopped, self.considered)) is not fitted:
            names = [Counter(each.name for each in one.hypothesis.effects) for one in (fitted, passed)]
            fitted = self.search.instead(passed, names[0] - names[1])
        fitted = with_measured(self.search, fitted)
        fitted = as_calibrated(estimator, fitted, given)
        while True:
            judged = self._likely_only(fitted)
            findings = self._with_unexplained(judged.findings, judged.left)
            fitted, findings, extended, lost = self._written(judged.fitted, findings)
            if not lost:
                break
            self.considered.extend(f"{each.cause}: {why}" for each, why in lost)
            fitted = self._without(judged.whole, [each for each, _ in lost])
        known = {each.cause for each in findings} | {each.split(":")[0] for each in self.considered}
        refused = self.search.reported_refusals(judged.fitted)
        self.considered.extend(each for each in refused if each.split(":")[0] not in known)
        refitted = estimator.fit(Hypothesis(given, judged.fitted.hypothesis.start))
        before, _ = estimator.residual_of(given)
        after, start = estimator.residual_of(extended.effects)
        measured = estimator.observed - estimator.level - fitted.zeros[estimator.zero]
        cleared = copy(estimator)  # the record without the errors found in it
        cleared.observed = estimator.observed - before + after

        @on_one_thread
        def visible() -> tuple[Mapping[str, Identifiability], Capability]:
            causes = identifiability(cleared, cleared.fit(refitted.hypothesis), given, judged.unexplained)
            return causes, capability(estimator.data, given, causes, estimator.scales)

        return Diagnosis(
            baseline=_figures(before),
            refitted=_figures(refitted.residual / estimator.weight),
            extended=_figures(after),
            noise_floor_arcsec=estimator.data.noise_arcsec,
            findings=tuple(findings),
            visible=visible,
            by_kind=self._by_kind(before, after),
            remarks=(*estimator.data.remarks, *filter(None, [judged.left.remark])),
            model=extended,
            traces=Traces(
                measured_arcsec=measured,
                model_arcsec=measured - before,
                extended_arcsec=measured - after,
                motion=estimator.motion,
                rows=estimator.index,
                samples=estimator.data.full.motion,
                runs=estimator.data.runs,
                start=start,
            ),
            considered=tuple(dict.fromkeys(self.considered)),
            scales=estimator.scales,
        )

    def _written(
        self, fitted: Fitted, findings: list[Finding]
    ) -> tuple[Fitted, list[Finding], TransmissionModel, list[tuple[Finding, str]]]:
        """Returns the fit of the extended model, its findings, the model, and causes to exclude from it.

        A cause is excluded, with the reason, if its parameters are out of bounds, if the compensation could
        not invert the model with it, if the record does not determine it, or if it does not predict held-out
        data. The given effects remain unchanged if the refitted ones do not predict held-out data.
        """
        estimator, given = self.estimator, self.model.effects
        as_reported = as_named(estimator, fitted, given, {each.cause for each in findings})
        alone = {each.cause for each in findings if each.left_alone}
        spread = covariance(estimator, as_reported)
        as_reported = as_reported.having(supported(estimator, as_reported, given, alone))
        named = {each.cause for each in findings if not each.within}
        sound = as_reported.hypothesis.effects
        chosen = [place for place in range(len(given), len(sound)) if sound[place].name in named]
        (gain,) = of_written(estimator, as_reported, given, [chosen], [*range(len(given)), *chosen])
        if gain and not gain.predicts:
            as_reported = as_reported.having((*given, *sound[len(given) :]))
        reason = "diagnosis: " + (", ".join(each.cause for each in findings) or "nothing found, refitted")
        extended = extended_model(self.model, as_reported, chosen, spread, reason, len(given))
        written = [new for new in extended.effects if new not in given]
        missing = [each for each in findings if not (each.left_alone or _is_in(each, written))]
        lost = [(each, UNWRITTEN) for each in missing if not each.within]
        if lost:
            return as_reported, findings, extended, lost
        # The model's own part remains as given.
        self.considered.extend(f"{each.cause}: {UNWRITTEN}" for each in missing)
        findings = [each for each in findings if each not in missing]
        findings = self._with_gains(as_reported, findings, chosen)
        lost = [(each, LOSES) for each in findings if each.refuted]
        return as_reported, findings, extended, lost

    def _with_gains(self, fitted: Fitted, findings: list[Finding], added: list[int]) -> list[Finding]:
        """Returns the findings with the gain of the written model, which has new effects at ``added``."""
        effects, given = fitted.hypothesis.effects, self.model.effects
        written = [place for place, old in enumerate(given) if effects[place] != old] + added
        own = [
            [
                at
                for at in written
                if each.effect and each.within == (at < len(given)) and _is_in(each, [effects[at]])
            ]
            for each in findings
        ]

        tested = [number for number, each in enumerate(findings) if each.gain and own[number]]
        if not tested:
            return findings
        others = [
            {place for at, places in enumerate(own) for place in places if at != number} for number in tested
        ]
        gains = dict(zip(tested, of_written(self.estimator, fitted, given, others, written), strict=True))
        return [replace(each, gain=gains.get(at, each.gain)) for at, each in enumerate(findings)]

    def _stopped(self, fitted: Fitted) -> tuple[int, str] | None:
        """Returns the index of the first cause to reject, and the reason; None if all causes pass.

        Causes that fail their acceptance tests come first, the weakest before the others, then causes that
        are implausible or not identifiable.
        """
        places = range(len(self.model.effects), len(fitted.hypothesis.effects))
        gates = {place: gate(self.estimator, fitted, place) for place in places}
        stopped = [place for place, each in gates.items() if each.reason]
        if stopped:
            place = min(stopped, key=lambda each: gates[each].robust / gates[each].needed)
            return place, gates[place].reason
        data = self.estimator.data
        for place in places:
            effect = fitted.hypothesis.effects[place]
            if reason := effect.implausible(data) or effect.unidentifiable(data):
                return place, reason
        return None

    def _likely_only(self, fitted: Fitted) -> _Judged:
        """Assesses the findings, and removes those that are improbable or normal for any axis.

        Improbable findings are also removed from the fit.
        """
        while True:
            judged = self._judged(fitted)
            least = self.estimator.scales.named_from
            likely = [
                each
                for each in judged.findings
                if each.probability >= least and (each.within or not each.undetermined)
            ]
            doubted = [each for each in judged.findings if each not in likely]
            self.considered.extend(
                f"{each.cause}: {self._doubt(each)}" + f" (prior: {each.prior})" * bool(each.prior)
                for each in doubted
            )
            left = self._without(fitted, doubted)
            if left is fitted:
                break  # the remaining doubtful ones are changes of the baseline, which stay in the fit
            fitted = left
        usual = {each.cause for each in likely if _ordinary(each)}
        self.considered.extend(f"{cause}: no more than usual" for cause in sorted(usual))
        return replace(judged, findings=[each for each in likely if each.cause not in usual])

    def _doubt(self, finding: Finding) -> str:
        if finding.probability >= self.estimator.scales.named_from:
            return UNDETERMINED
        return "more likely something else" if finding.probability else LOSES

    def _without(self, fitted: Fitted, findings: Sequence[Finding]) -> Fitted:
        """Refits without the effects of ``findings``; changes of the baseline stay in the fit."""
        effects, base = {id(each.effect) for each in findings}, len(self.model.effects)
        kept = tuple(
            each for i, each in enumerate(fitted.hypothesis.effects) if i < base or id(each) not in effects
        )
        if len(kept) == len(fitted.hypothesis.effects):
            return fitted
        return self.search.with_best_law(self.estimator.fit(replace(fitted.hypothesis, effects=kept)))

    def _judged(self, fitted: Fitted) -> _Judged:
        """Determines the findings of a fit, with their parameters and probabilities."""
        estimator, base = self.estimator, len(self.model.effects)
        precise = precisely(estimator, fitted)
        spread = covariance(estimator, precise)
        findings = [
            replace(self._finding(fitted, place), parameters=parameters_of(estimator, precise, place, spread))
            for place in range(base, len(fitted.hypothesis.effects))
        ]
        plain = estimator.lawful(fitted)
        findings += changes.findings(self.search, self.model, fitted, plain, precise, spread)
        findings.sort(key=lambda each: -each.robust)
        # A model cannot contain a free-form loop, so the results exclude it.
        whole, fitted = fitted, plain
        left = rest(estimator, fitted)
        unknown = is_unexplained(estimator, left) or many_of_one(findings, estimator.scales) is not None
        findings = weighed(findings, unknown, estimator.scales, self.prior)
        if estimator.data.reversals < 2:  # speed, torque, position and time are correlated
            findings = [self._one_way(each) for each in findings]
        return _Judged(whole, fitted, findings, left, unknown)

    def _one_way(self, finding: Finding) -> Finding:
        """Limits the probability of a cause in a record with motion in one direction only."""
        scales, repeated = self.estimator.scales, finding.gain is not None and finding.gain.repeated
        most = scales.one_way_repeated if repeated else scales.one_way
        return replace(finding, probability=min(finding.probability, most))

    def _finding(self, fitted: Fitted, place: int) -> Finding:
        effect = fitted.hypothesis.effects[place]
        without = self.estimator.fit(fitted.hypothesis.without(place))
        aliases = self._aliases(fitted, without, place)
        return Finding(
            cause=effect.name,
            probability=UNWEIGHED,
            aliases=aliases,
            parameters={},
            gain=held_out(self.estimator, without, fitted),
            experiment=next_experiment(effect.name, aliases),
            peak_arcsec=self.search.peak(fitted, place),
            robust=without.chi_square - fitted.chi_square,
            effect=effect,
            gate=gate(self.estimator, fitted, place),
        )

    def _aliases(self, fitted: Fitted, without: Fitted, place: int) -> tuple[str, ...]:
        """Returns other causes that explain the data nearly as well as this cause."""
        effect, available = fitted.hypothesis.effects[place], self.estimator.motion.available()
        alike = lookalikes(effect, self.estimator.data.ratio)
        names = [
            *self.search.equal_alternatives(fitted, without, effect.name),
            *waves_alike(self.estimator, [effect], fitted.hypothesis.start),
            *(kind.name for kind, _ in alike if kind.channels - available),
            *(each.name for each in confounded(self.estimator, fitted, place)),
        ]
        return tuple(dict.fromkeys(names))

    def _with_unexplained(self, findings: list[Finding], left: Rest) -> list[Finding]:
        scales = self.estimator.scales
        many = many_of_one(findings, scales)
        if many is None and not is_unexplained(self.estimator, left):
            return findings
        size, rms, lives = left.peak_arcsec, max(left.arcsec, left.fast_arcsec), left.lives_in
        if many is not None:
            size = max(each.peak_arcsec for each in many)
            rms = max(rms, *(each.explained_arcsec for each in many))
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
            experiment=FIT_FIRST if unfitted(self.estimator, self.model.effects) else for_unexplained(lives),
            peak_arcsec=size,
            lives_in=lives,
            note=f"{figure(left.arcsec, 3)} arcsec rms beyond the noise remain",
        )
        loops = [each for each in findings if each.effect is not None and each.effect.changes is Part.LOOP]
        if many is None and loops and of_the_loop(self.estimator, left):
            # Even the best hysteresis law is an approximation, so the residual is noted in the loop's
            # finding.
            note = f"the loop's shape follows neither law: {figure(left.arcsec, 3)} arcsec rms remain"
            noted = replace(loops[0], note=note, lives_in=lives)
            return [noted if each is loops[0] else each for each in findings]
        if size < self.estimator.floor_arcsec:
            return findings
        largest = max((each.explained_arcsec for each in findings), default=0.0)
        return [*findings, unknown] if largest > rms else [unknown, *findings]

    def _by_kind(self, given: FloatArray, after: FloatArray) -> dict[str, tuple[Figures, Figures]]:
        estimator = self.estimator
        points, direction = estimator.data.points, direction_of(estimator.motion)[estimator.index]
        masks = {name: points.of_kind(name)[estimator.index] for name in points.kinds}
        if len(masks) == 1:  # a record without legs is divided into rest, slow motion and fast motion
            speed = np.abs(points.speed_deg_s)
            slow = speed <= np.median(speed[speed > 0.0]) if np.any(speed) else speed <= 1.0
            either = {"standing": speed == 0.0, "slow": (speed > 0.0) & slow, "fast": ~slow}
            masks = {name: each[estimator.index] for name, each in either.items()}
        masks |= {"forward": direction > 0, "backward": direction < 0}
        return {
            name: (_figures(given[rows], about_zero=True), _figures(after[rows], about_zero=True))
            for name, rows in masks.items()
            if np.count_nonzero(rows) > 10
        }


def _is_in(finding: Finding, changed: Sequence[Effect]) -> bool:
    """Returns True if the finding is among ``changed``, the effects that differ from the given model."""
    effect = finding.effect
    if effect is None:  # an unexplained residual
        return True
    part = effect.changes or effect.part
    return any(each.name == effect.name or (part is not None and each.part is part) for each in changed)


def _ordinary(finding: Finding) -> bool:
    """Returns True if the finding is no larger than on an ordinary axis."""
    return finding.effect is not None and finding.peak_arcsec < finding.effect.ordinary_arcsec


def _figures(values: FloatArray, about_zero: bool = False) -> Figures:
    rms = float(np.sqrt(np.mean(values**2)))
    return Figures(rms, 3.0 * (rms if about_zero else float(np.std(values))))
