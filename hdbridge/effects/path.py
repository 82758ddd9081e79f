"""A path of the motor cut where it reverses: what loops, dead zones and memory are made of."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from hdbridge.effects.described import Stretch
from hdbridge.effects.motion import FloatArray, IntArray, Motion, Start

LOOP_DEG: Final = 60.0
"""Motor angle after a reversal within which an elastic loop is felt: three times the width of a published
gear's loop."""

KEPT_BYTES: Final = 24_000_000
"""Memory for quantities of every sample that are kept beside a path: three of a million samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A motor angle cut at its reversals; see `branches`."""

    turning: tuple[int, ...]
    signs: tuple[int, ...]
    lengths: IntArray
    """Samples of each branch."""
    steps_deg: FloatArray
    """Signed angle of each branch."""
    away_deg: FloatArray
    """Of the samples after the first of ``turning``: signed angle from the turn that began their branch."""
    sense: FloatArray
    """Their direction."""
    _kept: dict[object, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(cls, motor_deg: FloatArray, start: Start) -> Path:
        """Take an angle of at least one sample apart."""
        turning, signs = branches(motor_deg, start)
        angles, lengths = motor_deg[turning], np.diff(turning)
        away = motor_deg[turning[0] + 1 :] - np.repeat(angles[:-1], lengths)
        sense = np.repeat(np.array(signs, dtype=np.float64), lengths)
        return cls(tuple(turning), tuple(signs), lengths, np.diff(angles), away, sense)

    def once(self, key: object, make: Callable[[], FloatArray]) -> FloatArray:
        """The quantity ``key``, made only where it is not kept."""
        found = self._kept.pop(key, None)
        if found is None:
            found = make()
            found.setflags(write=False)
            while self._kept and (len(self._kept) + 1) * found.nbytes > KEPT_BYTES:
                del self._kept[next(iter(self._kept))]
        self._kept[key] = found
        return found


_PATHS: dict[tuple[int, bool], tuple[weakref.ref[FloatArray], Path]] = {}
"""By the identity of the angle's array, as long as that is there."""


def path_of(motor_deg: FloatArray, start: Start) -> Path:
    """`Path.of`; kept for an array that cannot be written to, of which a fit asks it a thousand times."""
    if motor_deg.flags.writeable:
        return Path.of(motor_deg, start)
    key = (id(motor_deg), start is Start.VIRGIN)
    kept = _PATHS.get(key)
    if kept is not None and kept[0]() is motor_deg:
        return kept[1]
    path = Path.of(motor_deg, start)
    _PATHS[key] = (weakref.ref(motor_deg, lambda _: _PATHS.pop(key, None)), path)
    return path


def once(motor_deg: FloatArray, start: Start, key: object, make: Callable[[], FloatArray]) -> FloatArray:
    """What several effects work out from the same angle, by what it depends on besides; not to be written to.

    The elastic loop and the ripple are those of the model, of each effect that scales them, and of each
    derivative by what these add to them. Kept for an array that cannot be written to.
    """
    if motor_deg.flags.writeable or not len(motor_deg):
        return make()
    return path_of(motor_deg, start).once(key, make)


def branches(motor_deg: FloatArray, start: Start = Start.VIRGIN) -> tuple[list[int], list[int]]:
    """Indices between which the motor moves in one direction (rest included), and that direction.

    Returns ``turning`` of length b + 1 (first index, each turning point, last index) and ``signs`` of length
    b. A saturated start counts as a direction: going on in it begins no new branch worth telling apart.
    """
    steps = np.diff(motor_deg)
    moving = np.flatnonzero(steps)
    if not len(moving):
        return [len(motor_deg) - 1], []
    forward = steps[moving] > 0.0
    change = np.flatnonzero(forward[1:] != forward[:-1]) + 1
    turning = [
        0 if start is Start.VIRGIN else int(moving[0]),
        *moving[change].tolist(),
        len(motor_deg) - 1,
    ]
    return turning, [1 if each else -1 for each in (forward[0], *forward[change].tolist())]


def since_reversal_deg(motor_deg: FloatArray) -> FloatArray:
    """Motor angle since the axis last reversed (or began), degrees, shape (n,)."""
    turning, _ = branches(motor_deg)
    result = np.zeros(len(motor_deg))
    if len(turning) > 1:
        begin = np.repeat(motor_deg[turning[:-1]], np.diff(turning))
        result[turning[0] + 1 :] = np.abs(motor_deg[turning[0] + 1 :] - begin)
    return result


def away_from_reversals(motion: Motion) -> Stretch:
    """Where no elastic loop is felt, whatever its shape."""
    rows = since_reversal_deg(motion.motor_deg) > LOOP_DEG
    return Stretch(rows, "seen only where the axis reverses")


def standing_s(motion: Motion) -> FloatArray:
    """Time since the axis came to rest, seconds, shape (n,); 0 in motion, and at unknown speed."""
    if motion.motor_speed_deg_s is None or motion.time_s is None:
        return np.zeros(len(motion))
    moving = motion.motor_speed_deg_s != 0.0
    last = np.maximum.accumulate(np.where(moving, np.arange(len(motion)), 0))
    return np.asarray(np.where(moving, 0.0, motion.time_s - motion.time_s[last]))
