"""What the steps of an identification hand on, and the fits that are made of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hdbridge.effects import Effect, FloatArray, is_ripple, ripple
from hdbridge.estimation.blocks import make_blocks
from hdbridge.estimation.design import Design, harmonics
from hdbridge.estimation.noise import NoiseModel, Precision
from hdbridge.estimation.nuisances import nuisances_of
from hdbridge.estimation.samples import Samples
from hdbridge.estimation.separable import Separable, Solution
from hdbridge.estimation.terms import Nuisances, Terms, Weighting, unknown
from hdbridge.identify.options import FitOptions
from hdbridge.identify.orders import Family, Order, Selection, System, select
from hdbridge.identify.result import Outliers
from hdbridge.identify.shape_search import LINEAR_ONLY
from hdbridge.units import DEG_PER_TURN

PARTS = ("cosine", "sine")
WHOLE_TURN = 0.95
"""Turns that count as one."""
COVERED_DEG = 30.0
"""A motor angle was seen when some angle within the same cell of this size was."""


class State(NamedTuple):
    """Where an identification stands."""

    options: FitOptions
    design: Design
    candidates: tuple[Order, ...]
    waves: FloatArray
    """Columns of the candidates, (b, 2 candidates)."""
    nuisances: tuple[str, ...]
    effects: tuple[Effect, ...]
    """All but the ripple."""
    noise: NoiseModel = NoiseModel(1.0, 1.0)
    selection: Selection = Selection((), ())
    ripple: Effect | None = None
    """As last fitted."""
    outliers: Outliers = Outliers(0, 0)
    delay_ms: float = 0.0
    """By which the samples have been put right already."""

    def precision(self) -> Precision:
        """Of the present noise model."""
        return Precision(self.noise, self.design.blocks)

    def in_addition(self) -> Nuisances:
        """Zeros and nuisances."""
        waves = []
        for order, amplitude_arcsec, phase_deg in self.ripple.waves() if self.ripple else ():
            at = 2 * self.candidates.index(Order.motor(round(order)))
            wave = amplitude_arcsec * np.exp(1j * np.deg2rad(phase_deg))
            turned = wave * (self.waves[:, at] + 1j * self.waves[:, at + 1])
            waves.append((order, turned.real, turned.imag))
        return nuisances_of(self.design, self.nuisances, self.effects, waves)

    def candidate_waves(self) -> Nuisances:
        """All candidates."""
        return unknown(self.waves, [f"{each} {part}" for each in self.candidates for part in PARTS])

    def columns(self) -> Nuisances:
        """Zeros and nuisances, and the chosen orders that are not the motor's."""
        others = [
            (f"{order} {part}", 2 * at + number)
            for at, order in enumerate(self.candidates)
            if order in self.selection.chosen and order.family is not Family.MOTOR
            for number, part in enumerate(PARTS)
        ]
        picked = self.waves[:, [at for _, at in others]]
        return self.in_addition().and_also(unknown(picked, [name for name, _ in others]))

    def model(self) -> tuple[Effect, ...]:
        """The chosen motor orders as the ripple, and the other effects."""
        motor = [each.number for each in self.selection.chosen if each.family is Family.MOTOR]
        return ((ripple(motor),) if motor else ()) + self.effects

    def under(self, weighting: Weighting, columns: Nuisances) -> Separable:
        """Fits of effects."""
        return Separable(Terms(self.design.blocks.error_arcsec, self.design.columns, weighting, columns))

    def fitted(self) -> Solution:
        """The minimum near where the model stands."""
        return self.under(self.precision(), self.columns()).fit(self.model())

    def information(self) -> System:
        """J' K^-1 J and J' K^-1 y of [candidates | zeros and nuisances | effects and their tangents].

        With the tangents in, shapes are refitted with every order that is tried.
        """
        precision, nuisances = self.precision(), self.candidate_waves().and_also(self.in_addition())
        found = self.under(precision, nuisances).fit(self.effects, LINEAR_ONLY)
        right = found.jacobian.T @ precision.apply(self.design.blocks.error_arcsec)
        mean, known = np.array(nuisances.prior).T
        right[: len(mean)] += known * mean
        return found.information, right

    def selected(self, system: System | None = None) -> State:
        """With the orders that this noise lets one see; ``system`` is `information`, where it is at hand."""
        options = self.options
        found = select(
            self.candidates, system or self.information(), options.family_wise, options.smallest_arcsec
        )
        return self._replace(selection=found)

    def after(self, solution: Solution) -> State:
        """With a solution's effects, and the blur that they bring."""
        effects = tuple(each for each in solution.effects if not is_ripple(each) and not each.violations())
        own = next(filter(is_ripple, solution.effects), None)
        return self._replace(effects=effects, design=self.design.blurred(effects), ripple=own)

    def remade(self, samples: Samples, weight: FloatArray, delay_ms: float) -> State:
        """With corrected samples and without outliers."""
        design = Design.of(samples, make_blocks(samples, weight), self.design.starts).blurred(self.effects)
        waves = harmonics(design, [each.per_motor_turn for each in self.candidates])
        return self._replace(design=design, waves=waves, delay_ms=delay_ms)


def candidate_orders(design: Design, options: FitOptions) -> tuple[Order, ...]:
    """Orders to look for: what the travel resolves.

    Neighbouring orders are apart from each other, and from all else that varies along the travel, from a
    whole turn on (Rayleigh): orders of the motor need a motor turn, those of load and flexspline enough of a
    load turn.
    """
    ratio = design.samples.ratio
    if turns_covered(design) < WHOLE_TURN:
        return ()
    samples = design.samples
    travel_deg = max(float(np.ptp(samples.motor_deg[samples.zero == each])) for each in range(samples.zeros))
    turns = travel_deg / DEG_PER_TURN
    motor = [Order.motor(number) for number in range(1, options.highest_order + 1)]
    if turns < WHOLE_TURN * ratio:
        return tuple(motor)
    numbers = range(1, options.load_orders + 1)
    return (
        *motor,
        *(Order.load(number, ratio) for number in numbers if number < ratio),
        *(Order.flexspline(number, ratio) for number in numbers if number * turns / ratio > 1.5),
    )


def turns_covered(design: Design) -> float:
    """Motor turns of different angles that were seen about one zero."""
    blocks = design.blocks
    cell = np.floor(blocks.motor_deg / COVERED_DEG).astype(np.intp)
    seen = (len(np.unique(cell[blocks.zero == zero])) for zero in range(design.samples.zeros))
    return max(seen, default=0) * COVERED_DEG / DEG_PER_TURN
