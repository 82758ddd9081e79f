"""Identifies a model from a measurement: all steps in order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdbridge.analysis.blocks import Design, harmonics, make_blocks
from hdbridge.analysis.conclude import conclude, covariance, gain_of_law, of_effect
from hdbridge.analysis.identification import (
    LINEAR_ONLY,
    FitOptions,
    FitResult,
    State,
    candidate_orders,
    oscillation,
    outlying,
    searched,
    swinging,
    turns_covered,
    usable_samples,
)
from hdbridge.analysis.noise import fit_noise
from hdbridge.analysis.nuisances import (
    DELAY,
    ROUNDING,
    SHARE,
    SWING,
    SWING_COUNT_ARCSEC,
    TURNS,
    delay_column,
    share_left,
    speeds_differ,
    zeros,
)
from hdbridge.analysis.orders import System
from hdbridge.analysis.prepared import Measured, Samples
from hdbridge.analysis.separable import Solution
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, Start, in_place
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

MINIMUM_USABLE = 50
LEAST_TRAVEL_DEG = 10.0
"""Minimum motor travel. A shorter record has only a rest, the beginning of a move and half of a loop."""
NO_DEGREES = "where the axis went further, both angles are in radians or turns: convert them to degrees"
"""Hint about units. If both angles are in the same wrong unit, their ratio is still right, and only the short
travel reveals the error."""
EFFECT_SHARE = 1e-3
"""Minimum fraction of a visible effect's sum of squares that zero offsets and orders do not explain."""
ROUNDS = 3


def fit(measured: Measured, ratio: float, options: FitOptions | None = None) -> FitResult:
    """Identifies an axis of gear ratio ``ratio`` from a measurement.

    Raises InputError if the record cannot be used at all. The result's ``warnings`` list the quantities that
    the record does not determine.
    """
    options = options or FitOptions()
    warnings: list[str] = []
    if options.start is not None:
        measured = replace(measured, states={0: options.start} | {**measured.states})
    samples = usable_samples(measured, ratio)
    name = f"{measured.record.source}: " if measured.record.source else ""
    usable = int(np.count_nonzero(samples.usable))
    if usable < MINIMUM_USABLE:
        raise InputError(
            f"{name}only {usable} of {len(samples)} samples are slow enough to be used; "
            f"expected at least {MINIMUM_USABLE}: record slow sweeps, sines and rests"
        )
    travel = max(
        float(np.ptp(samples.motor_deg[rows]))
        for rows in (
            samples.usable & (samples.zero == each) for each in np.unique(samples.zero[samples.usable])
        )
    )
    if travel < LEAST_TRAVEL_DEG:
        raise InputError(
            f"{name}the motor moves by {travel:.2g} deg in the {usable} of {len(samples)} "
            f"samples that are slow and steady enough to be used; expected at least "
            f"{LEAST_TRAVEL_DEG:g}: record slow sweeps at a steady speed, both ways ({NO_DEGREES})"
        )
    if usable < 0.5 * len(samples):
        warnings.append(
            f"only {usable} of {len(samples)} samples were used: what is fast or accelerates is left out"
        )
    if sway := oscillation(measured, samples):
        warnings.append(sway)
    state = _prepare(samples, options, warnings)
    state, solution, system = _with_best_law(*_settle(_search(state, warnings)))
    solution, cov = _hold_what_is_unknown(state, solution, warnings)
    return conclude(state, solution, cov, system, warnings)


def _prepare(samples: Samples, options: FitOptions, warnings: list[str]) -> State:
    """Prepares blocks and columns, and selects the effects and nuisances that are visible in the record."""
    starts = [each.start or Start.FORWARD for each in samples.chains]
    design = Design.of(samples, make_blocks(samples), starts)
    candidates = candidate_orders(design, options)
    if not candidates:
        warnings.append(
            f"orders are not fitted: only {turns_covered(design):.2f} turns of the motor are seen, on which "
            f"they cannot be distinguished from anything else; sweep over a turn or more ({NO_DEGREES})"
        )
    waves = harmonics(design, [each.per_motor_turn for each in candidates])
    free = zeros(design.blocks.zero, samples.zeros).columns
    always = np.concatenate([free, waves], axis=1)
    weight = design.blocks.count
    effects: list[Effect] = []
    for effect in options.effects:
        missing = [each.value for each in effect.channels if each not in samples.motion.available()]
        if missing:
            warnings.append(f"{effect.name}: not fitted, the record has no {', '.join(missing)}")
            continue
        prototype = options.prototype(effect)
        if share_left(design.columns(prototype), always, weight) < EFFECT_SHARE:
            warnings.append(
                f"{effect.name}: left out: not separable from the zero in this record (no reversal?); "
                "record both directions"
            )
            continue
        effects.append(prototype)
    known = np.concatenate([free, *(design.columns(each) for each in effects)], axis=1)
    nuisances = []
    delay = delay_column(design)
    size = float(np.sqrt(weight @ delay[:, 0] ** 2 / np.sum(weight)))
    if size > 1e-3 and share_left(delay, known, weight) > SHARE:
        nuisances.append(DELAY)
    elif effects and size > 0.05:
        warnings.append(
            "a delay between the two encoders is not separable from the hysteresis offset at one speed: "
            f"one millisecond would be {size:.2f} arcsec; record a second speed"
        )
    if samples.count_deg and effects:
        nuisances += [ROUNDING, TURNS]
    fine = samples.count_deg / samples.ratio * ARCSEC_PER_DEG < SWING_COUNT_ARCSEC
    moving = design.blocks.moving
    if fine and speeds_differ(design.blocks.speed_deg_s[moving], design.blocks.count[moving]):
        nuisances.append(SWING)
    return State(options, design, candidates, waves, tuple(nuisances), tuple(effects))


def _search(state: State, warnings: list[str]) -> State:
    """Finds shape parameters on a grid, unknown initial elastic states, and an initial noise model."""
    simple = state._replace(nuisances=tuple(each for each in state.nuisances if each != TURNS))
    columns = simple.in_addition().and_also(state.candidate_waves())

    def found(begun: State) -> tuple[Solution, State]:
        return searched(begun.under(begun.precision(), columns), begun.effects), begun

    best = found(state)
    for number, chain in enumerate(state.design.samples.chains):
        if chain.start is None and state.effects:
            begun = best[1]._replace(effects=best[0].effects)
            starts = begun.design.starts
            others = [
                begun._replace(design=begun.design.beginning([*starts[:number], each, *starts[number + 1 :]]))
                for each in (Start.VIRGIN, Start.BACKWARD)
            ]
            best = min((best, *map(found, others)), key=lambda each: each[0].chi_square)
    solution, state = best
    for each in solution.effects:
        if each.violations():
            warnings.append(f"{each.name}: left out, the record shows it only with an impossible sign")
    effects = tuple(each for each in solution.effects if not each.violations())
    state = state._replace(design=state.design.blurred(effects), effects=effects)
    solution = state.under(state.precision(), columns).fit(effects, LINEAR_ONLY)
    return state._replace(noise=fit_noise(solution.residual, state.design.blocks, solution.jacobian.shape[1]))


def _settle(state: State) -> tuple[State, Solution, System]:
    """Determines outliers and delay, then refits and updates orders and noise until the orders settle."""
    state = state.selected()
    solution = state.fitted()
    samples = state.design.samples
    weight, outliers = outlying(
        state.design.residual(solution.effects, state.columns().columns @ solution.nuisances),
        swinging(samples),
        samples.count_deg / samples.ratio * ARCSEC_PER_DEG,
    )
    state = state._replace(outliers=outliers)
    delay_ms = _value(solution, DELAY)
    if outliers.samples or delay_ms:
        state = state.after(solution).remade(samples.delayed(delay_ms / 1000.0), weight, delay_ms)
    for turn in range(ROUNDS):
        state = state.after(solution)
        solution = state.fitted()
        noise = fit_noise(solution.residual, state.design.blocks, solution.jacobian.shape[1], state.noise)
        state = state.after(solution)._replace(noise=noise)
        system, before = state.information(), state.selection.chosen
        state = state.selected(system)
        if state.selection.chosen == before and turn:
            break
    solution = state.fitted()
    if _value(solution, SWING) < 0.0:
        # Below its resonance a load amplifies the error. A negative coefficient therefore has a
        # different speed-dependent cause.
        state = state._replace(nuisances=tuple(each for each in state.nuisances if each != SWING))
        solution = state.fitted()
        system = state.information()
    state = state.after(solution)
    if len(state.columns().names) != len(solution.nuisances):
        # Oscillation columns of newly selected orders, or newly relevant turning points, were added.
        solution = state.fitted()
        system = state.information()
    return state, solution, system


def _with_best_law(state: State, solution: Solution, system: System) -> tuple[State, Solution, System]:
    """Replaces an effect's law by an alternative with clearly better held-out predictions, if any."""
    for effect in state.effects:
        for law in in_place(effect, CATALOGUE.values()):
            effects = tuple(law if each is effect else each for each in state.effects)
            trial = state._replace(effects=effects, design=state.design.blurred(effects))
            found = searched(trial.under(trial.precision(), trial.columns()), trial.model())
            if any(each.violations() for each in found.effects):
                continue
            gain = gain_of_law((state, solution), (trial, found))
            least = state.options.smallest_arcsec
            if gain.sure and gain.explained_arcsec > least:
                return _settle(trial.after(found))
    return state, solution, system


def _value(solution: Solution, nuisance: str) -> float:
    """Returns the value of a nuisance; 0 if it is not fitted."""
    names = [each.name for each in solution.columns[: len(solution.nuisances)]]
    return float(solution.nuisances[names.index(nuisance)]) if nuisance in names else 0.0


def _hold_what_is_unknown(
    state: State, solution: Solution, warnings: list[str]
) -> tuple[Solution, FloatArray]:
    """Resets undetermined shape parameters to their initial values, and refits the rest.

    Returns the solution and its covariance.
    """
    options, blocks = state.options, state.design.blocks
    cov = covariance(solution, state.precision(), blocks)
    effects = list(solution.effects)
    for index, effect in enumerate(solution.effects):
        unknown = [each for each in of_effect(solution, index, cov) if not each.identifiable]
        edge = [name for owner, name in solution.at_bound if owner == index]
        if edge and not unknown:
            warnings.append(
                f"{effect.name}: {', '.join(edge)} ended on the edge of its range: do not trust its "
                "interval, or the law is not this gear's"
            )
        if unknown:
            prototype = options.prototype(effect)
            shape = {each.name: float(getattr(prototype, each.name)) for each in effect.shape}
            effects[index] = effect.fitted(effect.coefficients(), shape)
            names = [each.parameter for each in unknown]
            warnings.append(
                f"{effect.name}: {' and '.join(names)} cannot be identified from this record; its shape is "
                "kept as it was: record slow sines and nested reversals"
            )
    if tuple(effects) != solution.effects:
        solution = state.under(state.precision(), state.columns()).fit(effects, LINEAR_ONLY)
        cov = covariance(solution, state.precision(), blocks)
    return solution, cov
