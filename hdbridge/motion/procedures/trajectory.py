"""User-defined trajectory of the load: a function of time, or evenly spaced set-points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from hdbridge.axis.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import AxisView, MotionLimits, MoveTo, Path, Sample, Settle, Steps
from hdbridge.units import ARCSEC_PER_DEG

GRID_S = 0.001
"""Period at which a function is sampled; the cycle of a drive is rarely shorter."""
MOST_POINTS = 1_000_000
UNITS = {"velocity_deg_s": "deg/s", "acceleration_deg_s2": "deg/s2", "jerk_deg_s3": "deg/s3"}
"""Limits of a trajectory with their units, by order of the derivative."""
ROUNDING = 1e-6
"""Relative amount by which finite differences may exceed a limit."""


@dataclass(frozen=True, slots=True)
class Followed:
    """Tracking error of the load (load encoder minus load target): rms and maximum."""

    rms_arcsec: float
    largest_arcsec: float


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Load angles at equal time intervals, followed as one smooth path.

    The axis makes a jerk-limited move to the first angle, and comes to rest at the last one. Speed,
    acceleration and jerk must be within the axis's limits, including the transitions from and to rest.
    Otherwise `rehearse` rejects the trajectory (`InputError`) before any motion. Between two set-points the
    path is a cubic whose slopes are derived from the neighbouring set-points.
    """

    load_deg: FloatArray
    """Load angles, shape (n,) with n of at least 2."""
    period_s: float
    """Time between two successive angles."""

    def __post_init__(self) -> None:
        """Raises `InputError` for too few points, a non-finite value, or a period that is not positive."""
        points = np.array(self.load_deg, dtype=np.float64)
        points.flags.writeable = False
        object.__setattr__(self, "load_deg", points)
        if points.ndim != 1 or len(points) < 2:
            raise InputError(
                f"the trajectory has shape {points.shape}; expected at least two load angles, shape (n,)"
            )
        if not (math.isfinite(self.period_s) and self.period_s > 0.0):
            raise InputError(
                f"the time between two angles of the trajectory is {self.period_s!r} s; expected more than 0"
            )
        bad = np.flatnonzero(~np.isfinite(points))
        if len(bad):
            raise InputError(
                f"the trajectory has {points[bad[0]]} at {bad[0] * self.period_s:g} s; expected finite angles"
            )

    @classmethod
    def of(cls, load_deg: Callable[[float], float], duration_s: float) -> Self:
        """Samples ``load_deg``, which returns the load angle, degrees, at a time after the start, s."""
        if not (math.isfinite(duration_s) and duration_s > 0.0):
            raise InputError(f"the duration of the trajectory is {duration_s!r} s; expected more than 0")
        count = min(math.ceil(duration_s / GRID_S), MOST_POINTS)
        period_s = duration_s / count
        return cls(np.array([load_deg(number * period_s) for number in range(count + 1)]), period_s)

    def moves(self, axis: AxisView) -> Steps[Followed]:
        """Yields the move to the start, the path, and the settling."""
        follow = Follow(self.load_deg, self.period_s)
        yield MoveTo(float(self.load_deg[0]))
        samples = yield follow
        yield Settle()
        error = [(each.load_position_deg - each.load_target_deg) * ARCSEC_PER_DEG for each in samples]
        return Followed(float(np.sqrt(np.mean(np.square(error)))), float(np.max(np.abs(error))))


class Follow:
    """Leg that follows set-points; all slow computations are done on construction."""

    kind = "trajectory"

    def __init__(self, load_deg: FloatArray, period_s: float) -> None:
        self._points, self._period_s = load_deg, period_s
        self._lowest, self._highest = float(load_deg.min()), float(load_deg.max())
        # Rest is added before and after, so that a path that starts or ends in motion has an acceleration
        # there.
        padded = np.concatenate([np.full(3, load_deg[0]), load_deg, np.full(3, load_deg[-1])])
        # Each difference is a mean of the derivative, so it never exceeds the derivative's maximum.
        self._needs: dict[str, tuple[float, float]] = {}
        rounding_deg = np.spacing(max(abs(self._lowest), abs(self._highest), 1.0))
        for number, name in enumerate(UNITS, 1):
            size = np.abs(np.diff(padded, number))
            place = int(np.argmax(size))
            needed = (float(size[place]) - 2.0**number * rounding_deg) / period_s**number
            self._needs[name] = (needed, max(place - 3 + number // 2, 0) * period_s)
        slope = np.concatenate([[0.0], 0.5 * (load_deg[2:] - load_deg[:-2]), [0.0]])
        step = np.diff(load_deg)
        here, there = slope[:-1], slope[1:]
        self._cubics: list[tuple[float, float, float, float]] = list(
            zip(
                load_deg[:-1].tolist(),
                here.tolist(),
                (3.0 * step - 2.0 * here - there).tolist(),
                (here + there - 2.0 * step).tolist(),
                strict=True,
            )
        )

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the path; raises `InputError` if it does not start at the axis or violates a limit."""
        if abs(start_deg - self._points[0]) > 1e-9:
            raise InputError(
                f"a trajectory begins at {self._points[0]:g} deg, but the axis stands at {start_deg:g}: move "
                "there first"
            )
        for name, (needed, time_s) in self._needs.items():
            allowed = getattr(limits, name)
            if needed > allowed * (1.0 + ROUNDING):
                raise InputError(
                    f"the trajectory needs {needed:.4g} {UNITS[name]} at {time_s:.4g} s; the axis file "
                    f"allows {allowed:g} (limits.{name}): nothing was moved; make it slower or smoother, and "
                    "let it begin and end at rest"
                )
        cubics, period_s, last = self._cubics, self._period_s, float(self._points[-1])
        count = len(cubics)

        def at(time_s: float) -> float:
            number = int(time_s / period_s)
            if number >= count:
                return last
            share = time_s / period_s - number
            a, b, c, d = cubics[number]
            return a + share * (b + share * (c + share * d))

        return Path(count * period_s, at, self._lowest, self._highest)

    def ended(self, samples: Sequence[Sample], axis: AxisView) -> bool:
        """Returns True, because the leg ends with its path."""
        return True
