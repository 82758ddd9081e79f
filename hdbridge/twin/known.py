"""How sure a change against a twin is: by the new recording, and by what the twin's own recordings left open.

The twin is off by an error of the covariance that its file tells. A new recording of the same motion does
not show that error either, however long the valley is in which the twin lies: what counts is not how well a
parameter is known but how well its change is, all others being what they were (generalised least squares
with the twin's error as a nuisance).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.sim.truth import Truth
from hdbridge.twin.covariance import over_legs
from hdbridge.twin.misfit import CHANNELS, Data, counted
from hdbridge.twin.parameters import Parameter
from hdbridge.twin.result import Values

Misfit = Mapping[str, Mapping[str, float]]
"""By channel, in its unit, and kind of leg: rms of what a replay leaves of the recording."""
STRAY = 4.0
"""A sample that leaves more than this times the rms of its kind counts as that: a motor that breaks away at a
different time is no change of the axis."""


def misfit_of(data: Data, residuals: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """What residuals leave of each recorded channel, by kind of leg."""
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    found: dict[str, dict[str, float]] = {}
    for name, counts in counted(data).items():
        for kind in dict.fromkeys(data.kinds):
            inside = (counts > 0.0) & (kinds == kind)
            if inside.any():
                rms = math.sqrt(float(np.mean(np.square(residuals[name][inside]))))
                found.setdefault(name, {})[kind] = float(f"{rms:.6g}")
    return found


def growth(
    data: Data, residuals: Mapping[str, FloatArray], known: Misfit, noise: Mapping[str, float]
) -> dict[str, float]:
    """By channel: rms of what is left over what was left of the same kinds of leg when the twin was made.

    A kind that the twin has not seen is held against the largest of the others; below the ``noise`` nothing
    is left.
    """
    was, found = scales_by_kind(data, known, noise), {}
    for name, counts in counted(data).items():
        inside = counts > 0.0
        if inside.any():
            scale = was[name][inside]
            now = np.minimum(np.abs(residuals[name][inside]), STRAY * scale)
            found[name] = math.sqrt(float(np.sum(now**2)) / float(np.sum(scale**2)))
    return found


def scales_by_kind(data: Data, known: Misfit, noise: Mapping[str, float]) -> dict[str, Any]:
    """By channel, for each row: the misfit of its kind of leg as it was, or the noise if that is more."""
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    found: dict[str, Any] = {}
    for name in CHANNELS:
        before = known.get(name, {})
        otherwise = max(before.values(), default=0.0)
        by_kind = {kind: max(before.get(kind, otherwise), noise[name]) for kind in dict.fromkeys(data.kinds)}
        found[name] = np.array([by_kind[str(kind)] for kind in kinds])
    return found


@dataclass(frozen=True, eq=False)
class Known:
    """What a twin's file says of its own fit."""

    names: tuple[str, ...]
    """Of the parameters that were fitted."""
    covariance: FloatArray
    """Of their coordinates."""
    noise: dict[str, float]
    """Scale of each channel's residuals."""
    misfit: Misfit
    """What the twin left of its own recordings; empty in files of older versions."""
    of_axis: bool
    """Whether the twin's values are the axis's."""

    @classmethod
    def of(cls, twin: Truth) -> Self:
        """InputError where the twin was not fitted."""
        about: Any = twin.provenance.get("fit")
        if not isinstance(about, dict):
            raise InputError(
                f"the truth '{twin.name}' does not say how sure it is (provenance.fit); expected a twin that "
                "was fitted: make one with hdbridge twin"
            )
        names = tuple(about["parameters"])
        covariance = np.array(about["covariance"], dtype=np.float64)
        of_axis = Values.of(twin) is not Values.REPLAY
        return cls(names, covariance, dict(about["noise"]), about.get("misfit", {}), of_axis)

    def root(self, parameters: Sequence[Parameter]) -> FloatArray:
        """A root of the covariance of these parameters' coordinates, shape (p, fitted).

        In no direction is it wider than the prior, whatever the residuals of a few legs say. A parameter that
        the twin has not fitted has no error there.
        """
        spread = {each.name: each.spread for each in parameters}
        prior = np.array([spread.get(name, 1.0) for name in self.names])
        # A file has some digits of it: what they leave of the smallest eigenvalues may be below zero.
        worth, directions = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        whole = prior[:, None] * directions * np.sqrt(np.clip(worth, 0.0, 1.0))
        root = np.zeros((len(parameters), len(self.names)))
        for row, each in enumerate(parameters):
            if each.name in self.names:
                root[row] = whole[self.names.index(each.name)]
        return root


@dataclass(frozen=True, eq=False)
class Change:
    """What a recording says of some coordinates, the others being the twin's."""

    by: FloatArray
    """How far they are from where the slopes were taken."""
    covariance: FloatArray


def change_of(
    places: Sequence[int],
    slopes: FloatArray,
    left: FloatArray,
    legs: FloatArray,
    root: FloatArray,
    precision: FloatArray,
    off: FloatArray,
) -> Change:
    """Generalised least squares of the coordinates at these places.

    ``left`` are the scaled residuals, ``slopes`` their derivatives by all coordinates, ``legs`` the number
    of each residual's leg, ``root`` a root of the twin's covariance. The prior has this ``precision`` about
    a point from which all coordinates are ``off`` already.
    """
    count = slopes.shape[1]
    gram, some = slopes.T @ slopes, list(places)
    noise = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    variance = max(1.0, float(noise @ noise) / max(len(left) - count, 1))
    seen = gram @ root
    inner = variance * np.eye(root.shape[1]) + root.T @ seen
    # The weights of the residuals are the slopes times this.
    weights = ((np.eye(count) - root @ np.linalg.solve(inner, seen.T)) / variance)[:, some]
    held = np.diag(precision[some])
    inverse = np.linalg.inv(weights.T @ gram[:, some] + held)
    by = -inverse @ (weights.T @ (slopes.T @ left) + precision[some] * off[some])
    louder = _louder(slopes, noise, legs, variance)
    spread = variance * gram * np.outer(louder, louder) + seen @ seen.T
    covariance = inverse @ (weights.T @ spread @ weights + held) @ inverse
    return Change(np.asarray(by, dtype=np.float64), np.asarray(covariance, dtype=np.float64))


def _louder(slopes: FloatArray, noise: FloatArray, legs: FloatArray, variance: float) -> FloatArray:
    """By coordinate, how much more residuals that go together within a leg weigh than white ones."""
    white = variance * np.sum(np.square(slopes), axis=0)
    squares = np.sum(np.square(over_legs(slopes * noise[:, None], legs)), axis=0)
    times = np.divide(squares, white, out=np.ones_like(white), where=white > 0.0)
    return np.asarray(np.sqrt(np.maximum(times, 1.0)), dtype=np.float64)
