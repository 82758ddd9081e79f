"""Trapezoidal velocity profiles of the moves and stops that the simulated drive generates."""

import math
from typing import NamedTuple


class Segment(NamedTuple):
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


class Profile:
    """Segments from a state of motion, with rest at ``end`` after them."""

    def __init__(self, position: float, velocity: float) -> None:
        self.end = position
        """Position at the end of the last segment."""
        self.velocity = velocity
        """Velocity at the end of the last segment."""
        self.duration_s = 0.0
        """Duration of all segments."""
        self._segments: list[Segment] = []

    def at(self, time_s: float) -> tuple[float, float]:
        """Returns position and velocity ``time_s`` after the start."""
        for segment in self._segments:
            if time_s < segment.duration_s:
                return segment.at(time_s)
            time_s -= segment.duration_s
        return self.end, 0.0

    def ramp_to(self, velocity: float, acceleration: float) -> None:
        """Adds a change of the velocity at ``acceleration`` (a magnitude)."""
        change = velocity - self.velocity
        if change:
            signed = math.copysign(acceleration, change)
            self._add(change / signed, signed)
            self.velocity = velocity

    def cruise(self, distance: float) -> None:
        """Adds motion at the current velocity, in its direction, over ``distance``."""
        if self.velocity and distance > 0.0:
            self._add(distance / abs(self.velocity), 0.0)

    def _add(self, duration_s: float, acceleration: float) -> None:
        segment = Segment(duration_s, self.end, self.velocity, acceleration)
        self._segments.append(segment)
        self.duration_s += duration_s
        self.end, _ = segment.at(duration_s)


def stop(position: float, velocity: float, deceleration: float) -> Profile:
    """Returns the profile that brakes from ``velocity`` to rest."""
    profile = Profile(position, velocity)
    profile.ramp_to(0.0, deceleration)
    return profile


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
    profile = Profile(position, velocity)
    overshoots = (target - stop(position, velocity, deceleration).end) * velocity < 0.0
    backwards = (target - position) * velocity < 0.0
    if overshoots or backwards:
        profile.ramp_to(0.0, deceleration)
    sign = math.copysign(1.0, target - profile.end)
    if profile.velocity * sign > max_velocity:
        profile.ramp_to(sign * max_velocity, deceleration)
    distance = sign * (target - profile.end)
    speed = abs(profile.velocity)
    reach = (distance + speed**2 / (2.0 * acceleration)) / (0.5 / acceleration + 0.5 / deceleration)
    peak = min(max_velocity, math.sqrt(max(reach, speed**2)))
    if distance > 0.0:
        profile.ramp_to(sign * peak, acceleration)
        rest = sign * (target - profile.end) - peak**2 / (2.0 * deceleration)
        profile.cruise(rest)
        profile.ramp_to(0.0, deceleration)
    profile.end = target
    return profile
