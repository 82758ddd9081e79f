"""Set-point of one axis, period by period, for commands at any time.

Every motion continues from the present position, velocity and acceleration, so a new target does not require
rest. An impossible command is refused (`InputError`) before anything has changed, and the motion under way
continues.

The set-point always stays within the position limits. A plan is accepted only if its extremes are within
them, and braking has a fallback that always exists (`SetPoint._brake`). Rounding errors are clipped.
"""

import math

from hdbridge.errors import InputError
from hdbridge.motion.generator import Bounds, Generator, Kinematics, Plan
from hdbridge.motion.modes import MotionMode
from hdbridge.motion.procedures.moves import MotionLimits
from hdbridge.motion.pursuit import Pursuit
from hdbridge.motion.stream import Cubic, Stream

MOST_TIMEOUT_S = 60.0
"""Maximum time-out of a dead man's control; s."""


class SetPoint:
    """Load target, once per control period.

    Pure: time is counted in calls of `step`. An axis that stands outside its position limits may hold there
    and move inwards.
    """

    def __init__(self, limits: MotionLimits, period_s: float) -> None:
        """``period_s`` is the time between two calls of `step`. The set-point is at zero until `reset`.

        Raises `InputError` for limits that are not finite or leave no range.
        """
        numbers = (limits.velocity_deg_s, limits.acceleration_deg_s2, limits.jerk_deg_s3, period_s)
        if not all(math.isfinite(each) and each > 0.0 for each in numbers):
            raise InputError(
                f"velocity, acceleration, jerk limit and period are {numbers}; expected finite numbers "
                "above 0"
            )
        ends = (limits.position_min_deg, limits.position_max_deg)
        if not (all(map(math.isfinite, ends)) and ends[0] <= ends[1]):
            raise InputError(f"position limits of {ends[0]!r} to {ends[1]!r} deg; expected a finite range")
        self._limits = limits
        self._period_s = period_s
        self._generator = Generator(limits)
        self._stream: Stream | None = None
        self._pursuit: Pursuit | None = None
        self._aim = (0.0, 0.0)
        self._path: Plan | Cubic | None = None
        """Path in progress; None at rest and in a stream."""
        self._steps = 0
        """Periods since ``_path`` was set; the path had then run for ``_since_s``."""
        self._since_s = 0.0
        self._left = self._stream_timeout = 0
        """Remaining periods of a jog, or of a stream at rest."""
        self._mode = MotionMode.HOLD
        self._underrun = False
        self._position_deg = self._velocity_deg_s = self._acceleration_deg_s2 = 0.0
        self._bounds = Bounds(*ends)

    @property
    def position_deg(self) -> float:
        """Load target of the last `step`."""
        return self._position_deg

    @property
    def velocity_deg_s(self) -> float:
        return self._velocity_deg_s

    @property
    def acceleration_deg_s2(self) -> float:
        return self._acceleration_deg_s2

    @property
    def mode(self) -> MotionMode:
        return self._mode

    @property
    def at_rest(self) -> bool:
        """True if the set-point stands still and would remain so without further input."""
        if self._stream is not None:
            return self._stream.waiting
        if self._pursuit is not None:
            return self._pursuit.at_rest
        return self._path is None

    @property
    def underrun(self) -> bool:
        """True if the last stream ran out of knots in motion and had to be braked."""
        return self._underrun

    @property
    def room(self) -> int:
        """Number of knots that would now be accepted; 0 outside a stream."""
        return 0 if self._stream is None else self._stream.room

    def reset(self, load_deg: float) -> None:
        """Sets a position at rest, discarding all motion, for an axis that is not being driven.

        Raises `InputError` for a non-finite angle.
        """
        _check_finite("load angle", load_deg)
        self._rest_at(load_deg)
        self._underrun = False

    def goto(
        self,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
    ) -> None:
        """Moves to a load angle and rests there; from rest or from any motion.

        Velocity and acceleration limit this move; the axis's limits apply in any case. Raises `InputError`
        for a target outside the position limits or an invalid number, and in motion if the path would leave
        the position limits (stop first).
        """
        limits = self._limits
        _check_finite("target", target_deg)
        speed = _positive("velocity", velocity_deg_s)
        acceleration = _positive("acceleration", acceleration_deg_s2)
        if not limits.position_min_deg <= target_deg <= limits.position_max_deg:
            raise InputError(
                f"a target of {target_deg:.9g} deg; the position limits are {limits.position_min_deg:g} and "
                f"{limits.position_max_deg:g} deg"
            )
        self._take(self._planned(target_deg, speed, acceleration), MotionMode.GOTO)

    def jog(self, velocity_deg_s: float, timeout_s: float) -> None:
        """Moves at a velocity (up to the axis's limit) until the time-out; zero brakes.

        Must be called again before the time-out. The axis brakes before a position limit and waits there.
        Raises `InputError` for invalid numbers, and for a time-out that is not above 0 and up to
        `MOST_TIMEOUT_S`.
        """
        _check_finite("velocity", velocity_deg_s)
        timeout = self._timeout(timeout_s)
        limits = self._limits
        speed = min(abs(velocity_deg_s), limits.velocity_deg_s)
        if not speed:
            self.stop()
            return
        # Planned as a move, so that the plan respects the position limit: to the limit, or farther than it
        # can come before the time-out.
        easing_s = speed / limits.acceleration_deg_s2 + limits.acceleration_deg_s2 / limits.jerk_deg_s3
        reach = self._coasting_deg() + speed * (timeout_s + 2.0 * (easing_s + self._period_s))
        bounds = self._bounds_here()
        if velocity_deg_s > 0.0:
            target_deg = min(self._position_deg + reach, bounds.upper_deg)
        else:
            target_deg = max(self._position_deg - reach, bounds.lower_deg)
        self._take(self._planned(target_deg, speed, math.inf), MotionMode.JOG)
        self._left = timeout

    def stop(self) -> None:
        """Brakes to rest within the limits. Never refused; at rest, ends a stream or a jog."""
        if self.at_rest:
            self._rest_at(self._position_deg)
        elif self._mode is not MotionMode.STOP:
            self._brake(0.0)

    def stream(self, timeout_s: float) -> None:
        """Follows knots from here (`knot`); their time starts with the first `step` after `begin_stream`.

        A rest without knots for the time-out ends the stream with a hold. Raises `InputError` in motion, and
        for a time-out that is not above 0 and up to `MOST_TIMEOUT_S`.
        """
        timeout = self._timeout(timeout_s)
        if not self.at_rest:
            raise InputError("a stream begins at rest: stop the axis first")
        self._rest_at(self._position_deg)
        self._stream = Stream(self._position_deg, self._limits, self._bounds_here(), self._period_s)
        self._stream_timeout = timeout
        self._left = timeout
        self._underrun = False
        self._mode = MotionMode.STREAM

    def follow(self) -> None:
        """Pursues the positions passed to `aim` until another motion. Raises `InputError` in motion."""
        if not self.at_rest:
            raise InputError("an axis begins to follow another master at rest: stop the axis first")
        self._rest_at(self._position_deg)
        self._pursuit = Pursuit(self._position_deg, self._limits, self._bounds, self._period_s)
        self._aim = (self._position_deg, 0.0)
        self._mode = MotionMode.FOLLOW

    def aim(self, position_deg: float, spacing_s: float = 0.0) -> None:
        """Pursues a position with the next `step`, within the limits. Raises `InputError` if it is not
        finite.

        ``spacing_s`` is the time between the set-points from which it was interpolated.
        """
        _check_finite("load angle", position_deg)
        self._aim = (position_deg, spacing_s)

    def begin_stream(self) -> None:
        """Starts the stream's time with the next `step`; raises `InputError` without a `stream`."""
        self._streaming().begin()

    def knot(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        """Adds a knot to the stream: time from its start, and load angle and velocity at that time.

        Between two knots the set-point follows the cubic with their velocities. Raises `InputError`, leaving
        the stream unchanged, if the knot is not later than the last one; if position, speed or (by more than
        5 %) acceleration would exceed the limits, anywhere on the way to it or when braking from it; if the
        first knot is not at rest at the position of the axis; and if the buffer is full (`room`).
        """
        self._streaming().add(time_s, position_deg, velocity_deg_s)

    def step(self) -> float:
        """Advances one period; returns the load target in degrees."""
        if self._stream is not None:
            return self._step_stream(self._stream)
        if self._pursuit is not None:
            state = self._pursuit.step(*self._aim)  # within the limits
            self._position_deg, self._velocity_deg_s, self._acceleration_deg_s2 = state
            return self._position_deg
        if self._mode is MotionMode.JOG:
            self._left -= 1
            if self._left < 0:
                self.stop()
        return self._follow()

    def _follow(self) -> float:
        path = self._path
        if path is None:
            return self._position_deg
        self._steps += 1
        time_s = self._since_s + self._steps * self._period_s
        self._set(path.state(time_s))
        if time_s >= path.duration_s:
            self._path = None
            self._velocity_deg_s = self._acceleration_deg_s2 = 0.0
            if self._mode is not MotionMode.JOG:
                self._mode = MotionMode.HOLD
        return self._position_deg

    def _step_stream(self, stream: Stream) -> float:
        self._set(stream.step())
        if stream.overrun_s is not None:
            self._brake(stream.overrun_s - self._period_s)
            self._underrun = True
            return self._follow()
        if not stream.waiting:
            self._left = self._stream_timeout
        elif self._left:
            self._left -= 1
        else:
            self._rest_at(self._position_deg)
        return self._position_deg

    def _set(self, state: Kinematics) -> None:
        position, self._velocity_deg_s, self._acceleration_deg_s2 = state
        lower, upper = self._bounds
        self._position_deg = lower if position < lower else upper if position > upper else position

    def _state(self) -> Kinematics:
        return Kinematics(self._position_deg, self._velocity_deg_s, self._acceleration_deg_s2)

    def _rest_at(self, position_deg: float) -> None:
        self._position_deg = position_deg
        self._velocity_deg_s = self._acceleration_deg_s2 = 0.0
        self._path = self._stream = self._pursuit = None
        self._mode = MotionMode.HOLD
        self._bounds = self._bounds_here()

    def _bounds_here(self) -> Bounds:
        """Returns the position limits, extended to the present position if it is outside."""
        limits, here = self._limits, self._position_deg
        return Bounds(min(limits.position_min_deg, here), max(limits.position_max_deg, here))

    def _take(self, path: Plan | Cubic, mode: MotionMode, since_s: float = 0.0) -> None:
        self._bounds = self._bounds_here()
        self._path, self._steps, self._since_s = path, 0, since_s
        self._stream = self._pursuit = None
        self._mode = mode
        self._underrun = False

    def _planned(self, target_deg: float, velocity_deg_s: float, acceleration_deg_s2: float) -> Plan:
        """Returns the plan to a target; raises `InputError` if no plan exists."""
        now, bounds = self._state(), self._bounds_here()
        for acceleration in (acceleration_deg_s2, math.inf):
            # In motion a gentle move may have to brake as hard as the axis can, to stay within its limits.
            plan = self._generator.to_position(now, target_deg, bounds, velocity_deg_s, acceleration)
            if plan is not None:
                return plan
            if self.at_rest:
                break
        raise InputError(
            f"no way from {now.position_deg:.9g} deg at {now.velocity_deg_s:.4g} deg/s to {target_deg:.9g} "
            "deg within the limits: check velocity and acceleration of the move and the limits in the axis "
            "file, or stop the axis first"
        )

    def _brake(self, since_s: float) -> None:
        """Brakes to rest in the first of three ways that stays within the position limits.

        The first is as fast as the jerk limit permits. The second, if the first would overshoot a limit,
        returns to the present position, which brakes as hard and releases later. The third has constant
        acceleration, needs no more travel than any path within the limits, and is always possible. It is
        needed only in a stream whose knots brake against a limit with more than the axis's jerk.
        """
        now, bounds = self._state(), self._bounds_here()
        if self._stream is not None or self._pursuit is not None:
            # Their jerk is not limited. At the acceleration of a reversal, a stop would turn the axis round.
            most = math.sqrt(2.0 * self._limits.jerk_deg_s3 * abs(now.velocity_deg_s))
            most = min(most, self._limits.acceleration_deg_s2)
            now = now._replace(acceleration_deg_s2=min(max(now.acceleration_deg_s2, -most), most))
        path = (
            self._generator.to_rest(now, bounds)
            or self._generator.to_position(now, now.position_deg, bounds)
            or self._steady_stop(now, bounds)
        )
        self._take(path, MotionMode.STOP, since_s)

    def _steady_stop(self, now: Kinematics, bounds: Bounds) -> Cubic:
        """Returns a stop with constant deceleration: at the limit, or as the remaining travel requires."""
        place, speed = now.position_deg, abs(now.velocity_deg_s)
        left_deg = bounds.upper_deg - place if now.velocity_deg_s > 0.0 else place - bounds.lower_deg
        travel_deg = min(speed * speed / (2.0 * self._limits.acceleration_deg_s2), left_deg)
        if not (speed and travel_deg > 0.0):
            return Cubic.between(0.0, place, 0.0, self._period_s, place, 0.0)
        end_deg = place + math.copysign(travel_deg, now.velocity_deg_s)
        return Cubic.between(0.0, place, now.velocity_deg_s, 2.0 * travel_deg / speed, end_deg, 0.0)

    def _coasting_deg(self) -> float:
        """Returns an upper bound of the travel before the axis has slowed down."""
        limits, speed = self._limits, abs(self._velocity_deg_s)
        easing_s = (abs(self._acceleration_deg_s2) + limits.acceleration_deg_s2) / limits.jerk_deg_s3
        return limits.velocity_deg_s * (speed / limits.acceleration_deg_s2 + 2.0 * easing_s)

    def _timeout(self, timeout_s: float) -> int:
        """Converts a time-out to periods."""
        if not 0.0 < timeout_s <= MOST_TIMEOUT_S:
            raise InputError(
                f"a time-out of {timeout_s!r} s; expected more than 0 and at most {MOST_TIMEOUT_S:g}"
            )
        return max(round(timeout_s / self._period_s), 1)

    def _streaming(self) -> Stream:
        if self._stream is None:
            raise InputError("no stream has been begun: begin one before its knots come")
        return self._stream


def _check_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"a {name} of {value!r}; expected a finite number")


def _positive(name: str, value: float | None) -> float:
    """Returns a limit of a move; infinite if not given."""
    if value is None:
        return math.inf
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"a {name} of {value!r} for this move; expected a finite number above 0")
    return value
