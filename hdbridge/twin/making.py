"""Makes a twin from recordings: fit, causes by which the start was wrong, inseparable sets, residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording, versions_here
from hdbridge.sim.truth import Truth
from hdbridge.twin.check import misfit_of
from hdbridge.twin.commands import legs_of
from hdbridge.twin.comparison import Comparison, compare
from hdbridge.twin.defaults import with_sections
from hdbridge.twin.fitting import FIT_S, fit
from hdbridge.twin.least_squares import Fitted, fitted_rows, legs_of_rows
from hdbridge.twin.loop_laws import by_law_of
from hdbridge.twin.misfit import CHANNELS, Data, coarse, held_out_legs, prepare
from hdbridge.twin.naming import Alike, Finding, alike, name_causes
from hdbridge.twin.noise import noise_in_motion, with_load_noise
from hdbridge.twin.parameters import LOAD
from hdbridge.twin.replay import replay_directly
from hdbridge.twin.replays import Replays
from hdbridge.twin.result import HELD_OUT, Twin, Values
from hdbridge.twin.structures import fit_structures, misfit
from hdbridge.twin.thermal import with_warmth
from hdbridge.twin.verdict import impossible, values_of, what_is_left


def fit_twin(
    recordings: Sequence[Recording],
    axis: AxisConfig,
    start: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Twin:
    """Fits the twin of an axis to recordings that have the commanded motor angle.

    ``start`` is the initial simulation: the translated axis file and model, or an older twin. Replays run in
    ``workers`` processes. InputError if a recording has no command or is of another gear.

    Causes are named only if the values before and after the fit are the axis's; intervals are given only if
    those after it are.
    """
    whole = Recording.joined(list(recordings))
    data = coarse(prepare(whole, axis, start), FIT_S)
    with Replays(data, workers) as replays:
        noise = noise_in_motion(data)
        found = fit(replays, lambda share: progress(0.7 * share))
        if found is None or values_of(what_is_left(data, found.residuals, noise)) is Values.REPLAY:
            other = fit_structures(replays, start, lambda share: progress(0.7 + 0.2 * share))
            found = min([found or other, other], key=lambda each: misfit(data, each.residuals))
        fitted = found
        left = what_is_left(data, fitted.residuals, noise)
        values = values_of(left)
        findings: tuple[Finding, ...] = ()
        sets: dict[Alike, None] = {}
        if values is Values.AXIS:
            if Values.of(start) in {None, Values.AXIS}:
                like = by_law_of(with_sections(start, fitted.parameters), fitted.truth)
                findings, rivals = name_causes(replays, like, fitted)
                sets = dict.fromkeys(rivals)
            sets |= dict.fromkeys(alike(fitted, legs_of_rows(data, fitted_rows(data))))
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
        tuple(sets),
        left,
        before,
        after,
        impossible(truth, axis, cycle_s) if values is Values.REPLAY else (),
    )


def _compared(whole: Recording, axis: AxisConfig, truth: Truth) -> Comparison:
    """Compares a recording with one simulation by kind of leg, and on the held-out legs."""
    held = [each.model_copy(update={"kind": HELD_OUT}) for each in held_out_legs(whole)]
    simulated = replay_directly(whole, axis, truth)
    return compare(whole.record, simulated, [*legs_of(whole), *held], axis.gear.ratio)


def with_knowledge(fitted: Fitted, data: Data, values: Values = Values.AXIS) -> Truth:
    """Returns the fitted truth with its intervals, and the data for a later check in its provenance."""
    intervals = fitted.intervals()
    about: dict[str, Any] = {
        "parameters": [each.name for each in fitted.parameters],
        "covariance": [[float(f"{value:.6g}") for value in row] for row in fitted.covariance.tolist()],
        "noise": {name: float(f"{fitted.scales.noise[name]:.6g}") for name in CHANNELS},
        "misfit": misfit_of(data, fitted.residuals),
    }
    truth = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    return truth.model_copy(
        update={
            "intervals": {".".join(each.path): intervals[each.name] for each in fitted.parameters},
            "provenance": {
                **truth.provenance, "values": str(values), "versions": versions_here(), "fit": about,
            },
        }
    )  # fmt: skip
