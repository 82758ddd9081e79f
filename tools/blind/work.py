"""Draws the motion of everyday work: moves, fast steps, pick and place, smooth paths, a daemon's day."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.motion.procedures.moves import AxisView, Dwell, MotionLimits, Move, MoveTo, Path, Sample, Steps

KINDS = ("moves", "steps", "pick and place", "stream", "daemon")
LONGEST_S = 600.0
LONGEST_DAY_S = 900.0
"""A daemon's watch diagnoses the last quarter of an hour."""
SHORTEST_BURST_S = 5.0


@dataclass(frozen=True)
class Burst:
    """Moves that are recorded without a gap; a procedure of the bench."""

    legs: tuple[Move, ...]
    pause_s: float = 0.0
    """Duration of the rest afterwards, unrecorded."""

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the legs."""
        for each in self.legs:  # noqa: UP028 - what a generator is sent is of no use to a tuple
            yield each

    @property
    def standing(self) -> Burst:
        """Returns the pause as a procedure."""
        return Burst((Dwell(self.pause_s),))


@dataclass(frozen=True)
class Smooth:
    """Sum of sines that begins and ends at rest at the position of the axis."""

    duration_s: float
    sines: tuple[tuple[float, float, float], ...]
    """Amplitude (load deg), frequency (Hz) and phase (rad) of each."""
    kind: str = "stream"

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the path, which was drawn within the limits."""
        ramp_s, turns = 0.2 * self.duration_s, [(a, math.tau * f, p) for a, f, p in self.sines]

        def at(time_s: float) -> float:
            part = min(max(min(time_s, self.duration_s - time_s) / ramp_s, 0.0), 1.0)
            weight = part**3 * (10.0 + part * (6.0 * part - 15.0))
            return start_deg + weight * math.fsum(a * math.sin(w * time_s + p) for a, w, p in turns)

        reach = sum(abs(each[0]) for each in self.sines)
        return Path(self.duration_s, at, start_deg - reach, start_deg + reach)

    def ended(self, samples: Sequence[Sample]) -> bool:
        """True at the end of the path."""
        return True


class Draft:
    """Motion under construction, within a part of the axis's travel."""

    def __init__(self, rng: random.Random, view: AxisView) -> None:
        self.rng, self.view = rng, view
        low, high = view.limits.position_min_deg, view.limits.position_max_deg
        half = 0.5 * (high - low) * self.stretched(0.05, 1.0)
        middle = rng.uniform(low + half, high - half)
        self.low_deg, self.high_deg = middle - half, middle + half
        self.place_deg = 0.0
        self.elapsed_s = 0.0
        self.legs: list[Move] = []

    def stretched(self, low: float, high: float) -> float:
        """Draws a number between two, log-uniformly."""
        return math.exp(self.rng.uniform(math.log(low), math.log(high)))

    def add(self, move: Move) -> None:
        """Adds a leg."""
        path = move.path(self.place_deg, self.view.limits)
        self.place_deg = path.at(path.duration_s)
        self.elapsed_s += path.duration_s
        self.legs.append(move)

    def go(self, goal_deg: float, speed: float = 1.0, acceleration: float = 1.0, kind: str = "move") -> None:
        """Adds a move with shares of the axis's speed and acceleration."""
        limits = self.view.limits
        self.add(
            MoveTo(goal_deg, speed * limits.velocity_deg_s, kind, acceleration * limits.acceleration_deg_s2)
        )

    def rest(self, duration_s: float) -> None:
        """Adds a rest."""
        if duration_s > 0.0:
            self.add(Dwell(duration_s))

    def burst(self, pause_s: float = 0.0) -> Burst:
        """Returns the commands drawn since the last burst."""
        legs, self.legs = tuple(self.legs), []
        return Burst(legs, pause_s)


def drawn_work(
    rng: random.Random, view: AxisView, kind: str, shortest_s: float = 10.0, longest_s: float = LONGEST_S
) -> list[Burst]:
    """Draws the bursts of a work record; the first moves to the start and is not recorded."""
    draft = Draft(rng, view)
    draft.go(rng.uniform(draft.low_deg, draft.high_deg))
    for _ in range(rng.randint(0, 3)):  # the elastic state at the start is anywhere in the loop
        draft.go(_goal(draft))
    draft.rest(rng.choice((0.0, 0.5)))
    bursts = [draft.burst()]
    if kind != "daemon":
        _draw(draft, kind, draft.stretched(shortest_s, longest_s))
        return [*bursts, draft.burst()]
    end_s = draft.elapsed_s + draft.stretched(max(shortest_s, 120.0), LONGEST_DAY_S)
    while draft.elapsed_s < end_s:
        task = rng.choice(KINDS[:-1])
        for _ in range(rng.randint(1, 3)):
            _draw(draft, task, draft.stretched(SHORTEST_BURST_S, 120.0))
            draft.rest(draft.stretched(0.5, 20.0))
        pause_s = draft.stretched(1.0, 60.0)
        draft.elapsed_s += pause_s
        bursts.append(draft.burst(pause_s))
    return bursts


def _draw(draft: Draft, kind: str, duration_s: float) -> None:
    {"moves": _moves, "steps": _steps, "pick and place": _pick, "stream": _stream}[kind](draft, duration_s)


def _goal(draft: Draft) -> float:
    """Draws a target at a distance between a motor degree and the whole travel."""
    rng, room = draft.rng, draft.high_deg - draft.low_deg
    distance = draft.stretched(1.0 / draft.view.ratio, room) * rng.choice((-1.0, 1.0))
    if not draft.low_deg <= draft.place_deg + distance <= draft.high_deg:
        distance = -distance
    return min(max(draft.place_deg + distance, draft.low_deg), draft.high_deg)


def _moves(draft: Draft, duration_s: float) -> None:
    """Adds random point-to-point moves."""
    end_s = draft.elapsed_s + duration_s
    speed, acceleration = draft.stretched(0.2, 1.0), draft.stretched(0.1, 1.0)
    dwell_s = draft.rng.choice((0.0, draft.stretched(0.1, 3.0)))
    while draft.elapsed_s < end_s:
        draft.go(_goal(draft), speed * draft.rng.uniform(0.3, 1.0), acceleration)
        draft.rest(draft.rng.uniform(0.0, dwell_s))


def _steps(draft: Draft, _: float) -> None:
    """Adds equal fast steps, one way or there and back."""
    rng = draft.rng
    both = rng.random() < 0.5
    count = rng.randint(12, 60)
    step_deg = rng.choice((43.56, draft.stretched(3.0, 180.0))) / draft.view.ratio
    each_way = math.ceil(count / 2) if both else count
    step_deg = min(step_deg, (draft.high_deg - draft.low_deg) / each_way)
    forward = draft.place_deg + each_way * step_deg <= draft.high_deg
    if not forward and draft.place_deg - each_way * step_deg < draft.low_deg:
        draft.go(draft.low_deg)
        forward = True
    step_deg = step_deg if forward else -step_deg
    dwell_s = draft.stretched(0.05, 0.6)
    for index in range(count):
        back = both and index >= each_way
        draft.go(draft.place_deg + (-step_deg if back else step_deg), kind="step")
        draft.rest(dwell_s)


def _pick(draft: Draft, duration_s: float) -> None:
    """Adds repeated moves between a few poses, some approached slowly."""
    rng, end_s = draft.rng, draft.elapsed_s + duration_s
    speed, acceleration = draft.stretched(0.3, 1.0), draft.stretched(0.2, 1.0)
    poses = [
        (rng.uniform(draft.low_deg, draft.high_deg), draft.stretched(0.1, 1.5), rng.random() < 0.3)
        for _ in range(rng.randint(2, 4))
    ]
    while draft.elapsed_s < end_s:
        for pose_deg, dwell_s, slowly in poses:
            if slowly:
                draft.go(pose_deg + 0.1 * (draft.place_deg - pose_deg), speed, acceleration)
            draft.go(pose_deg, speed * (0.1 if slowly else 1.0), acceleration)
            draft.rest(dwell_s)


def _stream(draft: Draft, duration_s: float) -> None:
    """Adds a smooth path about the middle of the available travel."""
    rng, limits = draft.rng, draft.view.limits
    middle_deg = 0.5 * (draft.low_deg + draft.high_deg)
    draft.go(middle_deg)
    sines = [
        (rng.uniform(0.2, 1.0), draft.stretched(2.0 / duration_s, 1.0), rng.uniform(-math.pi, math.pi))
        for _ in range(rng.randint(2, 5))
    ]
    share = draft.stretched(0.1, 0.8)
    path = Smooth(duration_s, tuple(sines)).path(0.0, limits)
    ways = np.array([path.at(0.01 * each) for each in range(math.ceil(duration_s / 0.01) + 1)])
    fastest = np.max(np.abs(np.diff(ways))) / 0.01
    hardest = np.max(np.abs(np.diff(ways, 2))) / 0.01**2
    scale = min(
        share * limits.velocity_deg_s / fastest,
        share * limits.acceleration_deg_s2 / hardest,
        0.5 * (draft.high_deg - draft.low_deg) / sum(each[0] for each in sines),
    )
    draft.add(Smooth(duration_s, tuple((scale * a, f, p) for a, f, p in sines)))
