"""The vocabulary of a bench: moves of the load target, each a path over time.

A procedure is a generator that yields moves and receives the samples taken during each. It knows nothing of
buses, drives or clocks, so the same generator runs on a simulated and on a real axis, and in a test without
either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from hdbridge.errors import InputError


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What the axis may do, at the load."""

    position_min_deg: float
    position_max_deg: float
    velocity_deg_s: float
    acceleration_deg_s2: float
    jerk_deg_s3: float

    def check(self, load_deg: float) -> None:
        """InputError for a load angle outside the limits."""
        if not self.position_min_deg <= load_deg <= self.position_max_deg:
            raise InputError(
                f"this would move the load to {load_deg:.6g} deg; the axis file allows "
                f"{self.position_min_deg:g} to {self.position_max_deg:g} (limits): nothing was moved; choose "
                "fewer or smaller steps, or another start"
            )


@dataclass(frozen=True, slots=True)
class AxisView:
    """All that a procedure may know of its axis."""

    ratio: float
    limits: MotionLimits


class Sample(NamedTuple):
    """One control cycle as a procedure sees it; angles in degrees, multi-turn."""

    time_s: float
    load_target_deg: float
    motor_target_deg: float
    motor_position_deg: float
    load_position_deg: float
    motor_torque_nm: float
    readings: tuple[float | None, ...] = ()
    """Of each channel of the axis file the last reading that was believed; None where none is known."""


class Path(NamedTuple):
    """Where the load target is, over the time since the move began."""

    duration_s: float
    at: Callable[[float], float]
    lowest_deg: float
    highest_deg: float


class Move(Protocol):
    """One leg of a procedure."""

    @property
    def kind(self) -> str:
        """What the leg is for, as the recording names it."""
        ...

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """The path from where the load target stands."""
        ...

    def ended(self, samples: Sequence[Sample]) -> bool:
        """Asked each cycle once the path's duration is over: True ends the leg."""
        ...


Outcome = TypeVar("Outcome", covariant=True)
Steps = Generator[Move, Sequence[Sample], Outcome]
"""What a procedure's ``moves`` returns."""


class Procedure(Protocol[Outcome]):
    """What a bench does with an axis."""

    def moves(self, axis: AxisView) -> Steps[Outcome]:
        """The generator of moves; its return value is the procedure's outcome."""
        ...


@dataclass(frozen=True, slots=True)
class MoveTo:
    """A jerk-limited move to a load angle, at the axis's limits or slower."""

    load_deg: float
    velocity_deg_s: float | None = None
    kind: str = "move"
    acceleration_deg_s2: float | None = None
    """A gentler one winds the gear's spring up less."""

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Time-optimal within the limits (ruckig)."""
        limits.check(self.load_deg)
        if self.load_deg == start_deg:
            return Path(0.0, lambda _: start_deg, start_deg, start_deg)
        # Ruckig finds nothing where limits and distance meet in a point, as 200 deg/s2, 4000 deg/s3 and
        # 1 deg plus a rounding error do; a hair slower it does.
        for share in (1.0, 1.0 - 1e-6):
            trajectory, result = self._trajectory(start_deg, limits, share)
            if result in {Result.Working, Result.Finished}:
                break
        else:
            raise InputError(
                f"no trajectory from {start_deg:g} to {self.load_deg:g} deg in the limits ({result.name}): "
                "check the target, and velocity, acceleration and jerk in the axis file"
            )
        at_time, duration, goal = trajectory.at_time, trajectory.duration, self.load_deg

        def at(time_s: float) -> float:
            return goal if time_s >= duration else float(at_time(time_s)[0][0])

        return Path(duration, at, min(start_deg, goal), max(start_deg, goal))

    def _trajectory(self, start_deg: float, limits: MotionLimits, share: float) -> tuple[Trajectory, Result]:
        demand = InputParameter(1)
        demand.current_position = [start_deg]
        demand.target_position = [self.load_deg]
        demand.max_velocity = [share * min(self.velocity_deg_s or math.inf, limits.velocity_deg_s)]
        demand.max_acceleration = [
            share * min(self.acceleration_deg_s2 or math.inf, limits.acceleration_deg_s2)
        ]
        demand.max_jerk = [limits.jerk_deg_s3]
        trajectory = Trajectory(1)
        try:
            return trajectory, Ruckig(1).calculate(demand, trajectory)
        except RuckigError:  # not finite, or a limit that is not positive
            return trajectory, Result.ErrorInvalidInput

    def ended(self, samples: Sequence[Sample]) -> bool:
        """The path's end is the leg's end."""
        return True


@dataclass(frozen=True, slots=True)
class Dwell:
    """Stand still for a while."""

    duration_s: float
    kind: str = "standstill"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """No motion."""
        return Path(self.duration_s, lambda _: start_deg, start_deg, start_deg)

    def ended(self, samples: Sequence[Sample]) -> bool:
        """The path's end is the leg's end."""
        return True


@dataclass(frozen=True, slots=True)
class Settle:
    """Stand still until the load encoder has come to rest, or the time is over.

    At rest means: over the last ``window_s`` the load encoder's two halves agree in their mean to
    ``drift_arcsec``. Means, not extremes, so that encoder noise does not keep an axis from settling.
    """

    window_s: float = 0.06
    drift_arcsec: float = 0.3
    minimum_s: float = 0.1
    timeout_s: float = 3.0
    kind: str = "settle"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """No motion."""
        return Path(max(self.minimum_s, self.window_s), lambda _: start_deg, start_deg, start_deg)

    def ended(self, samples: Sequence[Sample]) -> bool:
        """Whether the last window is at rest."""
        last = samples[-1].time_s
        if last - samples[0].time_s >= self.timeout_s:
            return True
        late = [each.load_position_deg for each in samples if each.time_s > last - 0.5 * self.window_s]
        early = [
            each.load_position_deg
            for each in samples
            if last - self.window_s < each.time_s <= last - 0.5 * self.window_s
        ]
        drift = abs(sum(late) / len(late) - sum(early) / len(early)) if early else math.inf
        return drift * 3600.0 <= self.drift_arcsec

    def window(self, samples: Sequence[Sample]) -> Sequence[Sample]:
        """The samples of the last window: what was measured at rest."""
        last = samples[-1].time_s
        return [each for each in samples if each.time_s > last - self.window_s]


@dataclass(frozen=True, slots=True)
class Sine:
    """``amplitude cos(2 pi f t)`` about a centre; begins and ends at the upper extreme, at rest.

    Begun at the extreme, where the velocity is zero, so that nothing jumps.
    """

    centre_deg: float
    amplitude_deg: float
    frequency_hz: float
    periods: float
    kind: str = "sine"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """The sine; refused where it would start with a jump or go too fast."""
        omega = 2.0 * math.pi * self.frequency_hz
        begin = self.centre_deg + self.amplitude_deg
        if abs(start_deg - begin) > 1e-9:
            raise InputError(
                f"a sine about {self.centre_deg:g} deg starts at {begin:g} deg: move there first"
            )
        if omega * self.amplitude_deg > limits.velocity_deg_s:
            raise InputError(
                f"a sine of {self.amplitude_deg:g} deg at {self.frequency_hz:g} Hz needs "
                f"{omega * self.amplitude_deg:.3g} deg/s; the axis file allows {limits.velocity_deg_s:g}"
            )
        centre, amplitude = self.centre_deg, self.amplitude_deg

        def at(time_s: float) -> float:
            return centre + amplitude * math.cos(omega * time_s)

        low, high = centre - abs(amplitude), centre + abs(amplitude)
        return Path(self.periods / self.frequency_hz, at, low, high)

    def ended(self, samples: Sequence[Sample]) -> bool:
        """The path's end is the leg's end."""
        return True
