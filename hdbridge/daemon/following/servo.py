"""Servo watch: does the servo still answer as the model's response in motion says?

Judges runs at constant speed, in which the correction moves the set-points, by the motor encoder's answer to
them. So neither a change of the gear nor a fault of the load encoder counts. Uses no clock.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.response import (
    DIFFERENT,
    Found,
    answers,
    difference_seen,
    lags_agree,
    motor_orders,
    samples_needed,
)
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.judging import CLEARLY
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleFlag
from hdbridge.units import DEG_PER_TURN

EVEN: Final = 1e-3
"""Largest relative deviation of a constant speed."""
TRANSIENT_S: Final = 0.6
"""Time at constant speed before a run begins."""
RUN_S: Final = 1.0
RUN_TURNS: Final = 2.0
"""Minimum duration and motor turns of a run."""
MIN_RUNS: Final = 4
MAX_RUNS: Final = 12
"""Number of runs that are judged together, for each frequency: one alone shows a few frequencies."""
NEEDED: Final = SampleFlag.FRESH | SampleFlag.COMPENSATING
SPOILT: Final = SampleFlag.CHANGING | SampleFlag.LIMITED


class ServoWatch:
    """Judgement of one axis's servo. A model without a response is never judged."""

    def __init__(self, axis: AxisConfig, model: TransmissionModel) -> None:
        self.retuned = False
        """True while the servo does not answer as when the response was measured."""
        self._response = model.response
        self._ratio, self._period_s = model.ratio, axis.drive.cycle_s
        orders = motor_orders(model)
        self._orders = tuple(each.order for each in orders)
        self._amplitudes = tuple(each.amplitude_arcsec for each in orders)
        self._run: list[NDArray[Any]] = []
        self._speed_deg_s = 0.0
        self._even = 0
        """Samples at this speed so far."""
        self._lags_ms: deque[float] = deque(maxlen=MAX_RUNS)
        self._seen: dict[tuple[int, int], deque[Found]] = {}
        """Responses relative to the stored one, by order and the nearest stored frequency."""

    def take(self, axis: NDArray[Any], *, joined: bool) -> str | None:
        """Takes the next samples of the axis; returns the evidence if the judgement changes.

        ``joined`` is False if cycles are missing before or between them.
        """
        if self._response is None or not self._orders or not len(axis):
            return None
        velocity, flags = axis["velocity_deg_s"], axis["flags"]
        speed = float(velocity[0])
        even = bool(speed and np.all(abs(velocity - speed) < EVEN * abs(speed)))
        even &= bool(np.all((flags & (NEEDED | SPOILT)) == NEEDED))
        even &= bool(np.all(axis["state"] == AxisState.ENABLED))
        if not (even and joined and abs(speed - self._speed_deg_s) < EVEN * abs(speed)):
            self._run, self._even = [], 0
            self._speed_deg_s = speed if even else 0.0
        if not even:
            return None
        self._even += len(axis)
        if self._even * self._period_s < TRANSIENT_S or abs(speed) < self._response.filter.full_speed_deg_s:
            return None
        self._run.append(axis)
        count = sum(map(len, self._run))
        duration_s = count * self._period_s
        turns = duration_s * abs(speed) * self._ratio / DEG_PER_TURN
        if duration_s < RUN_S or turns < RUN_TURNS or count < samples_needed(self._orders):
            return None
        run, self._run = np.concatenate(self._run), []
        return self._judge(run, speed)

    def _judge(self, run: NDArray[Any], speed_deg_s: float) -> str | None:
        """Adds a run; returns the evidence if the judgement changes."""
        stored = self._response
        assert stored is not None
        issued, motor = run["issued_deg"], run["motor_position_deg"]
        if not np.all(np.isfinite(issued)):
            return None
        lag_s = float(np.mean(issued - motor)) / (self._ratio * speed_deg_s)
        self._lags_ms.append(1000.0 * lag_s)
        for order, each in answers(
            stored, speed_deg_s, lag_s, run["load_target_deg"], issued, motor, self._orders, self._ratio
        ):
            nearest = int(np.argmin(np.abs(np.array(stored.frequency_hz) - each.frequency_hz)))
            self._seen.setdefault((order, nearest), deque(maxlen=MAX_RUNS)).append(each)
        if len(self._lags_ms) < MIN_RUNS:
            return None
        amplitudes = (self._amplitudes[order] for order, _ in self._seen)
        apart = difference_seen(stored, self._seen.values(), amplitudes)
        lag_ms = median(self._lags_ms)
        limit = CLEARLY * DIFFERENT if self.retuned else DIFFERENT
        retuned = apart > limit or not lags_agree(stored.following_lag_ms, lag_ms)
        if retuned == self.retuned:
            return None
        self.retuned = retuned
        return (
            f"following lag {lag_ms:.1f} ms, {stored.following_lag_ms:.1f} when the response was measured; "
            f"the response differs by {100.0 * apart:.0f} %"
        )
