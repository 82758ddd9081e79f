"""Trapezoidal velocity profiles of the moves and stops that the simulated drive generates."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Segment:
    """Motion at constant acceleration (counts, counts/s, counts/s2, s)."""

    duration_s: float
    position: float
    velocity: float
    acceleration: float

    def at(self, time_s: float) -> tuple[float, float]:
        """Returns position and velocity ``time_s`` after the start of the segment."""
        return (
            self.position + (self.velocity + 0.5 * self.acceleration * time_s) * time_s,
            self.velocity + self.acceleration * time_s,
        )


@dataclass(frozen=True)
class Profile:
    """A sequence of segments, with rest at ``end`` after them."""

    segments: tuple[Segment, ...]
    end: float

    @property
    def duration_s(self) -> float:
        """Time until rest; s."""
        return sum(segment.duration_s for segment in self.segments)

    def at(self, time_s: float) -> tuple[float, float]:
        """Returns position and velocity ``time_s`` after the start."""
        for segment in self.segments:
            if time_s < segment.duration_s:
                return segment.at(time_s)
            time_s -= segment.duration_s
        return self.end, 0.0


class _Builder:
    def __init__(self, position: float, velocity: float) -> None:
        self.position = position
        self.velocity = velocity
        self.segments: list[Segment] = []

    def ramp_to(self, velocity: float, acceleration: float) -> None:
        """Changes the velocity at ``acceleration`` (a magnitude)."""
        change = velocity - self.velocity
        if change:
            signed = math.copysign(acceleration, change)
            self._add(Segment(change / signed, self.position, self.velocity, signed), velocity)

    def cruise(self, distance: float) -> None:
        """Continues at the current velocity, in its direction, over ``distance``."""
        if self.velocity and distance > 0.0:
            duration = distance / abs(self.velocity)
            self._add(Segment(duration, self.position, self.velocity, 0.0), self.velocity)

    def _add(self, segment: Segment, velocity: float) -> None:
        self.segments.append(segment)
        self.position, _ = segment.at(segment.duration_s)
        self.velocity = velocity


def stop(position: float, velocity: float, deceleration: float) -> Profile:
    """Returns the profile that brakes from ``velocity`` to rest."""
    builder = _Builder(position, velocity)
    builder.ramp_to(0.0, deceleration)
    return Profile(tuple(builder.segments), builder.position)


def move(
    position: float,
    velocity: float,
    target: float,
    max_velocity: float,
    acceleration: float,
    deceleration: float,
) -> Profile:
    """Returns the fastest profile within the limits from any state of motion to rest at ``target``.

    If the initial velocity is too high or in the wrong direction, or the target too near, the profile brakes
    first and then returns.
    """
    builder = _Builder(position, velocity)
    overshoots = (target - stop(position, velocity, deceleration).end) * velocity < 0.0
    backwards = (target - position) * velocity < 0.0
    if overshoots or backwards:
        builder.ramp_to(0.0, deceleration)
    sign = math.copysign(1.0, target - builder.position)
    if builder.velocity * sign > max_velocity:
        builder.ramp_to(sign * max_velocity, deceleration)
    distance = sign * (target - builder.position)
    speed = abs(builder.velocity)
    reach = (distance + speed**2 / (2.0 * acceleration)) / (0.5 / acceleration + 0.5 / deceleration)
    peak = min(max_velocity, math.sqrt(max(reach, speed**2)))
    if distance > 0.0:
        builder.ramp_to(sign * peak, acceleration)
        rest = sign * (target - builder.position) - peak**2 / (2.0 * deceleration)
        builder.cruise(rest)
        builder.ramp_to(0.0, deceleration)
    return Profile(tuple(builder.segments), target)
