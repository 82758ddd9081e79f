"""Twin of an axis: fit to recordings, verdict, and file.

A fit assumes that the simulated drive can behave like the axis. The residuals on held-out legs test this
assumption. Only the values of a twin that explains every channel are those of the axis. Any other twin merely
replays the motion; its values belong to a different drive with similar motion.

profiles/NAME/twin.yaml           the active twin, which `hdbridge simulate` and `--simulate` use
              pending-twin.yaml   proposed by `hdbridge twin`, not yet committed
              twin-history/       each version that was ever active, and the log
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.model.binding import binding, check_binding
from hdbridge.axis.model.difference import Difference, differences, flat
from hdbridge.axis.model.file import Provenance, hexadecimal
from hdbridge.axis.model.store import Store
from hdbridge.errors import InputError
from hdbridge.files.profile import TWIN_NAME
from hdbridge.files.yamlfile import Line, dump_yaml, write_atomically
from hdbridge.records.record import WRONG_RATIO
from hdbridge.records.recording import Recording, versions_here
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import (
    ALL,
    FOLLOWING_ERROR,
    LOAD_ERROR,
    MOTOR_TORQUE,
    TEMPERATURE,
    TITLES,
    Comparison,
    compare,
)
from hdbridge.twin.fit import (
    FIT_S,
    MOST_DEAD_CYCLES,
    Fitted,
    by_law_of,
    fit,
    fitted_rows,
    legs_of_rows,
    values_in,
)
from hdbridge.twin.mechanics import COMPARED, measured_mechanics, rms_speed_rad_s
from hdbridge.twin.misfit import (
    CHANNELS,
    MOST_SCATTER,
    NOISE_LEVEL,
    ChannelResidual,
    Data,
    Replays,
    Values,
    channel_residuals,
    coarse,
    held_out_legs,
    misfit_of,
    noise_floor,
    noise_in_motion,
    prepare,
    with_load_noise,
)
from hdbridge.twin.naming import Finding, InseparableSet, explain, findings, inseparable_sets, scales_by_kind
from hdbridge.twin.parameters import LOAD, by_cause, default_truth, with_sections
from hdbridge.twin.replay import legs_of, replay
from hdbridge.twin.response import with_response
from hdbridge.twin.thermal import with_warmth
from hdbridge.units import figure, rounded

# ----------------------------------------------------------------
# Result of `fit_twin`: the simulated drive's parameters, their intervals, and the residuals.

HELD_OUT = "held out"
"""Pseudo-kind of leg in a comparison: the held-out legs."""


@dataclass(frozen=True)
class Twin:
    """A simulated drive fitted to an axis."""

    truth: Truth
    """Parameters, with intervals of the fitted ones; the provenance contains the data for `check`."""
    findings: tuple[Finding, ...]
    """Causes of the errors of the initial simulation, if its values were meant to be the axis's."""
    inseparable_sets: tuple[InseparableSet, ...]
    """Sets of parameters that are not separable in the recorded motion."""
    channel_residuals: tuple[ChannelResidual, ...]
    """Residual of each recorded channel, on held-out legs if any."""
    before: Comparison
    """Comparison of the recordings with the initial simulation; the kind `HELD_OUT` is the held-out legs."""
    after: Comparison
    """Comparison of the recordings with the twin."""
    scatter: float = math.nan
    """Variance between legs relative to that of independent residuals (`fit.Jackknife.scatter`)."""
    impossible: tuple[str, ...] = ()
    """Implausible values, each in a sentence; only for a twin whose values are not the axis's."""

    @property
    def values(self) -> Values:
        """Origin of the values: the axis, or only a replay."""
        return Values.of(self.truth) or Values.REPLAY

    @property
    def unexplained(self) -> tuple[ChannelResidual, ...]:
        """Channels with residuals above their noise."""
        return tuple(each for each in self.channel_residuals if each.times_noise > NOISE_LEVEL)


# ----------------------------------------------------------------
# Verdict on a twin, from its residuals in each channel on held-out legs. Pure.

SIGNALS: Final = (LOAD_ERROR, FOLLOWING_ERROR, MOTOR_TORQUE, TEMPERATURE)
LEAST_GAIN: Final = 0.01
"""Minimum mean reduction of the differences for a twin to count as better; smaller reductions are due to
noise."""
EQUAL: Final = 0.01
"""Fraction of the noise below which differences count as equal, because a few held-out readings may all
agree."""
WORSE: Final = 1.1
"""A signal counts as worse if its difference has grown by more than this factor and exceeds its noise."""
DECADE: Final = 10.0
"""Maximum ratio of a motor's inertia to the usual inertia for its rated torque, and of load to motor inertia
seen by the motor. The inertias of servo motors of equal torque differ by a factor of three to five
(catalogues)."""


def impossible(truth: Truth, axis: AxisConfig, cycle_s: float) -> tuple[str, ...]:
    """Returns the values of a truth that are impossible for this axis file, each in a sentence."""
    motor, servo = truth.motor, truth.servo
    usual = default_truth(axis).motor.inertia_kg_m2
    load = truth.load_.whole_inertia_kg_m2 / axis.gear.ratio**2
    found = []
    for name, value, of, other in (
        ("motor inertia", motor.inertia_kg_m2, usual, "the one usual for its rated torque"),
        ("load inertia seen by the motor", load, motor.inertia_kg_m2, "the motor's"),
    ):
        if not 1.0 / DECADE <= value / of <= DECADE:
            found.append(f"{name} {figure(value, 3)} kg m2; expected within a decade of {other}, {of:.3g}")
    most_rad_s = math.radians(axis.limits.velocity_deg_s * axis.gear.ratio)
    rise = 1.0 + motor.stribeck.rise if motor.stribeck else 1.0
    friction_nm = motor.coulomb_nm * rise + motor.viscous_nm_s_per_rad * most_rad_s
    if servo.friction_feedforward_nm > friction_nm:
        found.append(
            f"friction feed-forward {figure(servo.friction_feedforward_nm, 3)} Nm; expected at most the "
            f"friction, {figure(friction_nm, 3)}"
        )
    most_ms = 1e3 * MOST_DEAD_CYCLES * cycle_s
    if servo.dead_time_ms > most_ms:
        found.append(
            f"dead time {figure(servo.dead_time_ms, 3)} ms; expected at most two cycles, {figure(most_ms, 3)}"
        )
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision about a fit or a twin, with its reason."""

    kept: bool
    text: str
    """Reason in a sentence or two."""


def judge(twin: Twin) -> Verdict:
    """Decides whether to keep a twin; the reason first states the validity of its values."""
    gain = better(twin.before, twin.after)
    if twin.impossible:
        return Verdict(False, f"the twin is not kept: no axis has these values: {'; '.join(twin.impossible)}")
    if not gain.kept:
        return Verdict(False, f"the twin is not kept: {gain.text}")
    text = f"the twin is kept as pending: {gain.text}"
    if twin.values is not Values.AXIS:
        text = f"{replays_only(twin)}; {text}"
    if twin.truth.provenance.get("interrupted"):
        text = f"the fit was interrupted, so this is the best place so far; {text}"
    return Verdict(True, text)


def replays_only(twin: Twin) -> str:
    """Returns the headline of a twin whose values are not the axis's."""
    measured = [each for each in twin.channel_residuals if math.isfinite(each.share)]
    shown = ", ".join(f"{each.channel} to {figure(100.0 * each.share, 2)} %" for each in measured)
    lost = [
        f"{each.channel}: residual is {figure(each.times_noise, 3)} times the noise"
        for each in twin.channel_residuals
        if not each.explained
    ]
    if twin.scatter > MOST_SCATTER:
        lost.append(
            f"the legs disagree about its parameters: {figure(math.sqrt(twin.scatter), 2)} times their errors"
        )
    if twin.truth.servo.response is not None:
        lost.append("a measured response supplies the part that its loops cannot reproduce")
    why = f": {'; '.join(lost)}" if lost else ""
    return f"the twin replays this drive ({shown}), but its values are not the axis's{why}"


def better(before: Comparison, after: Comparison) -> Verdict:
    """Decides whether the rms differences of load error, following error, torque and (if recorded)
    temperature have become smaller.

    Uses the held-out legs, or all legs if none are held out.
    """
    kind = HELD_OUT if any(row.kind == HELD_OUT for row in after.rows) else ALL
    where = "on legs that the fit has not seen" if kind == HELD_OUT else "on the legs that it was fitted to"
    pairs = {
        name: (was, now)
        for name in SIGNALS
        if (was := before.row(name, kind)) is not None and (now := after.row(name, kind)) is not None
    }
    # A replay starts at a rounded reading and may stay off by one step, so smaller differences are equal.
    step_k = max((each.noise for each in pairs.get(TEMPERATURE, ())), default=0.0)
    if max((each.difference for each in pairs.get(TEMPERATURE, ())), default=0.0) <= step_k:
        pairs.pop(TEMPERATURE, None)
    worse, ratios = [], []
    for name, (was, now) in pairs.items():
        if now.difference > max(WORSE * was.difference, now.noise, 1e-12):
            worse.append(
                f"{TITLES[name]} differs by {now.difference:.3g} {now.unit}, before by {was.difference:.3g}"
            )
        # Both differences contain noise. Differences below this limit are equal.
        least = step_k if name == TEMPERATURE else max(EQUAL * now.noise, 1e-12)
        ratios.append(math.log(max(now.difference, least) / max(was.difference, least)))
    gain = 1.0 - math.exp(sum(ratios) / len(ratios)) if ratios else 0.0
    if worse:
        return Verdict(False, f"{where}, {'; '.join(worse)}")
    if gain < LEAST_GAIN:
        return Verdict(False, f"{where} the differences from the axis are not smaller than before")
    return Verdict(True, f"{where} the differences from the axis are {100.0 * gain:.0f} % smaller on average")


# ----------------------------------------------------------------
# Difference of two twins by parameter. Pure.

SECTIONS = ("motor", "servo", "gear", "load", "temperature")


def diff(before: Truth | None, after: Truth) -> list[Difference]:
    """Returns all non-default parameters of both twins, changed or not, in the order of the file."""
    twins = [each for each in (before, after) if each is not None]
    widths = {
        (place.partition(".")[0], place.partition(".")[2]): 0.5 * (upper - lower)
        for each in twins
        for place, (lower, upper) in each.intervals.items()
    }
    return differences(dict(_parameters(before)) if before else {}, dict(_parameters(after)), widths)


def _parameters(truth: Truth) -> Iterator[tuple[tuple[str, str], Any]]:
    data = truth.model_dump(by_alias=True, mode="json", exclude_defaults=True)
    for section in SECTIONS:
        for name, value in flat(data.get(section, {})):
            yield (section, name), value


# ----------------------------------------------------------------

HEADER: Final = (
    "# The twin of an axis, by hdbridge: what the simulated drive is, learned from recordings.\n"
    "# docs/ci.md describes its keys, docs/twin.md how it came about.\n"
)


@dataclass(frozen=True)
class TwinFile:
    """Twin, and the file from which it was read."""

    truth: Truth
    path: Path | None = field(default=None, compare=False)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a twin's file; InputError with file:line:column."""
        return cls(Truth.load(path), Path(path))

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Axis, drive and gear to which the twin is bound, date, reason and recordings."""
        return self.truth.provenance

    def with_provenance(self, **provenance: Any) -> Self:
        """Returns the twin with these entries added to its provenance."""
        known = {**self.truth.provenance, **provenance}
        return type(self)(self.truth.model_copy(update={"provenance": known}), self.path)

    def bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> Self:
        """Returns the twin, bound to an axis and to the drive that answered (or else the drive of the axis
        file).
        """
        return self.with_provenance(**binding(axis, identity))

    def check_ratio(self, axis: AxisConfig) -> None:
        """Raises InputError if the twin has a different gear ratio from the axis file.

        The compared ratio is that of the measurement; the gear's true ratio may differ by a `ratio_error`.
        """
        bound = Provenance.model_validate(self.truth.provenance).gear
        ratio, allowed = (bound.ratio, 1e-9) if bound else (self.truth.gear.ratio, WRONG_RATIO)
        if not math.isclose(ratio, axis.gear.ratio, rel_tol=allowed):
            raise InputError(
                f"{self._name()}: gear.ratio: this twin is of a gear with ratio {ratio:g}, but {axis.path} "
                f"says {axis.gear.ratio:g}; use the twin of this gear, or make one"
            )

    def check_bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> None:
        """Raises InputError if the twin belongs to a different drive, axis or gear."""
        self.check_ratio(axis)
        check_binding(self.truth.provenance, axis, identity, self._name(), "twin", "make one")

    def dump(self) -> str:
        """Returns the file's text, from which the same twin is read; default values are omitted."""
        data = self.truth.model_dump(by_alias=True, mode="json", exclude_defaults=True)
        if "provenance" in data:
            data["provenance"] = hexadecimal(data["provenance"])
        if "intervals" in data:
            data["intervals"] = {place: Line(pair) for place, pair in data["intervals"].items()}
        return HEADER + dump_yaml(data)

    def save(self, path: Path | str) -> None:
        """Writes the file atomically."""
        write_atomically(path, self.dump())

    def _name(self) -> str:
        return str(self.path) if self.path else "this twin"


TWINS: Final = Store(
    "twin",
    TWIN_NAME,
    "pending-twin.yaml",
    "twin-history",
    "make one with 'hdbridge twin'",
    "hdbridge model log PROFILE --twin",
    TwinFile.load,
)


# ----------------------------------------------------------------
# Builds a twin from recordings: fit, causes of initial errors, inseparable parameters, residuals.


def fit_twin(
    recordings: Sequence[Recording],
    axis: AxisConfig,
    start: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Twin:
    """Fits the twin of an axis to recordings with the commanded motor angle.

    ``start`` is the initial simulation: the translated axis file and model, or an older twin. Replays run in
    ``workers`` threads. InputError if a recording has no command or comes from a different gear.

    Causes are named only if the values before and after the fit are the axis's; intervals are given only if
    the values after the fit are the axis's. Otherwise a measured response is added if held-out legs confirm
    it.
    """
    whole = Recording.joined(list(recordings))
    plain = start.model_copy(update={"servo": start.servo.model_copy(update={"response": None})})
    data = coarse(prepare(whole, axis, plain), FIT_S)
    with Replays(data, workers) as replays:
        noise = noise_in_motion(data)
        fitted = fit(replays, lambda share: progress(0.9 * share))
        remaining = channel_residuals(data, fitted.residuals, noise)
        values = values_in(fitted, remaining)
        if values is Values.REPLAY and not fitted.interrupted:
            fitted = with_response(replays, fitted)
            remaining = channel_residuals(data, fitted.residuals, noise)
        findings: tuple[Finding, ...] = ()
        sets: tuple[InseparableSet, ...] = ()
        if values is Values.AXIS:
            if Values.of(start) in {None, Values.AXIS}:
                findings = _wrong(replays, start, fitted)
            sets = inseparable_sets(fitted, legs_of_rows(data, fitted_rows(data)))
    truth, warmth = with_warmth(whole, axis, fitted, with_knowledge(fitted, data, values))
    if values is Values.REPLAY:
        truth = truth.model_copy(update={"intervals": {}})
    elif warmth is not None and Values.of(start) in {None, Values.AXIS}:
        findings = (*findings, warmth)
    before, after = (_compared(whole, axis, each) for each in (start, truth))
    cycle_s = data.pieces[0].commands.cycle_s
    progress(1.0)
    return Twin(
        truth,
        findings,
        sets,
        remaining,
        before,
        after,
        fitted.scatter,
        impossible(truth, axis, cycle_s) if values is Values.REPLAY else (),
    )


def _wrong(replays: Replays, start: Truth, fitted: Fitted) -> tuple[Finding, ...]:
    """Returns the values of the initial simulation that differ from the axis, judged by a few legs."""
    few, like = replays.rough, by_law_of(with_sections(start, fitted.parameters), fitted.truth)
    was = scales_by_kind(few.data, misfit_of(replays.data, fitted.residuals), noise_floor(few.data))
    groups = by_cause(fitted.parameters)
    found = explain(few, like, fitted.parameters, was)
    return findings(replace(found, truth=fitted.truth), groups, like, fitted.intervals())


def _compared(whole: Recording, axis: AxisConfig, truth: Truth) -> Comparison:
    """Compares a recording with a simulation, by kind of leg and on the held-out legs."""
    held = [each.model_copy(update={"kind": HELD_OUT}) for each in held_out_legs(whole)]
    simulated = replay(whole, axis, truth)
    return compare(whole.record, simulated, [*legs_of(whole), *held], axis.gear.ratio)


def with_knowledge(fitted: Fitted, data: Data, values: Values = Values.AXIS) -> Truth:
    """Returns the fitted truth with its intervals, and with the data for a later check in its provenance."""
    intervals, speed_rad_s = fitted.intervals(), rounded(rms_speed_rad_s(data), 6)
    measured = measured_mechanics(data, speed_rad_s)
    about: dict[str, Any] = {
        "parameters": [each.name for each in fitted.parameters],
        "noise": {name: rounded(fitted.scales.noise[name], 6) for name in CHANNELS},
        "misfit": misfit_of(data, fitted.residuals),
        "mechanics": {
            name: [rounded(each.value, 6), rounded(each.error, 6)]
            for name, each in measured.items()
            if name in COMPARED
        },
        "speed_rad_s": speed_rad_s,
    }
    truth = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    return truth.model_copy(
        update={
            "intervals": {each.path: intervals[each.name] for each in fitted.parameters},
            "provenance": {
                **truth.provenance, "values": str(values), "versions": versions_here(), "fit": about,
                **({"interrupted": True} if fitted.interrupted else {}),
            },
        }
    )  # fmt: skip
