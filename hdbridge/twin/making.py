"""A twin from recordings: the fit, what was wrong before, what cannot be told apart, what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording, versions_here
from hdbridge.sim.truth import Truth
from hdbridge.twin.commands import legs_of
from hdbridge.twin.comparison import Comparison, compare
from hdbridge.twin.defaults import with_sections
from hdbridge.twin.fitting import FIT_S, fit
from hdbridge.twin.least_squares import Fitted, fitted_rows, legs_of_rows
from hdbridge.twin.loop_laws import by_law_of
from hdbridge.twin.misfit import CHANNELS, coarse, held_out_legs, prepare
from hdbridge.twin.naming import alike, name_causes, unexplained
from hdbridge.twin.noise import noise_in_motion, with_load_noise
from hdbridge.twin.parameters import LOAD
from hdbridge.twin.replay import replay_directly
from hdbridge.twin.replays import Replays
from hdbridge.twin.result import HELD_OUT, Twin
from hdbridge.twin.thermal import with_warmth


def fit_twin(
    recordings: Sequence[Recording],
    axis: AxisConfig,
    start: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Twin:
    """The twin of an axis, from recordings that have the commanded motor angle.

    ``start`` is what is assumed of it: the translated axis file and model, or an older twin. Replays run in
    ``workers`` processes. InputError where a recording has no command or is of another gear.
    """
    whole = Recording.joined(list(recordings))
    data = coarse(prepare(whole, axis, start), FIT_S)
    with Replays(data, workers) as replays:
        fitted = fit(replays, lambda share: progress(0.9 * share))
        like = by_law_of(with_sections(start, fitted.parameters), fitted.truth)
        findings, rivals = name_causes(replays, like, fitted)
        (left,) = replays([fitted.truth])
        sets = dict.fromkeys((*rivals, *alike(fitted, legs_of_rows(data, fitted_rows(data)))))
        rest = unexplained(data, left, noise_in_motion(data))
    truth, warmth = with_warmth(whole, axis, fitted, with_knowledge(fitted))
    if warmth is not None:
        findings = (*findings, warmth)
    before, after = (_compared(whole, axis, each) for each in (start, truth))
    progress(1.0)
    return Twin(truth, findings, tuple(sets), rest, before, after)


def _compared(whole: Recording, axis: AxisConfig, truth: Truth) -> Comparison:
    """A recording against one simulation, by kind of leg and for those held out."""
    held = [each.model_copy(update={"kind": HELD_OUT}) for each in held_out_legs(whole)]
    simulated = replay_directly(whole, axis, truth)
    return compare(whole.record, simulated, [*legs_of(whole), *held], axis.gear.ratio)


def with_knowledge(fitted: Fitted) -> Truth:
    """The fitted truth with its intervals and what a later check needs, as its file has it."""
    intervals = fitted.intervals()
    about: dict[str, Any] = {
        "parameters": [each.name for each in fitted.parameters],
        "covariance": [[float(f"{value:.6g}") for value in row] for row in fitted.covariance.tolist()],
        "noise": {name: float(f"{fitted.scales.noise[name]:.6g}") for name in CHANNELS},
    }
    truth = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    return truth.model_copy(
        update={
            "intervals": {".".join(each.path): intervals[each.name] for each in fitted.parameters},
            "provenance": {**truth.provenance, "versions": versions_here(), "fit": about},
        }
    )
