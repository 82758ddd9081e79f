"""Exact time step of a damped mass on a spring whose base moves linearly."""

import math
from typing import NamedTuple, Protocol

from hdbridge.sim.state import state


class Step(NamedTuple):
    """State transition of the distance from the base and its rate over one step."""

    distance_by_distance: float
    distance_by_rate: float
    rate_by_distance: float
    rate_by_rate: float


class Oscillator(Protocol):
    """Damped mass on a spring, as described in a truth file."""

    @property
    def frequency_hz(self) -> float: ...
    @property
    def damping_ratio(self) -> float: ...


@state
class Transition:
    """`Step` as a class of the simulation's state."""

    def __init__(self, step: Step) -> None:
        self.distance_by_distance, self.distance_by_rate, self.rate_by_distance, self.rate_by_rate = step


def transition(truth: Oscillator | None, step_s: float) -> Transition:
    """Returns the exact step of an oscillator; for None, the step of a mass fixed to its base."""
    if truth is None:
        return Transition(Step(0.0, 0.0, 0.0, 0.0))
    return Transition(exact_step(math.tau * truth.frequency_hz, truth.damping_ratio, step_s))


def exact_step(frequency_rad_s: float, damping_ratio: float, step_s: float) -> Step:
    """Returns the matrix exponential of ``u'' = -w^2 u - 2 d w u'`` over a step, for any damping ratio."""
    w, decay = frequency_rad_s, damping_ratio * frequency_rad_s
    fade = math.exp(-decay * step_s)
    inside = 1.0 - damping_ratio**2
    if abs(inside) < 1e-9:  # critically damped, within rounding
        c, s = 1.0, step_s
    elif inside > 0.0:
        damped = w * math.sqrt(inside)
        c, s = math.cos(damped * step_s), math.sin(damped * step_s) / damped
    else:
        damped = w * math.sqrt(-inside)
        # Separate exponentials, because cosh and sinh overflow if the damping is very large.
        slow, fast = math.exp(-w * w / (decay + damped) * step_s), math.exp(-(decay + damped) * step_s)
        fade, c, s = 1.0, 0.5 * (slow + fast), 0.5 * (slow - fast) / damped
    return Step(fade * (c + decay * s), fade * s, -fade * w * w * s, fade * (c - decay * s))
