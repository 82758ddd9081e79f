"""Everything that is derived from the final solution, put together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from hdbridge.effects import FloatArray, Part
from hdbridge.estimation.design import Design
from hdbridge.estimation.intervals import NORMAL_95, nested_half_widths
from hdbridge.estimation.nuisances import DELAY, TEXTS, UNITS, delay_column
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.stretches import about_zeros
from hdbridge.identify.covariance import of_effect
from hdbridge.identify.figures import laps_arcsec, standing_arcsec
from hdbridge.identify.holdout import held_out
from hdbridge.identify.orders import Family, Line, Order, System, spectrum
from hdbridge.identify.residuals import residual_tests
from hdbridge.identify.result import FitResult, NoiseFigures, Nuisance, Traces
from hdbridge.identify.state import State
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

MOST_NAMED = 4
"""Orders that are named one by one."""


def conclude(
    state: State, solution: Solution, cov: FloatArray, system: System, warnings: list[str]
) -> FitResult:
    """The result of an identification; ``system`` is the state's, with the final noise."""
    design, blocks, samples = state.design, state.design.blocks, state.design.samples
    precision, chosen = state.precision(), state.selection.chosen
    intervals = [each for index in range(len(solution.effects)) for each in of_effect(solution, index, cov)]
    effects = tuple(each for each in solution.effects if not each.violations())
    uncertainty = {each.name: nested_half_widths(each, intervals) for each in effects}
    inside = _inside_variance(design, solution, state.columns().columns @ solution.nuisances)
    # Samples were put right by the delay, which no model holds.
    measured = blocks.error_arcsec + state.delay_ms * delay_column(design)[:, 0]
    written = about_zeros(measured - design.told(effects), blocks.zero, blocks.count)

    def rms(left_arcsec: FloatArray) -> float:
        return math.sqrt(float(blocks.count @ left_arcsec**2) / float(np.sum(blocks.count)) + inside)

    ones = np.ones(len(blocks))
    figures = NoiseFigures(
        standing_arcsec=standing_arcsec(samples),
        laps_arcsec=laps_arcsec(samples),
        model=state.noise,
        residual_arcsec=rms(written),
        fitted_arcsec=rms(solution.residual),
        samples=int(np.sum(blocks.count)),
        effective_samples=rms(solution.residual) ** 2 * float(ones @ precision.apply(ones)),
    )
    further = {
        column.name: (value, NORMAL_95 * math.sqrt(max(variance, 0.0)))
        for column, value, variance in zip(
            solution.columns, solution.nuisances.tolist(), np.diag(cov).tolist(), strict=False
        )
    }
    zeros = tuple(value for name, (value, _) in further.items() if name.startswith("zero"))
    waves = design.told([each for each in solution.effects if each.part is Part.ORDERS])
    lines = spectrum(state.candidates, chosen, system, state.options.family_wise)
    _describe_limits(state, lines, warnings)
    used = blocks.count > 0  # a block all of whose samples were given no weight has no mean to be drawn
    return FitResult(
        model=TransmissionModel(samples.ratio, effects, uncertainty),
        intervals=tuple(intervals),
        zeros_arcsec=zeros,
        nuisances=_nuisances(state, further),
        noise=figures,
        outliers=state.outliers,
        orders=tuple(each for each in lines if each.order in chosen and each.order.family is Family.MOTOR),
        spectrum=lines,
        residual_tests=residual_tests(
            solution.residual,
            blocks,
            precision,
            [each for each in lines if each.order not in chosen],
            figures,
        ),
        held_out=held_out(state, solution, measured, inside),
        traces=Traces(
            time_s=blocks.time_s[used],
            motor_deg=blocks.motor_deg[used],
            load_deg=(blocks.motor_deg / samples.ratio + blocks.error_arcsec / ARCSEC_PER_DEG)[used],
            direction=(blocks.heading * blocks.moving)[used],
            kind=samples.kinds,
            kind_index=blocks.kind[used],
            error_arcsec=(blocks.error_arcsec - np.array(zeros)[blocks.zero])[used],
            predicted_arcsec=design.told(solution.effects)[used],
            residual_arcsec=written[used],
            orders_arcsec=(solution.residual + waves)[used],
        ),
        warnings=tuple(warnings),
    )


def _inside_variance(design: Design, solution: Solution, nuisances: FloatArray) -> float:
    """Variance of the residual of samples about the mean of their block."""
    blocks = design.blocks
    residual = design.residual(solution.effects, nuisances)
    off = residual[blocks.index] - np.repeat(blocks.mean(residual), blocks.sizes)
    return float(blocks.weight @ off**2) / max(float(np.sum(blocks.count)), 1.0)


def _nuisances(state: State, further: Mapping[str, tuple[float, float]]) -> tuple[Nuisance, ...]:
    """What of all that was fitted in addition (``further``: value and half width) has a meaning."""
    found = []
    for name in state.nuisances:
        if name in TEXTS and name in further:
            value, half = further[name]
            value += state.delay_ms if name == DELAY else 0.0
            found.append(Nuisance(name, TEXTS[name], value, half, UNITS[name]))
    for order in _not_the_motors(state):
        cosine, sine = further[f"{order} cosine"], further[f"{order} sine"]
        text = f"an error that repeats with {order}, which the model has no part for"
        size = math.hypot(cosine[0], sine[0])
        found.append(Nuisance(str(order), text, size, max(cosine[1], sine[1]), "arcsec"))
    return tuple(found)


def _not_the_motors(state: State) -> list[Order]:
    return [each for each in state.selection.chosen if each.family is not Family.MOTOR]


def _describe_limits(state: State, lines: Sequence[Line], warnings: list[str]) -> None:
    """Warnings about what the record's angles cannot tell apart, and about samples left out."""
    samples, outliers = state.design.samples, state.outliers
    for alike in _families(lines):
        warnings.append(f"{_named(alike)} cannot be distinguished at the angles of this record")
    if state.selection.unresolved:
        unresolved = _named(state.selection.unresolved)
        warnings.append(f"{unresolved} cannot be distinguished from what else was fitted")
    load_turns = float(np.ptp(state.design.blocks.motor_deg)) / DEG_PER_TURN / samples.ratio
    if load_turns < 0.95:
        warnings.append(
            f"the record spans {load_turns:.2f} load turns: errors that repeat with the "
            "load turn cannot be seen and may bend the rest; sweep over two"
        )
    if outliers.samples:
        share = outliers.samples / len(samples)
        warnings.append(
            f"{outliers.samples} samples ({share:.2%}, at most {outliers.longest_run} in a row) stand out "
            "from their neighbours and were given no weight: look for lost counts, plugs, shields"
        )
    for order in _not_the_motors(state):
        warnings.append(
            f"{order} shows in this record; the model has no part for it, a diagnosis may name it"
        )


def _families(lines: Sequence[Line]) -> list[list[Order]]:
    """Orders that hang together as aliases of each other."""
    alike = [[other.order in each.aliases for other in lines] for each in lines]
    number = connected_components(np.array(alike).reshape(len(lines), -1))[1].tolist() if lines else []
    families = [
        [each.order for each, own in zip(lines, number, strict=True) if own == one]
        for one in range(len(lines))
    ]
    return [each for each in families if len(each) > 1]


def _named(orders: Sequence[Order]) -> str:
    """Their names; of many only the first and the last."""
    if len(orders) > MOST_NAMED:
        return f"{orders[0]} to {orders[-1]} ({len(orders)} orders)"
    return " and ".join(map(str, orders))
