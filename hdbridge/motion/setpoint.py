"""Set-point of one axis in each control period, with commands accepted at any time.

Every motion continues from the current position, velocity and acceleration, so a new target does not require
rest. An impossible command is refused (`InputError`) without any change, and the current motion continues.

The set-point always stays within the position limits. A plan is accepted only if its extremes are within
them, and braking has a fallback that is always possible (`SetPoint._brake`). Rounding errors are clipped.
"""

import math

from hdbridge.errors import InputError
from hdbridge.motion.generator import Bounds, Generator, Kinematics, Plan
from hdbridge.motion.modes import MotionMode
from hdbridge.motion.procedures.moves import MotionLimits
from hdbridge.motion.pursuit import Pursuit
from hdbridge.motion.stream import Cubic, Stream

MOST_TIMEOUT_S = 60.0
"""Maximum time-out of a jog or a stream that is no longer renewed."""


class SetPoint:
    """Computes the load target in each control period.

    Pure: time is counted in calls of `step`. An axis that stands outside its position limits may hold its
    position and move inwards.
    """

    def __init__(self, limits: MotionLimits, period_s: float) -> None:
        """Creates a set-point at 0 deg (see `reset`); ``period_s`` is the time between two calls of `step`.

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
        """Path in progress; None at rest, in a stream and in a pursuit."""
        self._steps = 0
        """Number of periods since ``_path`` was set, when ``_since_s`` of the path had already elapsed."""
        self._since_s = 0.0
        self._left = self._stream_timeout = 0
        """Periods left before a jog or a resting stream times out, and time-out of a stream in periods."""
        self._mode = MotionMode.HOLD
        self._underrun = False
        self._position_deg = self._velocity_deg_s = self._acceleration_deg_s2 = 0.0
        self._bounds = Bounds(*ends)

    @property
    def position_deg(self) -> float:
        """Load target after the last `step`."""
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
        """True if the set-point is at rest and remains so until it receives further input."""
        if self._stream is not None:
            return self._stream.waiting
        if self._pursuit is not None:
            return self._pursuit.at_rest
        return self._path is None

    @property
    def underrun(self) -> bool:
        """True if the last stream ran out of knots in motion, so that the axis was braked."""
        return self._underrun

    @property
    def room(self) -> int:
        """Number of further knots for which there is room now; 0 outside a stream."""
        return 0 if self._stream is None else self._stream.room

    def reset(self, load_deg: float) -> None:
        """Sets a position at rest and discards all motion; to be used while the drive does not move the axis.

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
        """Moves to a load angle and rests there, starting from rest or from any motion.

        Velocity and acceleration limit this move in addition to the axis's limits. Raises `InputError` for a
        target outside the position limits and for an invalid number. In motion, also raises it if the path
        would leave the position limits (stop first).
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
        """Moves at a velocity (up to the axis's limit) until the time-out; a velocity of zero brakes.

        Call it again before the time-out to continue the motion. The axis brakes before a position limit and
        waits there. Raises `InputError` for an invalid number, for example a time-out that is not greater
        than 0 s or exceeds `MOST_TIMEOUT_S`.
        """
        _check_finite("velocity", velocity_deg_s)
        timeout = self._timeout(timeout_s)
        limits = self._limits
        speed = min(abs(velocity_deg_s), limits.velocity_deg_s)
        if not speed:
            self.stop()
            return
        # A jog is planned as a move, so that the plan respects the position limits. Its target is the limit,
        # or a position that the axis cannot reach before the time-out.
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
        """Brakes to rest within the limits; at rest, ends a stream or a jog. It is never refused."""
        if self.at_rest:
            self._rest_at(self._position_deg)
        elif self._mode is not MotionMode.STOP:
            self._brake(0.0)

    def stream(self, timeout_s: float) -> None:
        """Starts a stream, which follows knots (`knot`) from the current position.

        The time of the knots starts with the first `step` after `begin_stream`. If the axis rests for the
        time-out without a new knot, the stream ends with a hold. Raises `InputError` in motion, and for a
        time-out that is not above 0 and up to `MOST_TIMEOUT_S`.
        """
        timeout = self._timeout(timeout_s)
        if not self.at_rest:
            raise InputError("a stream must begin at rest: stop the axis first")
        self._rest_at(self._position_deg)
        self._stream = Stream(self._position_deg, self._limits, self._bounds_here(), self._period_s)
        self._stream_timeout = timeout
        self._left = timeout
        self._underrun = False
        self._mode = MotionMode.STREAM

    def follow(self) -> None:
        """Pursues the positions passed to `aim` until another command; raises `InputError` in motion."""
        if not self.at_rest:
            raise InputError("following another master must begin at rest: stop the axis first")
        self._rest_at(self._position_deg)
        self._pursuit = Pursuit(self._position_deg, self._limits, self._bounds, self._period_s)
        self._aim = (self._position_deg, 0.0)
        self._mode = MotionMode.FOLLOW

    def aim(self, position_deg: float, spacing_s: float = 0.0) -> None:
        """Sets the position to pursue with the next `step`; raises `InputError` if it is not finite.

        ``spacing_s`` is the time between the set-points from which the position was interpolated.
        """
        _check_finite("load angle", position_deg)
        self._aim = (position_deg, spacing_s)

    def begin_stream(self) -> None:
        """Starts the stream's time with the next `step`; raises `InputError` without a `stream`."""
        self._streaming().begin()

    def knot(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        """Adds a knot to the stream: time since the stream's start, and load angle and velocity at that time.

        Between two knots the set-point follows the cubic with the knots' velocities. Raises `InputError`, and
        leaves the stream unchanged, in four cases: the knot is not later than the last one; position, speed
        or (by more than 5 %) acceleration would exceed the limits, on the path to the knot or when braking
        from it; the first knot is not at rest at the axis's position; the buffer is full (`room`).
        """
        self._streaming().add(time_s, position_deg, velocity_deg_s)

    def step(self) -> float:
        """Advances by one period and returns the load target, degrees."""
        if self._stream is not None:
            return self._step_stream(self._stream)
        if self._pursuit is not None:
            state = self._pursuit.step(*self._aim)  # respects the limits
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
        """Returns the position limits, extended to the current position if that is outside."""
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
            # In motion, a slow move may need the axis's full deceleration to stay within the position limits.
            plan = self._generator.to_position(now, target_deg, bounds, velocity_deg_s, acceleration)
            if plan is not None:
                return plan
            if self.at_rest:
                break
        raise InputError(
            f"no trajectory from {now.position_deg:.9g} deg at {now.velocity_deg_s:.4g} deg/s to "
            f"{target_deg:.9g} deg within the limits: check velocity and acceleration of the move and the "
            "limits in the axis file, or stop the axis first"
        )

    def _brake(self, since_s: float) -> None:
        """Brakes to rest by the first of three paths that stays within the position limits.

        The first path stops as fast as the jerk limit permits. The second returns to the current position; it
        brakes equally hard but reduces the deceleration later. The third has constant deceleration. It needs
        no more travel than any path within the limits, and is always possible. It is required only if the
        knots of a stream brake towards a position limit with more than the axis's jerk.
        """
        now, bounds = self._state(), self._bounds_here()
        if self._stream is not None or self._pursuit is not None:
            # Jerk is not limited in these modes. From the acceleration of a reversal, a jerk-limited stop
            # would reverse the axis.
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
        """Returns a stop with constant deceleration, at the limit or as the remaining travel requires."""
        place, speed = now.position_deg, abs(now.velocity_deg_s)
        left_deg = bounds.upper_deg - place if now.velocity_deg_s > 0.0 else place - bounds.lower_deg
        travel_deg = min(speed * speed / (2.0 * self._limits.acceleration_deg_s2), left_deg)
        if not (speed and travel_deg > 0.0):
            return Cubic.between(0.0, place, 0.0, self._period_s, place, 0.0)
        end_deg = place + math.copysign(travel_deg, now.velocity_deg_s)
        return Cubic.between(0.0, place, now.velocity_deg_s, 2.0 * travel_deg / speed, end_deg, 0.0)

    def _coasting_deg(self) -> float:
        """Returns an upper bound of the travel within which the axis can slow down to any lower speed."""
        limits, speed = self._limits, abs(self._velocity_deg_s)
        easing_s = (abs(self._acceleration_deg_s2) + limits.acceleration_deg_s2) / limits.jerk_deg_s3
        return limits.velocity_deg_s * (speed / limits.acceleration_deg_s2 + 2.0 * easing_s)

    def _timeout(self, timeout_s: float) -> int:
        """Converts a time-out to a number of periods; raises `InputError` if it is out of range."""
        if not 0.0 < timeout_s <= MOST_TIMEOUT_S:
            raise InputError(
                f"a time-out of {timeout_s!r} s; expected more than 0 and at most {MOST_TIMEOUT_S:g}"
            )
        return max(round(timeout_s / self._period_s), 1)

    def _streaming(self) -> Stream:
        if self._stream is None:
            raise InputError("no stream has been started; start one before sending knots")
        return self._stream


def _check_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"the {name} is {value!r}; expected a finite number")


def _positive(name: str, value: float | None) -> float:
    """Returns a validated limit of a move; infinity if none is given."""
    if value is None:
        return math.inf
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"the {name} of this move is {value!r}; expected a finite number above 0")
    return value
