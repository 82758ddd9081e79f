"""Measuring: converts samples to observations, and provides the linear problem of the observations.

``observed - committed prediction = columns @ change + nuisances``. The columns come from the effects
themselves. An effect without memory provides them for any angles. For an effect with memory, trackers of unit
coefficients follow the command, which by linearity is equivalent. Nuisance parameters are fitted as well but
never applied: the zero, and the once and twice per turn error of an eccentric or oval load encoder disc.

An observation is the mean over the second half of a standstill, over a few degrees of slow motion, or over a
quarter of a second of fast motion at constant speed. Fast motion shows only the zero, because wind-up, drag
and the delay between the encoders would look like a change of the hysteresis loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hdbridge.axis.effects import (
    BoolArray,
    Channel,
    Effect,
    FloatArray,
    IntArray,
    Moment,
    Motion,
    readings,
    refreshed,
)
from hdbridge.axis.effects.described import Memoryless
from hdbridge.axis.effects.kinematics import Observer
from hdbridge.axis.effects.orders import cosines_and_sines
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

LOAD_ORDERS = (1, 2)
"""Orders per turn of the load: eccentricity and ovality of the encoder's disc."""
SETTLE_S = 0.05
"""Settling time of the load after a fast move, and after a reversal in a slow move."""
SHORTEST_S = 0.04
"""Minimum duration of a standstill, in addition to the settling time."""
LONGEST_S = 1.0
"""Maximum duration of an observation at rest. Only the first of a standstill is used for more than the
zero."""
FAST_S = 0.25
"""Duration of an observation in fast motion."""
SPEED_TOLERANCE = 1e-3
"""Maximum relative change from one sample to the next at which a speed counts as constant."""
CELL_DEG = 3.0
"""Motor travel of an observation in slow motion."""
REVERSAL_DEG = 0.3
"""Reverse motor travel that counts as a reversal."""


@dataclass(frozen=True, slots=True)
class Term:
    """Effect whose coefficients drift."""

    effect: Effect
    """Committed effect."""
    number: int
    """Index in the model's effects."""
    columns: slice
    """Columns of its coefficients."""
    memory: bool
    """True if the effect has memory, so that only reversals show it."""


class DriftModel:
    """Linear model of drift: coefficients that wear or temperature change, zero, load encoder disc."""

    def __init__(self, model: TransmissionModel, parameters: Sequence[str] | None = None) -> None:
        """``parameters`` as in `AdaptationSettings`; raises InputError for one that the model lacks."""
        self.model = model
        self.terms = _terms(model, parameters)
        self.zero = sum(len(each.effect.coefficients()) for each in self.terms)
        """Index of the zero's column; the coefficients precede it, the disc follows it."""
        self.count = self.zero + 1 + 2 * len(LOAD_ORDERS)
        """Number of columns."""
        self.committed = np.concatenate([np.zeros(0), *(each.effect.coefficients() for each in self.terms)])
        """Committed coefficients, shape (zero,)."""
        self.has_memory = np.zeros(self.count, dtype=bool)
        """Mask of the columns with memory."""
        for each in self.terms:
            self.has_memory[each.columns] = each.memory

    def changed(self, change: FloatArray) -> TransmissionModel:
        """Returns the committed model with changed coefficients, (zero,)."""
        effects = list(self.model.effects)
        for each in self.terms:
            effects[each.number] = each.effect.fitted(each.effect.coefficients() + change[each.columns])
        return replace(self.model, effects=refreshed(effects), path=None)

    def columns_in(self, whole: DriftModel) -> IntArray:
        """Returns the indices of this model's columns in a model with more parameters, shape (count,)."""
        columns = {each.number: each.columns for each in whole.terms}
        own = [np.arange(whole.count)[columns[each.number]] for each in self.terms]
        return np.concatenate([*own, np.arange(whole.zero, whole.count)])


class DriftColumns:
    """Columns of a `DriftModel` along the commanded path."""

    def __init__(self, drift: DriftModel) -> None:
        """Starts with an unknown hysteresis state."""
        self._drift = drift
        followed = {each.number for each in drift.terms}
        self._fixed = [
            each.tracker() for number, each in enumerate(drift.model.effects) if number not in followed
        ]
        self._units = {
            at: _unit(each.effect, number).tracker()
            for each in drift.terms
            if each.memory
            for number, at in enumerate(range(each.columns.start, each.columns.stop))
        }
        trackers = (*self._fixed, *self._units.values())
        self._memory_deg = max((each.memory_deg for each in trackers), default=0.0)
        self.known = not self._memory_deg
        """True if the trackers no longer depend on the state before the start."""
        self._last_deg = self._turn_deg = math.nan
        """Last angle, and angle of the last reversal."""
        self.state: tuple[float, ...] = ()
        """Path-dependent values: the sum of the fixed effects, and the columns with memory."""

    def advance(self, motor_deg: float, moment: Moment) -> None:
        """Advances all trackers to this commanded angle."""
        fixed = sum(each.advance(motor_deg, moment) for each in self._fixed)
        self.state = (fixed, *(each.advance(motor_deg, moment) for each in self._units.values()))
        if self.known:
            return
        last_deg, self._last_deg = self._last_deg, motor_deg
        if not (motor_deg - last_deg) * (last_deg - self._turn_deg) >= 0.0:
            self._turn_deg = motor_deg if math.isnan(last_deg) else last_deg
        self.known = abs(motor_deg - self._turn_deg) >= self._memory_deg

    def rows(self, motor_deg: FloatArray, states: FloatArray) -> FloatArray:
        """Returns all columns at motor angles (n,) with `state` values (n, s); shape (n, count)."""
        drift = self._drift
        rows = np.zeros((len(motor_deg), drift.count))
        rows[:, list(self._units)] = states[:, 1:]
        motion = Motion(motor_deg)
        for each in drift.terms:
            if not each.memory:
                rows[:, each.columns] = each.effect.columns(motion)
        rows[:, drift.zero] = 1.0
        load = np.deg2rad(motor_deg / drift.model.ratio)
        rows[:, drift.zero + 1 :] = cosines_and_sines(load, LOAD_ORDERS)
        return rows


def _terms(model: TransmissionModel, parameters: Sequence[str] | None) -> tuple[Term, ...]:
    offered = {
        f"{each.name}.{name}": number for number, each in enumerate(model.effects) for name in each.drifting
    }
    wanted = list(offered) if parameters is None else parameters
    for each in wanted:
        if each not in offered:
            close = nearest(each, list(offered))
            hint = f"did you mean '{close}'?" if close else f"expected {', '.join(offered) or 'none'}"
            raise InputError(
                f"adaptation.parameters: '{each}' is not a parameter that wear or temperature changes in "
                f"this model; "
                f"{hint}"
            )
    terms: list[Term] = []
    end = 0
    for number in sorted({offered[each] for each in wanted}):
        effect = model.effects[number]
        begin, end = end, end + len(effect.coefficients())
        terms.append(Term(effect, number, slice(begin, end), not isinstance(effect.tracker(), Memoryless)))
    return tuple(terms)


def _unit(effect: Effect, number: int) -> Effect:
    """Returns the effect with one coefficient set to one and all others to zero."""
    unit = np.zeros_like(effect.coefficients())
    unit[number] = 1.0
    return effect.fitted(unit)


class Observation(NamedTuple):
    """Observation from part of a standstill or of a stretch of motion."""

    time_s: float
    """Time at the end of the observation."""
    error_arcsec: float
    """Observed transmission error less the committed model's, at the load."""
    row: FloatArray
    """Columns of `DriftModel`, shape (count,)."""
    speed_deg_s: float
    """Speed of the load target."""
    settled: bool
    """True in slow motion and at the beginning of a standstill; all others show only the zero."""
    travel_deg: float
    """Total travel of the motor since the last settled observation."""
    reversals: int
    """Reversals of the motor since the last settled observation."""


class _Reading(NamedTuple):
    time_s: float
    motor_deg: float
    speed_deg_s: float
    error_arcsec: float
    state: tuple[float, ...]


class Measuring:
    """Measures one axis; `take` must receive its samples in order."""

    def __init__(self, drift: DriftModel, slow_deg_s: float, channels: tuple[Channel, ...] = ()) -> None:
        """``channels`` are those of the axis file, in the order of the samples' readings."""
        self._drift = drift
        self._ratio = drift.model.ratio
        self._slow_deg_s = slow_deg_s
        self._channels = channels
        self._needs_moments = any(each.needs() for each in drift.model.effects)
        self.restart()

    def restart(self) -> None:
        """Restarts the path with an unknown hysteresis state, after power-off or lost samples."""
        self._columns = DriftColumns(self._drift)
        self._observer = Observer()
        self._last: float | None = None
        self._collected: list[_Reading] = []
        self._steady_since_s = math.inf
        """Time since which the command has been at rest, slow in one direction, or at constant speed."""
        self._standstill_used = True
        """True once this standstill has been used."""
        self._standing = self._slow = True
        self._longest_s = LONGEST_S
        self._speed_deg_s = 0.0
        self._turn_deg = 0.0
        self._sense = 0
        self._travel_deg = 0.0
        self._cell_deg = 0.0
        self._reversals = 0

    @property
    def known(self) -> bool:
        """True if the hysteresis state no longer depends on the unknown past."""
        return self._columns.known

    def take(self, times_s: FloatArray, axis: NDArray[Any], usable: BoolArray) -> list[Observation]:
        """Takes samples of `AXIS_SAMPLE`, shape (n,); returns the observations that they complete.

        ``usable`` marks samples with a valid load reading; all others only advance the path.
        """
        found: list[Observation] = []
        columns = self._columns
        moment = Moment()
        samples = zip(
            times_s.tolist(),
            axis["motor_target_deg"].tolist(),
            axis["motor_position_deg"].tolist(),
            axis["load_position_deg"].tolist(),
            axis["velocity_deg_s"].tolist(),
            usable.tolist(),
            strict=True,
        )
        for number, (time_s, motor_deg, position_deg, load_deg, speed_deg_s, good) in enumerate(samples):
            if self._needs_moments:
                moment = self._moment(time_s, axis[number])
            ended = self._follow(time_s, motor_deg, moment, speed_deg_s)
            if ended is not None:
                found.append(ended)
            if not good:
                self._collected.clear()
                self._steady_since_s = time_s
                continue
            if time_s - self._steady_since_s < SETTLE_S or not columns.known:
                continue
            error = (load_deg - position_deg / self._ratio) * ARCSEC_PER_DEG
            self._collected.append(_Reading(time_s, position_deg, speed_deg_s, error, columns.state))
            if time_s - self._collected[0].time_s >= self._longest_s:
                found.append(self._observation())
        return found

    def _follow(
        self, time_s: float, motor_deg: float, moment: Moment, speed_deg_s: float
    ) -> Observation | None:
        """Advances the path to the next command; returns the observation that this completes."""
        last = self._last
        self._last = motor_deg
        if last is None:
            self._turn_deg, self._steady_since_s = motor_deg, time_s
            self._columns.advance(motor_deg, moment)
            return None
        step = motor_deg - last
        stands = speed_deg_s == 0.0 and step == 0.0
        slow = abs(speed_deg_s) <= self._slow_deg_s
        even = slow or abs(speed_deg_s - self._speed_deg_s) <= SPEED_TOLERANCE * abs(speed_deg_s)
        turned = self._count(motor_deg, step) if step else False
        ended = None
        if turned or not even or (stands, slow) != (self._standing, self._slow):
            ended = self._end_of_stretch()
            self._standing, self._slow, self._steady_since_s, self._standstill_used = (
                stands,
                slow,
                time_s,
                False,
            )
            self._longest_s = LONGEST_S if stands else math.inf if slow else FAST_S
        elif slow and self._cell_deg >= CELL_DEG:
            ended = self._end_of_stretch()
        self._speed_deg_s = speed_deg_s
        if not stands or self._needs_moments:
            self._columns.advance(motor_deg, moment)
        return ended

    def _count(self, motor_deg: float, step_deg: float) -> bool:
        """Counts travel and reversals; returns True if this step reverses the motion."""
        self._travel_deg += abs(step_deg)
        self._cell_deg += abs(step_deg)
        sense = 1 if step_deg > 0.0 else -1
        if sense == self._sense:
            if sense * (motor_deg - self._turn_deg) > 0.0:
                self._turn_deg = motor_deg
            return False
        if abs(motor_deg - self._turn_deg) < REVERSAL_DEG and self._sense:
            return False
        self._reversals += self._sense != 0
        self._sense, self._turn_deg = sense, motor_deg
        return True

    def _end_of_stretch(self) -> Observation | None:
        """Returns the collected samples as an observation if they are sufficient."""
        collected, self._cell_deg = self._collected, 0.0
        enough = len(collected) > 2 and (
            collected[-1].time_s - collected[0].time_s >= SHORTEST_S
            if self._standing or not self._slow
            else abs(collected[-1].motor_deg - collected[0].motor_deg) >= 0.5 * CELL_DEG
        )
        if enough:
            return self._observation()
        collected.clear()
        return None

    def _observation(self) -> Observation:
        used = self._collected[len(self._collected) // 2 :] if self._standing else self._collected
        motor = np.array([each.motor_deg for each in used])
        states = np.array([each.state for each in used])
        rows = self._columns.rows(motor, states)
        error = np.array([each.error_arcsec for each in used]) - states[:, 0]
        error -= rows[:, : self._drift.zero] @ self._drift.committed
        settled = self._slow and not self._standstill_used
        found = Observation(
            time_s=used[-1].time_s,
            error_arcsec=float(np.mean(error)),
            row=np.mean(rows, axis=0),
            speed_deg_s=used[-1].speed_deg_s,
            settled=settled,
            travel_deg=self._travel_deg,
            reversals=self._reversals,
        )
        self._collected = []
        if settled:
            self._travel_deg, self._reversals = 0.0, 0
        self._standstill_used = self._standing
        return found

    def _moment(self, time_s: float, sample: Any) -> Moment:
        given = {
            channel: float(sample[f"reading{place}"])
            for place, channel in enumerate(self._channels)
            if math.isfinite(sample[f"reading{place}"])
        }
        target_deg = float(sample["load_target_deg"])
        return self._observer.moment(
            self._ratio * target_deg, time_s, measured=readings(given), load_deg=target_deg
        )


def turns(observations: Sequence[Observation]) -> float:
    """Returns the motor turns during these observations."""
    return sum(each.travel_deg for each in observations) / DEG_PER_TURN


def reversals(observations: Sequence[Observation]) -> int:
    """Returns the reversals of the motor during these observations."""
    return sum(each.reversals for each in observations)
