"""What was wrong with the simulation: causes by the evidence that they earn, and what cannot be told apart.

A cause earns evidence by how far its parameters had to move against how well they are known, and is held
against legs that the fit has not seen: the fitted truth, with this cause's parameters put back to where they
were.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.least_squares import Fitted
from hdbridge.twin.misfit import CHANNELS, Data, counted
from hdbridge.twin.parameters import Parameter, value_in, with_values
from hdbridge.twin.replays import Replays

FALSE_ALARM = 0.02
"""Probability with which a simulation that is right has any cause named."""
ALIKE = 0.4
"""Share of a parameter in a direction that the motion does not show, from which it belongs to the set."""


@dataclass(frozen=True, slots=True)
class Moved:
    """One parameter, before and after."""

    name: str
    unit: str
    before: float
    after: float
    lower: float
    upper: float
    """95 % interval of what it is after."""

    @property
    def sentence(self) -> str:
        """In words."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.name} {self.before:.3g} -> {self.after:.3g}{unit} ({self.lower:.3g} to {self.upper:.3g})"
        )


@dataclass(frozen=True, slots=True)
class Finding:
    """A cause that is named."""

    cause: str
    parameters: tuple[Moved, ...]
    shows_in: tuple[str, ...]
    evidence: float
    """Natural logarithm of one over the probability of so large a change where there is none."""
    gain: tuple[float, float]
    """Rms of the scaled residuals on legs that the fit has not seen: without the change, and with it."""
    aliases: tuple[str, ...] = ()
    """Other parameters that the motion cannot tell from these."""
    move: str = ""
    """The motion that would."""

    @property
    def text(self) -> str:
        """One sentence."""
        telling = [each for each in self.parameters if not each.lower <= each.before <= each.upper]
        moved = "; ".join(each.sentence for each in telling or self.parameters)
        rest = f", or {' or '.join(self.aliases)}: {self.move} would tell" if self.aliases else ""
        return f"{self.cause}: {moved}{rest}"


@dataclass(frozen=True, slots=True)
class Alike:
    """Parameters that this motion cannot tell apart, and the motion that would."""

    names: tuple[str, ...]
    moves: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Unexplained:
    """What a channel is left with beyond its noise, and the kind of leg where it is largest."""

    channel: str
    times_noise: float
    kind: str


def name_causes(replays: Replays, start: Truth, fitted: Fitted, sets: Sequence[Alike]) -> tuple[Finding, ...]:
    """The causes in which the start was wrong, the most telling first; ``sets`` as `alike` gives them."""
    groups: dict[str, list[int]] = {}
    for number, each in enumerate(fitted.parameters):
        groups.setdefault(each.cause, []).append(number)
    tried: list[tuple[str, list[int], float]] = []
    for cause, places in groups.items():
        distance = _moved(fitted, start, places)
        if chdtrc(len(places), distance) < FALSE_ALARM / len(groups) and _matters(fitted, start, places):
            tried.append((cause, places, distance))
    if not tried:
        return ()
    backs = [_put_back(fitted, start, [fitted.parameters[p] for p in places]) for _, places, _ in tried]
    here, *there = (_held_out_misfit(replays, each, fitted) for each in replays([fitted.truth, *backs]))
    found = []
    intervals = fitted.intervals()
    for (_, places, distance), worse in zip(tried, there, strict=True):
        if worse <= here:
            continue
        parameters = [fitted.parameters[place] for place in places]
        found.append(finding(parameters, start, fitted.truth, intervals, distance, (worse, here), sets))
    return tuple(sorted(found, key=lambda each: -each.gain[0]))


def finding(
    parameters: Sequence[Parameter],
    before: Truth,
    after: Truth,
    intervals: Mapping[str, tuple[float, float]],
    distance: float,
    gain: tuple[float, float],
    sets: Sequence[Alike] = (),
) -> Finding:
    """What is said of one cause's parameters; ``distance`` in squared standard deviations."""
    moved = tuple(
        Moved(each.name, each.unit, _value(before, each), _value(after, each), *intervals[each.name])
        for each in parameters
    )
    own = {each.name for each in parameters}
    touched = [each for each in sets if own & set(each.names)]
    aliases = tuple(dict.fromkeys(name for each in touched for name in each.names if name not in own))
    return Finding(
        parameters[0].cause,
        moved,
        tuple(name for name in CHANNELS if any(name in each.shows_in for each in parameters)),
        _evidence(distance, len(parameters)),
        gain,
        aliases,
        "; ".join(dict.fromkeys(move for each in touched for move in each.moves)) if aliases else "",
    )


def _evidence(distance: float, count: int) -> float:
    """Natural logarithm of one over the probability of a distance by chance."""
    chance = float(chdtrc(count, distance))
    return -math.log(chance) if chance > 0.0 else 0.5 * distance


def alike(fitted: Fitted) -> tuple[Alike, ...]:
    """The sets of parameters along which the residuals hardly change, against what the prior allows."""
    spread = np.array([each.spread for each in fitted.parameters])
    scaled = fitted.jacobian * spread
    worth, directions = np.linalg.eigh(scaled.T @ scaled)
    sets: list[Alike] = []
    for value, direction in zip(worth, directions.T, strict=True):
        if value > fitted.inflation:
            continue
        members = [each for each, part in zip(fitted.parameters, direction, strict=True) if abs(part) > ALIKE]
        if members:
            moves = tuple(dict.fromkeys(each.move for each in members))
            sets.append(Alike(tuple(each.name for each in members), moves))
    return tuple(sets)


def unexplained(
    data: Data, left: Mapping[str, FloatArray], noise: Mapping[str, float], least: float = 1.3
) -> tuple[Unexplained, ...]:
    """What residuals have beyond so many times the noise, by channel."""
    counts = counted(data)
    kinds = np.array(data.kinds)[data.leg.astype(np.intp)]
    found = []
    for name in CHANNELS:
        inside = counts[name] > 0.0
        if not inside.any():
            continue
        squares = np.square(left[name][inside])
        times = math.sqrt(float(squares.mean())) / noise[name]
        if times > least:
            by_kind = {kind: float(squares[kinds[inside] == kind].mean()) for kind in set(kinds[inside])}
            found.append(Unexplained(name, times, str(max(by_kind, key=lambda kind: by_kind[kind]))))
    return tuple(found)


def _moved(fitted: Fitted, start: Truth, places: Sequence[int]) -> float:
    """How far some parameters have moved, in squared standard deviations."""
    off = np.array([fitted.place[place] - _coordinate(start, fitted.parameters[place]) for place in places])
    block = fitted.covariance[np.ix_(places, places)]
    return float(off @ np.linalg.solve(block, off))


def _matters(fitted: Fitted, start: Truth, places: Sequence[int]) -> bool:
    """Whether one of them has moved by more than anybody would care about."""
    return any(
        abs(fitted.place[place] - _coordinate(start, fitted.parameters[place]))
        > fitted.parameters[place].least_change
        for place in places
    )


def _coordinate(truth: Truth, parameter: Parameter) -> float:
    return parameter.coordinate(min(max(_value(truth, parameter), parameter.least), parameter.most))


def _value(truth: Truth, parameter: Parameter) -> float:
    value = value_in(truth, parameter)
    assert value is not None  # it was free
    return value


def _put_back(fitted: Fitted, start: Truth, parameters: Sequence[Parameter]) -> Truth:
    return with_values(fitted.truth, {each.name: _value(start, each) for each in parameters})


def _held_out_misfit(replays: Replays, found: dict[str, FloatArray], fitted: Fitted) -> float:
    """Rms of the scaled residuals on held-out legs; outliers count as three scales."""
    data = replays.data
    out = data.out
    counts = counted(data)
    if not out.any():
        out = np.ones(len(out))
    values = [
        np.minimum(np.square(found[n] / fitted.scales[n]), 9.0)[(counts[n] * out) > 0.0] for n in CHANNELS
    ]
    return math.sqrt(float(np.mean(np.concatenate(values))))
