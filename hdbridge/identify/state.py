"""What the steps of an identification hand on, and the problems that are made of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hdbridge.effects import Effect, FloatArray, is_ripple, ripple
from hdbridge.estimation.blocks import make_blocks
from hdbridge.estimation.design import Design, harmonics
from hdbridge.estimation.noise import NoiseModel, Precision
from hdbridge.estimation.nuisances import nuisances_of
from hdbridge.estimation.samples import Samples
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.shapes import tangent
from hdbridge.estimation.terms import Nuisances
from hdbridge.identify.options import FitOptions
from hdbridge.identify.orders import Family, Order, Selection, System, select
from hdbridge.identify.problem import Problem
from hdbridge.units import DEG_PER_TURN

WHOLE_TURN = 0.95
"""Turns that count as one."""
COVERED_DEG = 30.0
"""A motor angle was seen when some angle within the same cell of this size was."""


class State(NamedTuple):
    """Where an identification stands."""

    design: Design
    candidates: tuple[Order, ...]
    waves: FloatArray
    """Columns of the candidates, (b, 2 candidates)."""
    nuisances: tuple[str, ...]
    effects: tuple[Effect, ...]
    """All but the ripple."""
    noise: NoiseModel
    delay_ms: float = 0.0
    """By which the samples have been put right already."""
    ripple: Effect | None = None
    """As last fitted."""

    def nuisance_columns(self) -> Nuisances:
        """Zeros and nuisances."""
        return nuisances_of(self.design, self.nuisances, self.effects, self._shaking())

    def _shaking(self) -> list[tuple[float, FloatArray, FloatArray]]:
        """Orders of the ripple, what each contributes to the blocks, and a quarter later."""
        if self.ripple is None:
            return []
        places = {
            float(each.number): at for at, each in enumerate(self.candidates) if each.family is Family.MOTOR
        }
        waves = []
        for order, amplitude_arcsec, phase_deg in self.ripple.waves():
            phase = np.deg2rad(phase_deg)
            pair = self.waves[:, 2 * places[order] : 2 * places[order] + 2]
            both = amplitude_arcsec * np.array(
                [[np.cos(phase), np.sin(phase)], [-np.sin(phase), np.cos(phase)]]
            )
            now, later = (pair @ both).T
            waves.append((order, now, later))
        return waves

    def precision(self) -> Precision:
        """Of the present noise model."""
        return Precision(self.noise, self.design.blocks)

    def information(self) -> System:
        """J' K^-1 J and J' K^-1 y of [candidates | zeros and nuisances | effects and their tangents].

        With the tangents in, shapes are refitted with every order that is tried.
        """
        extra = self.nuisance_columns()
        parts = [self.waves, extra.columns]
        for effect in self.effects:
            parts.append(self.design.roughly(effect))
            parts += [
                tangent(self.design.roughly, effect, each, central=True)[:, np.newaxis]
                for each in effect.shape
            ]
        columns = np.concatenate(parts, axis=1)
        weighted = self.precision().apply(columns)
        gram = columns.T @ weighted
        first = self.waves.shape[1]
        inside = np.arange(first, first + len(extra.prior))
        gram[inside, inside] += extra.prior
        return gram, weighted.T @ self.design.blocks.error_arcsec

    def selected(self, options: FitOptions, system: System | None = None) -> Selection:
        """The orders that this noise lets one see; ``system`` is `information`, where it is at hand."""
        information, right = system or self.information()
        return select(self.candidates, information, right, options.family_wise, options.smallest_arcsec)

    def problem(self, selection: Selection) -> Problem:
        """Motor orders as the ripple, other effects; orders not the motor's in addition."""
        motor = [each.number for each in selection.chosen if each.family is Family.MOTOR]
        others = [
            index
            for index, each in enumerate(self.candidates)
            if each in selection.chosen and each.family is not Family.MOTOR
        ]
        picked = [2 * index + part for index in others for part in (0, 1)]
        names = [f"{self.candidates[index]} {part}" for index in others for part in ("cosine", "sine")]
        effects = ((ripple(motor),) if motor else ()) + self.effects
        return Problem(self.design, effects, self.nuisance_columns().and_waves(self.waves[:, picked], names))

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
    turns = design.samples.travel_deg / DEG_PER_TURN
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
