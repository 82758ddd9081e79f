"""Inverse of the transmission model: computes the motor target that brings the load to its target.

The compensated motor angle solves ``theta_M / N + w TE(theta_M) = theta_L``, where TE is the model's error
from its current state and w the ramp's weight. Three choices matter:

* The model's input is the commanded angle, never a measured one. At a reversal, the slope of the elastic
  hysteresis is infinite, and one count of encoder noise would become several arcseconds.
* The root is bracketed. The left side rises with theta_M as long as the error cannot fall faster than
  ``theta_M / N`` rises; the root is then unique. Any other model is refused, except that the slope of
  backlash is reduced. A plain fixed-point iteration does not converge near a reversal.
* The model's state changes only when a command is issued (`Compensation.command`), with the angle issued,
  after caps and ramps.

An effect may need a channel that can be lost (`LOSABLE`). `Compensation.set_known_channels` sets the
available channels. The part of the correction that needs a lost channel is faded out, as by `disengage`, and
later back in.

In motion the servo filters the correction. If the model has the measured response of the axis, the correction
passes through its filter (`prefilter`). The model's state follows the unfiltered path, which is the intended
path of the motor.

Pure: no clock, no bus.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from hdbridge.axis.effects import Channel, Effect, Moment, Start, Sum, Tracker, compensable, fall_bound
from hdbridge.axis.effects.described import Level, Memoryless
from hdbridge.axis.effects.motion import MEASURED
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.prefilter import Prefilter
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

_TOLERANCE_ARCSEC = 5e-7
_STEEPEST_FALL = 0.9
_SAFE = 0.9
"""Fraction of the steepest permitted fall that the sum may use after the slope of backlash is reduced; the
rest is a margin."""
_NOWHERE = Moment()
_TURNS = 32
"""Number of reversals of the issued path that are kept, to initialise a model that takes over from this
one."""
LOSABLE = frozenset(each for each in MEASURED if each.axis_key)
"""Channels with their own sensors, which can be lost."""


@dataclass(frozen=True, slots=True)
class CompensationLimits:
    """Limits of the compensation's offset from the uncompensated target."""

    maximum_arcsec: float = 300.0
    """Cap on the correction, arcsec at the load."""
    slew_arcsec_s: float = 20_000.0
    """Cap on the rate of the correction, arcsec at the load per second."""
    ramp_s: float = 0.5
    """Time over which the correction fades in or out."""


class _Faded(Tracker):
    """Tracker that multiplies an effect's error by a weight; it follows the motion at any weight."""

    def __init__(self, tracker: Tracker, needs: frozenset[Channel]) -> None:
        self._tracker = tracker
        self.needs = needs
        self.weight = 1.0

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self.weight * self._tracker.peek(motor_deg, moment)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        return self.weight * self._tracker.advance(motor_deg, moment)


class Inverse:
    """Inverse of the model, from the state after the last `advance`."""

    def __init__(self, model: TransmissionModel, start: Start = Start.VIRGIN) -> None:
        """Omits effects that cannot or must not be compensated, such as the load encoder's errors.

        Raises InputError if the model's error falls too steeply for a unique inverse.
        """
        model = replace(model, effects=compensable(model.effects))
        self._slope = ARCSEC_PER_DEG / model.ratio
        trackers, self._fall = _gentle(model.effects, start, _STEEPEST_FALL * self._slope)
        stateful = [not isinstance(each, Memoryless) for each in trackers]
        self.faded: list[_Faded] = []
        """Effects that depend on a channel that can be lost."""
        for place, each in enumerate(model.effects):
            if sensed := each.needs() & LOSABLE:
                trackers[place] = faded = _Faded(trackers[place], sensed)
                self.faded.append(faded)
        # Effects that do not depend on the motor angle, such as wind-up, are evaluated once per cycle.
        level = [isinstance(each, Level) for each in trackers]
        self._offsets = [each for each, is_level in zip(trackers, level, strict=True) if is_level]
        self._enter(_NOWHERE)
        trackers = [each for each, is_level in zip(trackers, level, strict=True) if not is_level]
        stateful = [keeps for keeps, is_level in zip(stateful, level, strict=True) if not is_level]
        self._tracker: Tracker = trackers[0] if len(trackers) == 1 else Sum(trackers)
        self._stateful = [each for each, keeps in zip(trackers, stateful, strict=True) if keeps]
        if self._fall > _STEEPEST_FALL * self._slope:
            raise InputError(
                f"the model's error can fall by {self._fall:.3g} arcsec per motor degree, "
                f"more than {_STEEPEST_FALL:g} of the gear's own {self._slope:.3g}: "
                "it has no usable inverse; check the amplitudes and orders"
            )
        self._motor_deg = self._before_deg = 0.0
        self._error = self._rise = 0.0
        self._peeked: tuple[float, float, Moment] | None = None
        """Angle, error and moment of the last solution of `solve`."""
        self._standing = False
        """True if advancing to the same angle again changes nothing."""
        self.needs = frozenset[Channel]().union(*(each.needs() for each in model.effects))
        """Channels that the effects need."""
        # Without channels, the error does not change at rest, so it is not evaluated again.
        bent = (each for each, is_level in zip(model.effects, level, strict=True) if not is_level)
        self._timeless = not any(each.needs() for each in bent)
        self.memory_deg = self._tracker.memory_deg
        """Motor travel in one direction after which the state no longer depends on the start."""
        self._forward: bool | None = None
        """True if the last motion was forward; None before the first motion."""
        self._known = not self.memory_deg
        """True if an earlier run in one direction exceeded the memory, or if the model has no memory."""
        self._turns = deque([0.0], _TURNS)
        """Motor angles of the start and the reversals of the issued path."""

    @property
    def error_arcsec(self) -> float:
        """Model's error at the last motor target, arcsec at the load."""
        return self._error + self._offset

    @property
    def path_deg(self) -> list[float]:
        """Motor angles of the start, the reversals and the current end of the issued path, degrees."""
        return [*self._turns, self._motor_deg]

    @property
    def memory_known(self) -> bool:
        """True if the issued path has run further in one direction than the model's memory."""
        return self._known or abs(self._motor_deg - self._turns[-1]) >= self.memory_deg

    def error_at(self, motor_deg: float, moment: Moment = _NOWHERE) -> float:
        """Returns the error predicted after a move to ``motor_deg``, arcsec, without changing the state."""
        return self._tracker.peek(motor_deg, moment) + (
            self._offset if moment is self._moment else self._level(moment)
        )

    def _level(self, moment: Moment) -> float:
        """Returns the part of the error that does not depend on the motor angle, arcsec."""
        total = 0.0
        for each in self._offsets:
            total += each.peek(0.0, moment)
        return total

    def _enter(self, moment: Moment) -> None:
        """Evaluates the part that does not depend on the motor angle, for a new cycle."""
        self._moment = moment
        self._offset = self._level(moment)

    def begin(self, motor_deg: float, moment: Moment = _NOWHERE) -> None:
        """Starts at this motor angle, with an unknown history."""
        self.advance(motor_deg, moment)
        self._forward = None
        self._known = not self.memory_deg
        self._turns.clear()
        self._turns.append(motor_deg)

    def advance(self, motor_deg: float, moment: Moment = _NOWHERE) -> float:
        """Advances the state to an issued command; returns the model's error there, arcsec."""
        if self._offsets and moment is not self._moment:
            self._enter(moment)
        if self._standing and motor_deg == self._motor_deg:
            return self._error + self._offset
        peeked = self._peeked
        if peeked is not None and peeked[0] == motor_deg and peeked[2] is moment:
            # The error is known, so only effects with a state need to advance.
            error = peeked[1]
            for each in self._stateful:
                each.advance(motor_deg, moment)
        else:
            error = self._tracker.advance(motor_deg, moment)
        self._peeked = None
        step = motor_deg - self._motor_deg
        if step:
            forward = step > 0.0
            if forward is not self._forward:
                self._turn(forward)
            self._rise = (error - self._error) / step
            self._before_deg = self._motor_deg
        self._motor_deg = motor_deg
        self._error = error
        self._standing = self._timeless
        return error + self._offset

    def _turn(self, forward: bool) -> None:
        """Records a reversal at the current angle."""
        if self._forward is not None:
            self._known = self.memory_known
            self._turns.append(self._motor_deg)
        self._forward = forward

    def solve(self, load_deg: float, moment: Moment = _NOWHERE, weight: float = 1.0) -> float:
        """Returns the motor angle, degrees, that brings the load to ``load_deg``; changes no state.

        ``weight`` scales the error (0: uncompensated). Accurate to 1e-6 arcsec at the load, or to the last
        bit of the motor angle if the error is so steep that one bit exceeds this.
        """
        peek, slope, last = self._tracker.peek, self._slope, self._motor_deg
        self._peeked = None
        if self._offsets and moment is not self._moment:
            self._enter(moment)
        goal = ARCSEC_PER_DEG * load_deg - weight * self._offset
        here = self._error if self._timeless else peek(last, moment)
        gap = goal - slope * last - weight * here
        if abs(gap) <= _TOLERANCE_ARCSEC:
            return last
        # Away from reversals, the last step gives the first slope, and three points give the next ones.
        before, x0, f0, s0 = self._before_deg, last, -gap, slope + weight * self._rise
        x1 = last + gap / (s0 if 0.5 * slope < s0 < 2.0 * slope else slope)
        for _ in range(4):
            error = peek(x1, moment)
            f1 = slope * x1 + weight * error - goal
            if -_TOLERANCE_ARCSEC <= f1 <= _TOLERANCE_ARCSEC:
                self._peeked = (x1, error, moment)
                return x1
            if f1 == f0:
                break
            s1 = (f1 - f0) / (x1 - x0)
            bend = (x1 - x0) * (s1 - s0) / (x1 - before) if x1 != before else 0.0
            # Points before a reversal do not predict the slope after the reversal, so only the chord is used.
            s = s1 + bend if -0.5 < bend / s1 < 1.0 else s1
            before, x0, x1, f0, s0 = x0, x1, x1 - f1 / s, f1, s1
        # Left side minus right side rises by at least `slope - weight * fall` per degree: bounds the root.
        far = last + gap / (slope - weight * self._fall) * (1.0 + 1e-9)
        return self._bracketed(goal, moment, weight, last, -gap, far)

    def _bracketed(self, goal: float, moment: Moment, weight: float, a: float, fa: float, b: float) -> float:
        """Solves by Chandrupatla's method: inverse quadratic steps if they are safe, else bisection."""
        peek, slope = self._tracker.peek, self._slope
        fb = slope * b + weight * peek(b, moment) - goal
        c, fc = a, fa
        t = 0.5
        for _ in range(200):
            x = a + t * (b - a)
            fx = slope * x + weight * peek(x, moment) - goal
            if (fx > 0.0) == (fa > 0.0):
                c, fc = a, fa
            else:
                c, fc, b, fb = b, fb, a, fa
            a, fa = x, fx
            best, fbest = (a, fa) if abs(fa) < abs(fb) else (b, fb)
            width = abs(b - a)
            if abs(fbest) <= _TOLERANCE_ARCSEC or width <= 4.0 * math.ulp(best):
                return best
            xi = (a - b) / (c - b)
            phi = (fa - fb) / (fc - fb)
            t = 0.5
            if phi * phi < xi and (1.0 - phi) * (1.0 - phi) < 1.0 - xi:
                t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
                edge = 2.0 * math.ulp(best) / width
                t = min(max(t, edge), 1.0 - edge)
        return best


def _gentle(effects: tuple[Effect, ...], start: Start, steepest: float) -> tuple[list[Tracker], float]:
    """Returns trackers of the effects, and a bound on the fall of their sum, arcsec per motor degree.

    The load rests while the motor crosses backlash. The error then falls as fast as the motor angle divided
    by the ratio rises, or faster if noise made the fitted backlash too narrow. If the sum would fall more
    steeply than ``steepest``, the slope of backlash is reduced to the margin that the other effects leave.
    """
    trackers = [each.tracker(start) for each in effects]
    fall = fall_bound(effects)
    if fall <= steepest:
        return trackers, fall
    play = [place for place, each in enumerate(effects) if each.gentle_tracker(start, steepest) is not None]
    left = _SAFE * steepest - fall_bound(each for place, each in enumerate(effects) if place not in play)
    if not play or left <= 0.0:
        return trackers, fall
    gentle = {place: effects[place].gentle_tracker(start, left / len(play)) for place in play}
    if any(each is None for each in gentle.values()):
        return trackers, fall
    return [gentle.get(place) or each for place, each in enumerate(trackers)], _SAFE * steepest


class Compensation:
    """Inverse with caps and ramps, called once per control cycle.

    It begins disengaged, with a motor target of N times the load target. `engage` and `disengage` fade the
    correction in and out, so switching never causes a jump.
    """

    def __init__(self, model: TransmissionModel, limits: CompensationLimits, period_s: float) -> None:
        """``period_s`` is the control cycle.

        Raises InputError if the model's response was measured with a different cycle time.
        """
        self.model = model
        """Model that is inverted; `Bench` rejects the model of a different axis, gear or drive."""
        self._inverse = Inverse(model)
        self._ratio = model.ratio
        self.maximum_arcsec = limits.maximum_arcsec
        """Cap on the correction, arcsec at the load."""
        self.step_arcsec = limits.slew_arcsec_s * period_s
        """Maximum change of the correction in one cycle, arcsec at the load."""
        self.ramp_step = period_s / limits.ramp_s if limits.ramp_s > 0.0 else 1.0
        """Maximum change of a weight in one cycle."""
        self.weight = 0.0
        """Weight of the ramp: 0 off, 1 fully on."""
        self._target = 0.0
        self.correction_arcsec = self._static = 0.0
        """Correction in force, arcsec at the load: the error that the motor target compensates."""
        self._prefilter: Prefilter | None = None
        if (response := model.response) is not None:
            if not response.fits_cycle(period_s):
                raise InputError(
                    f"the model's response was measured with a cycle of {response.cycle_ms:g} ms, but this "
                    f"axis has {1000.0 * period_s:g} ms: measure it again with 'hdbridge motion AXIS "
                    "--propose', then commit"
                )
            self._prefilter = Prefilter(response.filter, period_s, self._inverse.needs)
        self._known = LOSABLE
        self._fading = False
        self.needs = self._inverse.needs
        """Channels required in a `Moment`; if empty, the moment may be omitted."""
        self.limited = 0
        """Number of cycles in which a cap or the slew limit acted."""

    @property
    def predicted_arcsec(self) -> float:
        """Model's error at the last motor target, arcsec at the load, regardless of the weight."""
        return self._inverse.error_arcsec

    @property
    def memory_known(self) -> bool:
        """True if the model's state depends only on the path issued since `reset`, because this path has run
        further in one direction than the model's memory. Always True for a model without memory.
        """
        return self._inverse.memory_known

    def set_known_channels(self, channels: frozenset[Channel]) -> None:
        """Sets the available channels of `LOSABLE`; effects that need other channels fade out."""
        self._known = channels
        self._fading = bool(self._inverse.faded)

    def engage(self) -> None:
        """Fades the correction in from the next command on."""
        self._target = 1.0

    def disengage(self) -> None:
        """Fades the correction out from the next command on."""
        self._target = 0.0

    def reset(self, motor_deg: float, moment: Moment = _NOWHERE) -> None:
        """Restarts at ``motor_deg``, at standstill and without a correction."""
        self.weight = self.correction_arcsec = self._static = 0.0
        if self._prefilter is not None:
            self._prefilter.reset(0.0)
        for each in self._inverse.faded:
            each.weight = float(each.needs <= self._known)
        self._inverse.begin(motor_deg, moment)

    def command(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        """Returns the motor target in degrees for this cycle's load target; advances the model's state."""
        motor, limited = self._solved(load_deg, moment), self.limited
        static = self._limit(ARCSEC_PER_DEG * (load_deg - motor / self._ratio), self._static)
        if self.limited != limited:
            motor = self._ratio * (load_deg - static / ARCSEC_PER_DEG)
        correction = static
        if self._prefilter is not None:
            filtered = self._prefilter.follow(load_deg, static, moment, self._predicted)
            correction = self._limit(filtered, self.correction_arcsec)
            self.limited = min(self.limited, limited + 1)
        self._static, self.correction_arcsec = static, correction
        self._inverse.advance(motor, moment)
        return motor if correction == static else self._ratio * (load_deg - correction / ARCSEC_PER_DEG)

    def _limit(self, wanted: float, last: float) -> float:
        """Applies the slew limit and the cap to the correction; increments `limited` if one of them acts."""
        slew, most = self.step_arcsec, self.maximum_arcsec
        if last - slew <= wanted <= last + slew and -most <= wanted <= most:
            return wanted
        self.limited += 1
        return min(max(min(max(wanted, last - slew), last + slew), -most), most)

    def _predicted(self, load_deg: float, moment: Moment) -> float:
        """Returns the correction predicted for a future load target, arcsec, without changing the state."""
        motor = self._ratio * (load_deg - self._static / ARCSEC_PER_DEG)
        return self.weight * self._inverse.error_at(motor, moment)

    def _solved(self, load_deg: float, moment: Moment) -> float:
        """Advances the ramps by one cycle; returns the required motor angle, degrees, before the limits."""
        weight = self.weight
        if weight != self._target:
            step = self.ramp_step
            weight += min(max(self._target - weight, -step), step)
            self.weight = weight
        if self._fading:
            self._fade()
        return self._inverse.solve(load_deg, moment, weight)

    def wanted(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        """Returns the correction that `command` would approach, arcsec, within the cap; advances the ramps.

        For two compensations that share one motor (`switchover.Correction`); must be followed by `issued`.
        """
        most = self.maximum_arcsec
        wanted = ARCSEC_PER_DEG * (load_deg - self._solved(load_deg, moment) / self._ratio)
        wanted = min(max(wanted, -most), most)
        if self._prefilter is None:
            return wanted
        self._static = wanted
        wanted = self._prefilter.follow(load_deg, wanted, moment, self._predicted)
        return min(max(wanted, -most), most)

    def issued(self, motor_deg: float, correction_arcsec: float, moment: Moment = _NOWHERE) -> None:
        """Advances the model's state to the motor target that was sent, which contains this correction."""
        if self._prefilter is None:
            self._static = correction_arcsec
        motor_deg += self._ratio * (correction_arcsec - self._static) / ARCSEC_PER_DEG
        self.correction_arcsec = correction_arcsec
        self._inverse.advance(motor_deg, moment)

    def take_over(self, other: Compensation, moment: Moment = _NOWHERE) -> None:
        """Makes this new compensation continue from another one, along the path that the other has issued.

        Effects with memory receive the state that results from this path, as far back as the path is kept.
        """
        self._known, self._fading = other._known, bool(self._inverse.faded)
        begin, *rest = other._inverse.path_deg
        self.reset(begin, moment)
        for motor_deg in rest:
            self._inverse.advance(motor_deg, moment)
        self.weight, self._target = other.weight, other._target
        self.correction_arcsec, self._static = other.correction_arcsec, other._static
        if self._prefilter is not None:
            self._prefilter.take_over(other._prefilter, self._static)

    def _fade(self) -> None:
        """Advances the weights of the fading effects by one cycle."""
        settled = True
        for each in self._inverse.faded:
            target = float(each.needs <= self._known)
            each.weight += min(max(target - each.weight, -self.ramp_step), self.ramp_step)
            settled = settled and each.weight == target
        self._fading = not settled

    def hold(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        """Returns the motor target in degrees with a frozen correction, for a cycle without feedback."""
        if self._prefilter is not None:
            self._prefilter.follow(load_deg, self._static, moment, self._predicted)
        self._inverse.advance(self._ratio * (load_deg - self._static / ARCSEC_PER_DEG), moment)
        return self._ratio * (load_deg - self.correction_arcsec / ARCSEC_PER_DEG)
