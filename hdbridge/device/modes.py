"""The operating modes of the simulated drive: PP, homing, interpolated and cyclic synchronous position.

A mode turns set-points into the demand of the next period. The firmware handles power states, stopping and
supervision.
"""

import math
from typing import ClassVar, Final

from hdbridge.cia301 import wrap_int32
from hdbridge.device.dictionary import Entry, only
from hdbridge.device.motion import Motion
from hdbridge.device.powerstate import Control, Status
from hdbridge.device.profile import Profile, move

INDEX_PULSE: Final = {33: -1, 34: 1}
"""Homing methods that move to the next index pulse, and their directions."""
HOMING_METHODS: Final = (*INDEX_PULSE, 35, 37)
"""Supported homing methods; 35 is the former number of method 37."""

_NEW: Final = int(Control.NEW_SET_POINT)
_IMMEDIATELY: Final = int(Control.CHANGE_IMMEDIATELY)
_RELATIVE: Final = int(Control.RELATIVE)
_REACHED: Final = int(Status.TARGET_REACHED)
_BIT_12: Final = int(Status.MODE_12)
_BIT_13: Final = int(Status.MODE_13)


class Mode:
    """Operating mode in OPERATION ENABLED. The base class is mode 0 ('no mode') and holds the position."""

    number: ClassVar[int] = 0

    def __init__(self, motion: Motion) -> None:
        self.motion = motion

    def enter(self) -> None:
        """Starts the mode at the current demand, at rest."""

    def resume(self) -> None:
        """Continues after a halt."""

    def control(self, word: int, rising: int) -> None:
        """Evaluates a controlword; ``rising`` holds the bits that changed from 0 to 1."""

    def step(self, period_s: float) -> tuple[float, float]:
        """Returns demand (counts) and velocity (counts/s) at the end of the next period."""
        return self.motion.demand_counts, 0.0

    def observe(self, period_s: float) -> None:
        """Evaluates the encoder positions after a period."""

    def status(self) -> int:
        """Returns bits 10, 12 and 13 of the statusword."""
        return 0


class CyclicSynchronousPosition(Mode):
    """CSP: interpolates linearly to the target over one period, within the motor's maximum speed."""

    number = 8

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._aims: tuple[Entry, ...] = (motion.dictionary[0x607A, 0], motion.dictionary[0x60B0, 0])
        """Objects whose sum is the user position to be reached at the end of the next period."""

    def step(self, period_s: float) -> tuple[float, float]:
        motion = self.motion
        motion.limited = False
        goal = motion.goal(sum([each.value for each in self._aims]))
        step = goal - motion.demand_counts
        longest = motion.max_speed_counts_s * period_s
        if abs(step) > longest:
            motion.limited = True
            step = longest if step > 0.0 else -longest
            goal = motion.demand_counts + step
        return goal, step / period_s

    def status(self) -> int:
        return _BIT_12


class InterpolatedPosition(CyclicSynchronousPosition):
    """IP: interpolates linearly to 60C1h:01 over one period while bit 4 is set, else holds the position."""

    number = 7

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._aims = (motion.dictionary[0x60C1, 1],)
        self._active = False
        motion.dictionary[0x60C0, 0].guard = only(0)  # linear interpolation

    def enter(self) -> None:
        self._active = False

    def control(self, word: int, rising: int) -> None:
        self._active = bool(word & _NEW)

    def step(self, period_s: float) -> tuple[float, float]:
        return super().step(period_s) if self._active else (self.motion.demand_counts, 0.0)

    def status(self) -> int:
        return _BIT_12 if self._active else 0


class _Planned(Mode):
    """Base class of modes with moves planned by the drive."""

    _profile: Profile | None
    _elapsed_s: float

    def step(self, period_s: float) -> tuple[float, float]:
        if self._profile is None:
            return self.motion.demand_counts, 0.0
        self._elapsed_s += period_s
        demand, velocity = self._profile.at(self._elapsed_s)
        if self._elapsed_s >= self._profile.duration_s:
            self._profile = None
            self._arrive(demand)
        return demand, velocity

    def _arrive(self, demand_counts: float) -> None:
        """Handles the end of a move."""


class ProfilePosition(_Planned):
    """PP: trapezoidal moves to set-points; one set-point may be queued during a move."""

    number = 1

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self.enter()

    def enter(self) -> None:
        self._profile = None
        self._elapsed_s = 0.0
        self._goal = self.motion.demand_counts
        self._waiting: float | None = None
        self._acknowledged = False
        self._requested = False
        self._in_window_s = 0.0
        self._reached = True

    def resume(self) -> None:
        if not self._reached:
            self._start(self._goal)

    def control(self, word: int, rising: int) -> None:
        self._requested = bool(word & _NEW)
        if rising & _NEW and not self._acknowledged:
            goal = self._set_point(relative=bool(word & _RELATIVE))
            self._acknowledged = True
            if self._profile is not None and not word & _IMMEDIATELY:
                self._waiting = goal
            else:
                self._waiting = None
                self._start(goal)
        self._release()

    def _set_point(self, *, relative: bool) -> float:
        motion = self.motion
        target = motion.dictionary.value(0x607A)
        if relative:  # CiA 402: relative to the preceding set-point, not to the actual position
            before = self._goal if self._waiting is None else self._waiting
            target += wrap_int32(motion.user(before))
        motion.limited = False
        return motion.goal(target)

    def _release(self) -> None:
        """Withdraws the acknowledgement when the request has ended and a new set-point can be accepted."""
        if self._acknowledged and not self._requested and self._waiting is None:
            self._acknowledged = False

    def _start(self, goal: float) -> None:
        motion, value = self.motion, self.motion.dictionary.value
        self._goal = goal
        self._elapsed_s = 0.0
        self._in_window_s = 0.0
        self._reached = False
        self._profile = move(
            motion.demand_counts,
            motion.velocity_counts_s,
            goal,
            min(value(0x6081), value(0x607F), motion.max_speed_counts_s),
            min(value(0x6083), value(0x60C5)),
            min(value(0x6084), value(0x60C6)),
        )

    def observe(self, period_s: float) -> None:
        if self._profile is not None:
            return
        if self._waiting is not None:
            goal, self._waiting = self._waiting, None
            self._start(goal)
            self._release()
            return
        value = self.motion.dictionary.value
        if abs(self._goal - self.motion.motor_counts) > value(0x6067):
            self._in_window_s = 0.0
            self._reached = False
            return
        self._in_window_s += period_s
        self._reached = self._reached or self._in_window_s * 1000.0 >= value(0x6068)

    def status(self) -> int:
        return (_REACHED if self._reached else 0) | (_BIT_12 if self._acknowledged else 0)


class Homing(_Planned):
    """HM: methods 33 and 34 move to the next index pulse, 35 and 37 use the current position.

    The position found is assigned the value of 607Ch (home offset). There is one index pulse per motor turn.
    """

    number = 6

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self.referenced = False
        self.enter()
        motion.dictionary[0x6098, 0].guard = only(*HOMING_METHODS)

    def enter(self) -> None:
        self._attained = False
        self._failed = False
        self._profile = None
        self._elapsed_s = 0.0

    def control(self, word: int, rising: int) -> None:
        if not word & _NEW:
            self._profile = None  # clearing the start bit aborts homing
        if not rising & _NEW:
            return
        motion, value = self.motion, self.motion.dictionary.value
        moved = abs(motion.machine.velocity_counts_s) * 1e-3 * max(value(0x6068), 1)  # within the window time
        self._failed = moved > value(0x6067) or motion.velocity_counts_s != 0.0
        self._attained = False
        if self._failed:
            return
        method = value(0x6098)
        if method not in INDEX_PULSE:
            self._attain(motion.motor_counts)
            return
        turn = value(0x608F, 1)
        here = motion.demand_counts / turn
        index = math.ceil(here) - 1 if INDEX_PULSE[method] * motion.sign < 0 else math.floor(here) + 1
        self._elapsed_s = 0.0
        acceleration = value(0x609A)
        self._profile = move(
            motion.demand_counts, 0.0, float(index * turn), value(0x6099, 2), acceleration, acceleration
        )

    def _arrive(self, demand_counts: float) -> None:
        self._attain(round(demand_counts))

    def _attain(self, counts: int) -> None:
        """Assigns the value of 607Ch to a position of the motor encoder."""
        motion = self.motion
        motion.home_counts = motion.dictionary.value(0x607C) - motion.sign * counts
        motion.preload_target()
        self._attained = self.referenced = True

    def status(self) -> int:
        if self._profile is not None:
            return 0
        return _REACHED | (_BIT_12 if self._attained else 0) | (_BIT_13 if self._failed else 0)
