"""Everything that is derived from the final solution, put together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hdbridge.effects import FloatArray, Part
from hdbridge.estimation.design import Design
from hdbridge.estimation.intervals import NORMAL_95, nested_half_widths
from hdbridge.estimation.nuisances import DELAY, TEXTS, UNITS, delay_column
from hdbridge.estimation.samples import KINDS, Samples
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.stretches import about_zeros
from hdbridge.identify.covariance import of_effect
from hdbridge.identify.figures import laps_arcsec, standing_arcsec
from hdbridge.identify.holdout import held_out
from hdbridge.identify.options import FitOptions
from hdbridge.identify.orders import Family, Order, Selection, System, threshold
from hdbridge.identify.residuals import residual_tests
from hdbridge.identify.result import ChosenOrder, FitResult, NoiseFigures, Nuisance, Outliers, Traces
from hdbridge.identify.spectrum import Spectrum, plain_spectrum, spectrum
from hdbridge.identify.state import State
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG

MOST_NAMED = 4
"""Orders that are named one by one."""


def conclude(
    state: State,
    solution: Solution,
    cov: FloatArray,
    selection: Selection,
    system: System,
    outliers: Outliers,
    options: FitOptions,
    warnings: list[str],
) -> FitResult:
    """The result of an identification; ``system`` is the state's, with the final noise."""
    design, blocks, samples = state.design, state.design.blocks, state.design.samples
    problem = state.problem(selection)
    precision = state.precision()
    intervals = [each for index in range(len(solution.effects)) for each in of_effect(solution, index, cov)]
    effects = tuple(each for each in solution.effects if not each.violations())
    uncertainty = {each.name: nested_half_widths(each, intervals) for each in effects}
    inside = _inside_variance(design, solution, problem.nuisances.columns @ solution.nuisances)
    samples_used = float(np.sum(blocks.count))
    fitted_rms = math.sqrt(float(blocks.count @ solution.residual**2) / samples_used + inside)
    # Samples were put right by the delay, which no model holds.
    measured = blocks.error_arcsec + state.delay_ms * delay_column(design)[:, 0]
    written = about_zeros(measured - design.told(effects), blocks.zero, blocks.count)
    residual_rms = math.sqrt(float(blocks.count @ written**2) / samples_used + inside)
    ones = np.ones(len(blocks))
    figures = NoiseFigures(
        standing_arcsec=standing_arcsec(samples),
        laps_arcsec=laps_arcsec(samples),
        model=state.noise,
        residual_arcsec=residual_rms,
        fitted_arcsec=fitted_rms,
        samples=int(samples_used),
        effective_samples=fitted_rms**2 * float(ones @ precision.apply(ones)),
    )
    further = _further(solution, cov)
    zeros = tuple(value for name, (value, _) in further.items() if name.startswith("zero"))
    clean = solution.residual + design.told([each for each in solution.effects if each.part is Part.ORDERS])
    shown = blocks.moving if np.count_nonzero(blocks.moving) > 0.5 * len(blocks) else blocks.count > 0
    lines = spectrum(
        state.candidates,
        selection.chosen,
        system,
        blocks.motor_deg,
        samples.ratio,
        plain_spectrum(blocks.motor_deg[shown], clean[shown], blocks.count[shown]),
        options.family_wise,
    )
    _describe_limits(selection, lines, outliers, samples, warnings)
    active = design.told(options.active.effects if options.active else ())
    return FitResult(
        model=TransmissionModel(samples.ratio, effects, uncertainty),
        intervals=tuple(intervals),
        zeros_arcsec=zeros,
        nuisances=_nuisances(state, further, selection),
        noise=figures,
        outliers=outliers,
        orders=_chosen(lines, selection, len(state.candidates), options),
        spectrum=lines,
        residual_tests=residual_tests(
            solution.residual, blocks, precision, lines, {str(each) for each in selection.chosen}, figures
        ),
        held_out=held_out(
            problem,
            solution,
            state.noise,
            active,
            measured,
            inside,
            against="the active model" if options.active else "no model",
        ),
        traces=_traces(design, solution, zeros, written),
        warnings=tuple(warnings),
    )


def _traces(design: Design, solution: Solution, zeros: Sequence[float], left_arcsec: FloatArray) -> Traces:
    """What is drawn: a block all of whose samples were given no weight has no mean to be drawn."""
    blocks, ratio = design.blocks, design.samples.ratio
    used = blocks.count > 0
    return Traces(
        time_s=blocks.time_s[used],
        motor_deg=blocks.motor_deg[used],
        load_deg=(blocks.motor_deg / ratio + blocks.error_arcsec / ARCSEC_PER_DEG)[used],
        direction=(blocks.heading * blocks.moving)[used],
        kind=tuple(each.value for each in KINDS),
        kind_index=blocks.kind[used],
        error_arcsec=(blocks.error_arcsec - np.array(zeros)[blocks.zero])[used],
        predicted_arcsec=design.told(solution.effects)[used],
        residual_arcsec=left_arcsec[used],
    )


def _inside_variance(design: Design, solution: Solution, nuisances: FloatArray) -> float:
    """Variance of the residual of samples about the mean of their block."""
    blocks = design.blocks
    residual = design.residual(solution.effects, nuisances)[blocks.index]
    sizes = np.diff(np.append(blocks.first, len(blocks.index)))
    mean = np.add.reduceat(blocks.weight * residual, blocks.first) / np.maximum(blocks.count, 1.0)
    off = residual - np.repeat(mean, sizes)
    return float(blocks.weight @ off**2) / max(float(np.sum(blocks.count)), 1.0)


def _chosen(
    lines: Spectrum, selection: Selection, candidates: int, options: FitOptions
) -> tuple[ChosenOrder, ...]:
    needed = threshold(candidates, options.family_wise)
    return tuple(
        ChosenOrder(
            each.order,
            each.amplitude_arcsec,
            (each.amplitude_arcsec / max(each.standard_error_arcsec, 1e-12)) ** 2,
            needed,
        )
        for each in lines.lines
        if each.order in selection.chosen and each.order.family is Family.MOTOR
    )


def _further(solution: Solution, cov: FloatArray) -> dict[str, tuple[float, float]]:
    """Value and half width of every column that is no effect's, by its name."""
    places = [at for at, each in enumerate(solution.columns) if each.effect < 0]
    return {
        solution.columns[at].name: (value, NORMAL_95 * math.sqrt(max(float(cov[at, at]), 0.0)))
        for at, value in zip(places, solution.nuisances.tolist(), strict=True)
    }


def _nuisances(
    state: State, further: dict[str, tuple[float, float]], selection: Selection
) -> tuple[Nuisance, ...]:
    found = []
    for name in state.nuisances:
        if name not in TEXTS or name not in further:
            continue
        value, half = further[name]
        found.append(
            Nuisance(name, TEXTS[name], value + (state.delay_ms if name == DELAY else 0.0), half, UNITS[name])
        )
    for order in selection.chosen:
        if order.family is Family.MOTOR:
            continue
        cosine, sine = further[f"{order} cosine"], further[f"{order} sine"]
        text = f"an error that repeats with {order}, which the model has no part for"
        size = math.hypot(cosine[0], sine[0])
        found.append(Nuisance(str(order), text, size, max(cosine[1], sine[1]), "arcsec"))
    return tuple(found)


def _describe_limits(
    selection: Selection, lines: Spectrum, outliers: Outliers, samples: Samples, warnings: list[str]
) -> None:
    """Warnings about what the record's angles cannot tell apart, and about samples left out."""
    for alike in _families([(one, other) for one, other, _ in lines.resolution.aliases]):
        warnings.append(f"{_named(alike)} cannot be distinguished at the angles of this record")
    if selection.unresolved:
        warnings.append(f"{_named(selection.unresolved)} cannot be distinguished from what else was fitted")
    if lines.resolution.load_turns < 0.95:
        warnings.append(
            f"the record spans {lines.resolution.load_turns:.2f} load turns: errors that repeat with the "
            "load turn cannot be seen and may bend the rest; sweep over two"
        )
    if outliers.samples:
        share = outliers.samples / len(samples)
        warnings.append(
            f"{outliers.samples} samples ({share:.2%}, at most {outliers.longest_run} in a row) stand out "
            "from their neighbours and were given no weight: look for lost counts, plugs, shields"
        )
    for order in selection.chosen:
        if order.family is not Family.MOTOR:
            warnings.append(
                f"{order} shows in this record; the model has no part for it, a diagnosis may name it"
            )


def _families(twins: Sequence[tuple[Order, Order]]) -> list[list[Order]]:
    """What hangs together by pairs, each in the order in which it was met."""
    families: list[list[Order]] = []
    for pair in twins:
        joined = [each for each in families if pair[0] in each or pair[1] in each]
        whole = list(dict.fromkeys(order for each in (*joined, pair) for order in each))
        families = [each for each in families if each not in joined] + [whole]
    return families


def _named(orders: Sequence[Order]) -> str:
    """Their names; of many only the first and the last."""
    if len(orders) > MOST_NAMED:
        return f"{orders[0]} to {orders[-1]} ({len(orders)} orders)"
    return " and ".join(map(str, orders))
