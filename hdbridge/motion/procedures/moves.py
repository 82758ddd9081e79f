"""Moves of the load target, of which all procedures consist; each is a path over time.

A procedure is a generator that yields moves, and receives the samples taken during each move. It does not
depend on buses, drives or clocks, so the same generator runs on a simulated axis, on a real axis, and in a
test without either.
"""

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from hdbridge.errors import InputError
from hdbridge.motion.procedures.parameters import Checked, Positive


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Motion limits of the axis, at the load."""

    position_min_deg: float
    position_max_deg: float
    velocity_deg_s: float
    acceleration_deg_s2: float
    jerk_deg_s3: float

    @property
    def middle_deg(self) -> float:
        """Middle of the travel."""
        return 0.5 * (self.position_min_deg + self.position_max_deg)

    def check(self, load_deg: float) -> None:
        """Raises `InputError` for a load angle outside the limits."""
        if not self.position_min_deg <= load_deg <= self.position_max_deg:
            raise InputError(
                f"this would move the load to {load_deg:.6g} deg; the axis file allows "
                f"{self.position_min_deg:g} to {self.position_max_deg:g} (limits): nothing was moved; choose "
                "fewer or smaller steps, or another start"
            )


@dataclass(frozen=True, slots=True)
class AxisView:
    """Properties of the axis that are available to a procedure."""

    ratio: float
    limits: MotionLimits
    motor_count_deg: float = 0.0
    """One count of the motor encoder."""


class Sample(NamedTuple):
    """Data of one control cycle that a procedure receives; angles in degrees, multi-turn."""

    time_s: float
    load_target_deg: float
    motor_target_deg: float
    motor_position_deg: float
    load_position_deg: float
    motor_torque_nm: float
    readings: tuple[float | None, ...] = ()
    """Last good reading of each channel of the axis file; None for a channel without a good reading."""


class Path(NamedTuple):
    """Load target as a function of the time since the start of the move."""

    duration_s: float
    at: Callable[[float], float]
    lowest_deg: float
    highest_deg: float


class Move(Protocol):
    """One leg of a procedure."""

    @property
    def kind(self) -> str:
        """Purpose of the leg, as named in the recording."""
        ...

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the path from the current load target."""
        ...

    def ended(self, samples: Sequence[Sample], axis: AxisView) -> bool:
        """Returns True if the leg has ended; called in each cycle after the path's duration."""
        ...


Outcome = TypeVar("Outcome", covariant=True)
Steps = Generator[Move, Sequence[Sample], Outcome]
"""Return type of a procedure's ``moves``."""


class Procedure(Protocol[Outcome]):
    """A measurement that a bench runs on an axis."""

    def moves(self, axis: AxisView) -> Steps[Outcome]:
        """Returns the generator of moves; its return value is the procedure's outcome."""
        ...


def solutions(
    planner: Ruckig, demand: InputParameter, velocity: Sequence[float], acceleration: Sequence[float]
) -> Iterator[Trajectory]:
    """Yields the trajectories within these limits of each axis, and within slightly lower ones.

    Ruckig fails if limits and distance coincide exactly, as with 200 deg/s2, 4000 deg/s3 and 1 deg plus a
    rounding error. With slightly lower limits it succeeds.
    """
    for share in (1.0, 1.0 - 1e-6):
        demand.max_velocity = [share * each for each in velocity]
        demand.max_acceleration = [share * each for each in acceleration]
        trajectory = Trajectory(len(velocity))
        try:
            result = planner.calculate(demand, trajectory)
        except RuckigError:  # a value that is not finite, or a limit that is not positive
            continue
        if result in {Result.Working, Result.Finished}:
            yield trajectory


class _Timed(Checked):
    """Base class of legs that end with their path."""

    __slots__ = ()

    def ended(self, samples: Sequence[Sample], axis: AxisView) -> bool:
        return True


@dataclass(frozen=True, slots=True)
class MoveTo(_Timed):
    """Jerk-limited move to a load angle, at the axis's limits or at lower ones."""

    load_deg: float
    velocity_deg_s: Positive | None = None
    kind: str = "move"
    acceleration_deg_s2: Positive | None = None
    """Maximum acceleration, if less than the axis's limit; a lower one reduces wind-up of the gear."""

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the time-optimal path within the limits (ruckig)."""
        limits.check(self.load_deg)
        if self.load_deg == start_deg:
            return Path(0.0, lambda _: start_deg, start_deg, start_deg)
        demand = InputParameter(1)
        demand.current_position = [start_deg]
        demand.target_position = [self.load_deg]
        demand.max_jerk = [limits.jerk_deg_s3]
        velocity = min(self.velocity_deg_s or math.inf, limits.velocity_deg_s)
        acceleration = min(self.acceleration_deg_s2 or math.inf, limits.acceleration_deg_s2)
        trajectory = next(solutions(Ruckig(1), demand, [velocity], [acceleration]), None)
        if trajectory is None:
            raise InputError(
                f"no trajectory from {start_deg:g} to {self.load_deg:g} deg within the limits: check the "
                "target, and velocity, acceleration and jerk in the axis file"
            )
        at_time, duration, goal = trajectory.at_time, trajectory.duration, self.load_deg

        def at(time_s: float) -> float:
            return goal if time_s >= duration else float(at_time(time_s)[0][0])

        return Path(duration, at, min(start_deg, goal), max(start_deg, goal))


@dataclass(frozen=True, slots=True)
class Dwell(_Timed):
    """Standstill for a given time."""

    duration_s: float
    kind: str = "standstill"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        return Path(self.duration_s, lambda _: start_deg, start_deg, start_deg)


@dataclass(frozen=True, slots=True)
class Settle(Checked):
    """Standstill until motor and load have settled, or until the time-out.

    The axis has settled if, over the last ``window_s``, the mean load angles of the two halves agree within
    ``drift_arcsec``, and the mean motor angle is within ``drift_arcsec`` or half a count of its target.
    Friction can hold a motor off its target until the servo's integrator overcomes it. Means are used instead
    of extremes, so that encoder noise does not prevent settling.
    """

    window_s: Positive = 0.06
    drift_arcsec: Positive = 0.3
    minimum_s: float = 0.1
    timeout_s: Positive = 3.0
    kind: str = "settle"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        return Path(max(self.minimum_s, self.window_s), lambda _: start_deg, start_deg, start_deg)

    def ended(self, samples: Sequence[Sample], axis: AxisView) -> bool:
        """Returns True if the axis has settled within the last window, or on time-out."""
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
        if drift * 3600.0 > self.drift_arcsec:
            return False
        window = self.window(samples)
        off_deg = abs(sum(each.motor_position_deg - each.motor_target_deg for each in window)) / len(window)
        near_deg = max(self.drift_arcsec / 3600.0 * axis.ratio, 0.5 * axis.motor_count_deg)
        return off_deg <= near_deg + 1e-9

    def window(self, samples: Sequence[Sample]) -> Sequence[Sample]:
        """Returns the samples of the last window, in which the axis is at rest."""
        last = samples[-1].time_s
        return [each for each in samples if each.time_s > last - self.window_s]


@dataclass(frozen=True, slots=True)
class Sine(_Timed):
    """``amplitude cos(2 pi f t)`` about a centre; starts at the upper extreme, where the velocity is zero.

    With a whole number of periods, it also ends there.
    """

    centre_deg: float
    amplitude_deg: float
    frequency_hz: Positive
    periods: Positive
    kind: str = "sine"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the path; raises `InputError` if it would start with a jump or exceed the speed limit."""
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
