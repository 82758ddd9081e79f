"""Observations from samples: standstills and stretches of slow motion, each averaged.

Fast motion is not used, because wind-up, drag and the delay between the encoders would look like a change of
the hysteresis loop. A standstill counts with its second half, slow motion once per few degrees of the motor.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hdbridge.daemon.adaptation.regressors import Regressors
from hdbridge.effects import Channel, FloatArray, Moment, readings
from hdbridge.effects.kinematics import Observer
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

SETTLE_S = 0.05
"""Settling time of the load after a fast move, and after a reversal in a slow one."""
SHORTEST_S = 0.04
"""Minimum duration of a standstill, in addition to the settling time."""
LONGEST_S = 1.0
"""Maximum duration of a standstill; each gives at most one observation."""
CELL_DEG = 3.0
"""Motor travel of an observation in slow motion."""
REVERSAL_DEG = 0.3
"""Motor travel back that counts as a reversal."""


class Observation(NamedTuple):
    """Observation from one standstill or stretch of slow motion."""

    time_s: float
    """Time at its end."""
    error_arcsec: float
    """Observed transmission error less the committed model's, at the load."""
    row: FloatArray
    """Columns of `Regressors`, shape (count,)."""
    travel_deg: float
    """Total travel of the motor since the last observation."""
    reversals: int
    """Reversals of the motor since the last observation."""
    scatter_arcsec: float
    """Standard deviation of its samples; NaN in motion."""


class _Sample(NamedTuple):
    time_s: float
    motor_deg: float
    error_arcsec: float
    state: tuple[float, ...]


class Measuring:
    """Measures one axis; `take` gets its samples in order. Only this class knows their layout."""

    def __init__(self, regressors: Regressors, slow_deg_s: float, channels: tuple[Channel, ...] = ()) -> None:
        """``channels`` are those of the axis file, in the order of the samples' readings."""
        self._regressors = regressors
        self._ratio = regressors.model.ratio
        self._slow_deg_s = slow_deg_s
        self._channels = channels
        self.restart()

    def restart(self) -> None:
        """Restarts the path with an unknown hysteresis state, after power-off or lost samples."""
        self._regressors.restart()
        self._observer = Observer()
        self._last: float | None = None
        self._kept: list[_Sample] = []
        self._quiet_s = math.inf
        """Time since which the command stands, or is slow in one direction."""
        self._done = True
        """True once this standstill has been used."""
        self._standing = True
        self._turn_deg = 0.0
        self._sense = 0
        self._travel_deg = 0.0
        self._cell_deg = 0.0
        self._reversals = 0

    @property
    def known(self) -> bool:
        """True if the hysteresis state no longer depends on the unknown past."""
        return self._regressors.known()

    def take(self, times_s: FloatArray, axis: NDArray[Any], usable: NDArray[np.bool_]) -> list[Observation]:
        """Takes samples of `AXIS_SAMPLE`, shape (n,); returns the observations that they complete.

        ``usable`` marks samples whose load encoder is believed; the others only advance the path.
        """
        found: list[Observation] = []
        timeless = self._regressors.timeless
        moment = Moment()
        columns = zip(
            times_s.tolist(),
            axis["motor_target_deg"].tolist(),
            axis["motor_position_deg"].tolist(),
            axis["load_position_deg"].tolist(),
            axis["velocity_deg_s"].tolist(),
            usable.tolist(),
            strict=True,
        )
        for number, (time_s, motor_deg, position_deg, load_deg, speed_deg_s, good) in enumerate(columns):
            if not timeless:
                moment = self._moment(time_s, axis[number])
            ended = self._follow(time_s, motor_deg, moment, abs(speed_deg_s))
            if ended is not None:
                found.append(ended)
            if not good:
                self._kept.clear()
                self._quiet_s = time_s
                continue
            if self._done or time_s - self._quiet_s < SETTLE_S or not self._regressors.known():
                continue
            error = (load_deg - position_deg / self._ratio) * ARCSEC_PER_DEG
            self._kept.append(_Sample(time_s, motor_deg, error, self._regressors.state()))
            if self._standing and time_s - self._kept[0].time_s >= LONGEST_S:
                found.append(self._observation())
        return found

    def _follow(
        self, time_s: float, motor_deg: float, moment: Moment, speed_deg_s: float
    ) -> Observation | None:
        """Advances the path to the next command; returns the observation that this completes."""
        last = self._last
        self._last = motor_deg
        if last is None:
            self._turn_deg, self._quiet_s = motor_deg, time_s
            self._regressors.advance(motor_deg, moment)
            return None
        step = motor_deg - last
        stands = speed_deg_s == 0.0 and step == 0.0
        ended = None
        if stands != self._standing:
            ended = self._end_of_stretch()
            self._standing, self._quiet_s, self._done = stands, time_s, False
        if stands and self._regressors.timeless:
            return ended
        self._regressors.advance(motor_deg, moment)
        if step:
            turned = self._count(motor_deg, step)
            if turned or speed_deg_s > self._slow_deg_s:
                ended = ended or self._end_of_stretch()
                self._quiet_s = time_s
            elif not self._standing and self._cell_deg >= CELL_DEG:
                ended = ended or self._end_of_stretch()
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
        """Returns the collected samples as an observation, if there are enough."""
        kept, self._cell_deg = self._kept, 0.0
        enough = len(kept) > 2 and (
            kept[-1].time_s - kept[0].time_s >= SHORTEST_S
            if self._standing
            else abs(kept[-1].motor_deg - kept[0].motor_deg) >= 0.5 * CELL_DEG
        )
        if enough:
            return self._observation()
        kept.clear()
        return None

    def _observation(self) -> Observation:
        kept = self._kept[len(self._kept) // 2 :] if self._standing else self._kept
        motor = np.array([each.motor_deg for each in kept])
        states = np.array([each.state for each in kept])
        rows = self._regressors.rows(motor, states)
        followed = self._regressors.followed
        error = np.array([each.error_arcsec for each in kept]) - states[:, 0]
        error -= rows[:, :followed] @ self._regressors.committed
        found = Observation(
            time_s=kept[-1].time_s,
            error_arcsec=float(np.mean(error)),
            row=np.mean(rows, axis=0),
            travel_deg=self._travel_deg,
            reversals=self._reversals,
            scatter_arcsec=float(np.std(error)) if self._standing else math.nan,
        )
        self._kept = []
        self._travel_deg, self._reversals = 0.0, 0
        self._done = self._standing
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


def turns(observations: list[Observation]) -> float:
    """Returns the motor turns during these observations."""
    return sum(each.travel_deg for each in observations) / DEG_PER_TURN
