"""Motor path divided at its reversals, from which loops, dead zones and memory are computed."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

from hdbridge.axis.effects.described import Stretch
from hdbridge.axis.effects.motion import FloatArray, IntArray, Motion, Start

LOOP_DEG: Final = 60.0
"""Motor travel after a reversal beyond which any elastic loop counts as saturated: three times the loop width
of a published gear."""

KEPT_BYTES: Final = 24_000_000
"""Memory for cached per-sample quantities of a path, bytes: three arrays of a million samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Motor angle divided at its reversals; see `branches`."""

    turning: tuple[int, ...]
    signs: tuple[int, ...]
    lengths: IntArray
    """Number of samples in each branch."""
    steps_deg: FloatArray
    """Signed motor travel of each branch."""
    away_deg: FloatArray
    """Signed motor travel since the start of the branch, for each sample after the first of ``turning``."""
    sense: FloatArray
    """Direction of motion at the same samples."""
    _kept: dict[object, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(cls, motor_deg: FloatArray, start: Start) -> Self:
        """Divides a motor angle of at least one sample at its reversals."""
        turning, signs = branches(motor_deg, start)
        angles, lengths = motor_deg[turning], np.diff(turning)
        away = motor_deg[turning[0] + 1 :] - np.repeat(angles[:-1], lengths)
        sense = np.repeat(np.array(signs, dtype=np.float64), lengths)
        return cls(tuple(turning), tuple(signs), lengths, np.diff(angles), away, sense)

    def once(self, key: object, make: Callable[[], FloatArray]) -> FloatArray:
        """Returns the quantity ``key`` from the cache, or computes it by ``make``."""
        found = self._kept.pop(key, None)
        if found is None:
            found = make()
            found.setflags(write=False)
            while self._kept and (len(self._kept) + 1) * found.nbytes > KEPT_BYTES:
                del self._kept[next(iter(self._kept))]
        self._kept[key] = found
        return found


_PATHS: dict[tuple[int, bool], tuple[weakref.ref[FloatArray], Path]] = {}
"""Cache of paths, by the identity of the angle's array and for the lifetime of that array."""


def path_of(motor_deg: FloatArray, start: Start) -> Path:
    """Returns `Path.of`, cached for read-only arrays, because a fit calls it a thousand times."""
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
    """Returns a quantity that several effects compute from the same angle; cached for read-only angles.

    ``key`` contains all other inputs of the quantity. Elastic loop and ripple occur in the model, in each
    effect that scales them, and in each derivative with respect to that scaling. A cached result is
    read-only.
    """
    if motor_deg.flags.writeable or not len(motor_deg):
        return make()
    return path_of(motor_deg, start).once(key, make)


def branches(motor_deg: FloatArray, start: Start = Start.VIRGIN) -> tuple[list[int], list[int]]:
    """Divides a motor angle into b branches, in each of which the motor moves in one direction or rests.

    Returns b + 1 indices (first index, each turning point, last index) and the b directions. A saturated
    start counts as a direction, so continued motion in that direction does not begin a new branch.
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
    """Returns the motor travel since the last reversal or the first sample, degrees, shape (n,)."""
    turning, _ = branches(motor_deg)
    result = np.zeros(len(motor_deg))
    if len(turning) > 1:
        begin = np.repeat(motor_deg[turning[:-1]], np.diff(turning))
        result[turning[0] + 1 :] = np.abs(motor_deg[turning[0] + 1 :] - begin)
    return result


def away_from_reversals(motion: Motion) -> Stretch:
    """Returns the samples so far from a reversal that an elastic loop of any shape is saturated."""
    rows = since_reversal_deg(motion.motor_deg) > LOOP_DEG
    return Stretch(rows, "seen only at reversals of the axis")


def standing_s(motion: Motion) -> FloatArray:
    """Returns the time since the axis came to rest, s, shape (n,); 0 in motion or without a speed."""
    if motion.motor_speed_deg_s is None or motion.time_s is None:
        return np.zeros(len(motion))
    moving = motion.motor_speed_deg_s != 0.0
    last = np.maximum.accumulate(np.where(moving, np.arange(len(motion)), 0))
    return np.asarray(np.where(moving, 0.0, motion.time_s - motion.time_s[last]))


def longest_rest_s(motion: Motion) -> float:
    """Returns the duration of the longest standstill, s."""
    return float(np.max(standing_s(motion), initial=0.0))
