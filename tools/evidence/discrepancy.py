"""How a real axis differs from the laws of a model: columns with a small prior, always in.

A loop has three families: stop operators (a loop with memory), forgetting functions of the travel
(as Dahl's law), smooth functions of the travel since the reversal and of the level there (any law of
first order is such a function). The law of a cause has its own values times smooth functions of what its
formula may have got wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hdbridge.effects import Effect, FloatArray, Motion, Part, Start
from hdbridge.effects.coordinate import since_change
from hdbridge.effects.path import branches, path_of, since_reversal_deg
from hdbridge.effects.play import stop
from hdbridge.effects.recurrence import recurrence

WIDTHS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Of the operators, in widths of the loop."""
KNOTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.1, 1.5)
"""Of the smooth functions of travel, in widths of the loop; nothing is left at the last."""


def of_loops(effects: Sequence[Effect], motion: Motion, start: Start) -> FloatArray:
    """Columns for each loop of the effects, (n, k)."""
    loops = [each for each in effects if each.part is Part.LOOP]
    columns = [_of_loop(each, motion, start) for each in loops]
    return np.hstack([np.empty((len(motion), 0)), *columns])


def _of_loop(loop: Effect, motion: Motion, start: Start) -> FloatArray:
    angle = motion.motor_deg
    width = loop.tracker().memory_deg
    level = loop.fitted(np.ones(1)).predict(motion, start)
    columns = [stop(angle, share * width, start) for share in WIDTHS]
    moved = np.diff(angle, prepend=angle[:1])
    for share in WIDTHS:
        decay = np.exp(-np.abs(moved) / (share * width))
        columns.append(recurrence(decay, (1.0 - decay) * np.sign(moved), float(start.value)))
    path = path_of(angle, start)
    first = path.turning[0] + 1
    way, sense, at = (np.zeros(len(angle)) for _ in range(3))
    way[first:] = np.abs(path.away_deg) / width
    sense[first:] = path.sense
    lengths = np.diff(path.turning)
    at[first:] = np.repeat(level[list(path.turning[:-1])], lengths)
    toward = at * sense
    hats = hat_columns(way, np.array(KNOTS))[:, 1:-1]
    for power in range(3):
        columns += list((hats * (sense * toward**power)[:, np.newaxis]).T)
    return np.stack(columns, axis=1)


def hat_columns(values: FloatArray, knots: FloatArray) -> FloatArray:
    """Piecewise linear functions, each one at its knot and zero at the others, (n, knots)."""
    return np.stack([np.interp(values, knots, each) for each in np.eye(len(knots))], axis=1)


def smooth_functions(motion: Motion) -> FloatArray:
    """Of time, speed, travel, and time since the path changed, about one at their largest, (n, k)."""
    functions: list[FloatArray] = []
    if motion.time_s is not None:
        functions += _legendre(motion.time_s)
    if motion.motor_speed_deg_s is not None:
        speed = motion.motor_speed_deg_s
        share = np.clip(speed / max(float(np.quantile(np.abs(speed), 0.99)), 1e-9), -1.0, 1.0)
        functions += [np.sign(share), share, np.abs(share), share**2]
        functions += _legendre(np.log(since_change(motion).values))
    functions += _legendre(np.log(0.1 + since_reversal_deg(motion.motor_deg)))
    return np.stack(functions, axis=1)


def _legendre(values: FloatArray, degree: int = 2) -> list[FloatArray]:
    low, high = float(np.min(values)), float(np.max(values))
    x = (2.0 * values - low - high) / max(high - low, 1e-12)
    return list(np.polynomial.legendre.legvander(x, degree).T[1:])


def of_timing(motion: Motion) -> FloatArray:
    """Share of the speed by which a sample may differ from it: where it starts or stops, (n,)."""
    speed = motion.motor_speed_deg_s
    if speed is None:
        return np.zeros(len(motion))
    sides = np.stack([np.roll(speed, 1), speed, np.roll(speed, -1)])
    most = np.max(np.abs(sides), axis=0)
    share = np.abs(sides[0] - 2.0 * sides[1] + sides[2]) / np.maximum(most, 1e-9)
    return np.asarray(np.minimum(share, 1.0))


def of_turns(effects: Sequence[Effect], motion: Motion, start: Start) -> FloatArray:
    """What it changes that a reversal lies between two samples, beyond the one that is furthest out, (n,).

    About half of what there may be: a parabola through the three samples turns by an eighth of their second
    difference further out at most.
    """
    angle = motion.motor_deg
    turning, _ = branches(angle, start)
    turns = np.array([each for each in turning[1:-1] if 0 < each < len(angle) - 1], dtype=np.intp)
    second = angle[turns + 1] - 2.0 * angle[turns] + angle[turns - 1]
    further = angle.copy()
    further[turns] -= second / 16.0
    there = replace(motion, motor_deg=further)
    loops = [each for each in effects if each.tracker().memory_deg > 0.0]
    apart = np.zeros(len(angle))
    for each in loops:
        told = each.predict(motion, start)
        apart += each.predict(there, start) - told
        # The sample itself may lie on either side of the turn.
        apart[turns] = np.hypot(apart[turns], 0.5 * (told[turns + 1] - told[turns]))
    return apart
