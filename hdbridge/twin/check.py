"""What has changed since a twin was made: a new recording against its replay, named cause by cause.

Forward selection: of all causes the one whose parameters, fitted alone, explain most is taken in if it has
moved by more than the new recording and the twin itself leave open, and by as much as matters; then the next,
with those before fitted along. At the end each has to earn its place once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.estimation.intervals import NORMAL_95
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.fitting import free_parameters
from hdbridge.twin.least_squares import Fitted, information_of, solve
from hdbridge.twin.misfit import CHANNELS, coarse, noise_floor, prepare
from hdbridge.twin.naming import FALSE_ALARM, Finding, finding
from hdbridge.twin.parameters import Parameter, coordinates
from hdbridge.twin.replays import Replays

MOST_CAUSES = 4
"""Changes that are looked for at most."""
CHECK_S = 40.0
"""A longer recording is checked on pieces that take about so long."""
CONTENDERS = 3
"""So many causes are fitted in earnest; the others are behind by the linear reckoning already."""
STEPS = 6
OWN = ("load friction", "temperature", "current limit", "velocity feed-forward")
"""Looked at in addition to what a fit changes."""


@dataclass(frozen=True, slots=True)
class Check:
    """What has changed; nothing where there are no changes."""

    changes: tuple[Finding, ...]
    misfit_before: Mapping[str, float]
    """By channel, rms of what the twin leaves, over the scale that it was made with."""
    misfit_after: Mapping[str, float]
    """The same with the changes."""

    @property
    def sentence(self) -> str:
        """One sentence for somebody at the bench."""
        if not self.changes:
            return "Nothing has changed since the twin was made."
        return f"Changed since the twin was made: {'. '.join(each.text for each in self.changes)}."


def check(
    recording: Recording,
    axis: AxisConfig,
    twin: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Check:
    """What has changed between a twin and the axis that the recording shows.

    InputError where the twin was not fitted, or the recording has no command.
    """
    known = _Known.of(twin)
    data = coarse(prepare(recording, axis, twin), CHECK_S)
    parameters = free_parameters(twin, OWN)
    floor = noise_floor(data)
    scale = {name: max(known.noise.get(name, 0.0), floor[name]) for name in CHANNELS}
    groups: dict[str, tuple[Parameter, ...]] = {}
    for each in parameters:
        groups[each.cause] = (*groups.get(each.cause, ()), each)
    with Replays(data, workers) as replays:
        search = _Search(replays, twin, known, scale, groups)
        chosen: tuple[str, ...] = ()
        best: Fitted | None = None
        while len(chosen) < MOST_CAUSES:
            step = search.next_after(chosen, best)
            progress(len(chosen) / MOST_CAUSES)
            if step is None:
                break
            chosen, best = step
        chosen, best = search.without_idle(chosen, best)
        (before,) = replays([twin])
        after = best.residuals if best is not None else before
    progress(1.0)
    gain = (_rms(before, scale), _rms(after, scale))
    changes = tuple(search.change(cause, best, gain) for cause in chosen) if best is not None else ()
    return Check(changes, _in_scales(before, scale), _in_scales(after, scale))


@dataclass(frozen=True)
class _Known:
    """What a twin's file says of its own fit."""

    names: tuple[str, ...]
    covariance: FloatArray
    noise: dict[str, float]

    @classmethod
    def of(cls, twin: Truth) -> _Known:
        about: Any = twin.provenance.get("fit")
        if not isinstance(about, dict):
            raise InputError(
                f"the truth '{twin.name}' does not say how sure it is (provenance.fit); expected a twin that "
                "was fitted: make one with hdbridge twin"
            )
        names = tuple(about["parameters"])
        return cls(names, np.array(about["covariance"], dtype=np.float64), dict(about["noise"]))

    def block(self, parameters: Sequence[Parameter]) -> FloatArray:
        """Covariance of the twin's own coordinates; nothing for what it has not fitted."""
        block = np.zeros((len(parameters), len(parameters)))
        places = [self.names.index(each.name) if each.name in self.names else None for each in parameters]
        for row, one in enumerate(places):
            for column, other in enumerate(places):
                if one is not None and other is not None:
                    block[row, column] = self.covariance[one, other]
        return block


class _Search:
    """The causes that may be taken in, and what each earns."""

    def __init__(
        self,
        replays: Replays,
        twin: Truth,
        known: _Known,
        scale: dict[str, float],
        groups: dict[str, tuple[Parameter, ...]],
    ) -> None:
        self._replays, self._twin, self._known, self._scale = replays, twin, known, scale
        self._groups = groups
        self._alone: Fitted | None = None

    def next_after(
        self, chosen: tuple[str, ...], best: Fitted | None
    ) -> tuple[tuple[str, ...], Fitted] | None:
        """The causes with one more, and their fit; None where no other has earned it."""
        left = [cause for cause in self._groups if cause not in chosen]
        ranked = self._ranked(chosen, best, left)
        fits = {cause: self._fit((*chosen, cause), best) for cause in ranked[:CONTENDERS]}
        # The best first: what is significant next to it may only stand in for it.
        for cause in sorted(fits, key=lambda cause: fits[cause].cost + 0.5 * self._price(cause)):
            if self._significant(cause, fits[cause]):
                return (*chosen, cause), fits[cause]
        return None

    def without_idle(
        self, chosen: tuple[str, ...], best: Fitted | None
    ) -> tuple[tuple[str, ...], Fitted | None]:
        """Only the causes that are still significant next to the others."""
        while best is not None:
            idle = [cause for cause in chosen if not self._significant(cause, best)]
            if not idle:
                break
            chosen = tuple(cause for cause in chosen if cause not in idle)
            best = self._fit(chosen, None) if chosen else None
        return chosen, best

    def change(self, cause: str, fitted: Fitted, gain: tuple[float, float]) -> Finding:
        """What is said of a cause."""
        places, off, covariance = self._moved(cause, fitted)
        parameters = [fitted.parameters[place] for place in places]
        reach = NORMAL_95 * np.sqrt(np.diag(covariance))
        intervals = {
            each.name: (each.value(float(at - r)), each.value(float(at + r)))
            for each, at, r in zip(parameters, fitted.place[places], reach, strict=True)
        }
        distance = float(off @ np.linalg.solve(covariance, off))
        return finding(parameters, self._twin, fitted.truth, intervals, distance, gain)

    def _fit(self, causes: Sequence[str], start: Fitted | None) -> Fitted:
        parameters = tuple(each for cause in causes for each in self._groups[cause])
        truth = start.truth if start is not None else self._twin
        prior = np.array(coordinates(self._twin, parameters))
        return solve(self._replays, truth, parameters, prior, STEPS, known=self._scale, everything=True)

    def _ranked(self, chosen: tuple[str, ...], best: Fitted | None, left: list[str]) -> list[str]:
        """The causes by what each would explain of the residuals, reckoned linearly."""
        every = tuple(each for cause in (*chosen, *left) for each in self._groups[cause])
        truth = best.truth if best is not None else self._twin
        prior = np.array(coordinates(self._twin, every))
        here = solve(self._replays, truth, every, prior, 0, known=self._scale, everything=True)
        names = [each.cause for each in every]
        gradient = here.jacobian.T @ here.vector
        information = information_of(here.jacobian, np.array([each.spread for each in every]))

        def gain(causes: Sequence[str]) -> float:
            places = [number for number, name in enumerate(names) if name in causes]
            if not places:
                return 0.0
            part = gradient[places]
            return 0.5 * float(part @ np.linalg.solve(information[np.ix_(places, places)], part))

        base = gain(chosen)
        earned = {cause: gain((*chosen, cause)) - base - 0.5 * self._price(cause) for cause in left}
        return sorted((cause for cause in left if earned[cause] > 0.0), key=lambda cause: -earned[cause])

    def _price(self, cause: str) -> float:
        """What a cause costs by its number of parameters (Schwarz)."""
        rows = sum(len(each.leg) for each in self._replays.data.pieces)
        return len(self._groups[cause]) * math.log(max(rows, 2))

    def _significant(self, cause: str, fitted: Fitted) -> bool:
        """Whether a cause has moved beyond what is open, and by as much as matters."""
        places, off, covariance = self._moved(cause, fitted)
        distance = float(off @ np.linalg.solve(covariance, off))
        certain = float(chi2.sf(distance, len(places))) < FALSE_ALARM / len(self._groups)
        spread = np.sqrt(np.diag(covariance))
        least = np.array([fitted.parameters[place].least_change for place in places])
        return certain and bool(np.any((np.abs(off) > least) & (np.abs(off) > 2.0 * spread)))

    def _moved(self, cause: str, fitted: Fitted) -> tuple[list[int], FloatArray, FloatArray]:
        """A cause's parameters: where in the fit, how far from the twin, and how sure that is."""
        places = [number for number, each in enumerate(fitted.parameters) if each.cause == cause]
        parameters = [fitted.parameters[place] for place in places]
        off = fitted.place[places] - np.array(coordinates(self._twin, parameters))
        covariance = fitted.covariance[np.ix_(places, places)] + self._known.block(parameters)
        return places, off, covariance


def _in_scales(found: Mapping[str, FloatArray], scale: Mapping[str, float]) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(np.square(found[name])))) / scale[name] for name in CHANNELS}


def _rms(found: Mapping[str, FloatArray], scale: Mapping[str, float]) -> float:
    return math.sqrt(sum(each**2 for each in _in_scales(found, scale).values()) / len(CHANNELS))
