"""Servo watch: tests if the servo still responds as in the response measured for the model.

It judges runs at constant speed, in which the correction modulates the set-points, by the motor encoder.
Neither a change of the gear nor a fault of the load encoder therefore has an influence. The load encoder's
readings in these runs refine the response. Uses no clock.
"""

from statistics import median
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.response import DIFFERENT, Answers, Limits, lags_agree, motor_orders, samples_needed
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import Response
from hdbridge.daemon.following.judging import CLEAR_SHARE
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleFlag
from hdbridge.units import DEG_PER_TURN

SPEED_TOLERANCE: Final = 1e-3
"""Maximum relative deviation at which a speed counts as constant."""
TRANSIENT_S: Final = 0.6
"""Time at constant speed before a run begins."""
RUN_S: Final = 1.0
RUN_TURNS: Final = 2.0
"""Minimum duration and number of motor turns of a run."""
MIN_RUNS: Final = 4
NEEDED: Final = SampleFlag.FRESH | SampleFlag.COMPENSATING
EXCLUDED: Final = SampleFlag.CHANGING | SampleFlag.LIMITED


class ServoWatch:
    """Verdict on one axis's servo. A model without a response is never judged."""

    def __init__(self, axis: AxisConfig, model: TransmissionModel) -> None:
        self.retuned = False
        """True while the servo's response differs from the measured response."""
        self.refinements = 0
        """Number of successive responses that have replaced the committed one."""
        self._ratio, self._period_s = model.ratio, axis.drive.cycle_s
        self._orders = motor_orders(model)
        self._limits = Limits.of(axis, model)
        self._committed = model.response
        self._use(model.response)

    def _use(self, response: Response | None, earlier: Answers | None = None) -> None:
        self._response = response
        self._answers = None if response is None else Answers(response, self._orders, self._ratio, earlier)
        self._before_arcsec2: dict[tuple[int, int], float] = {}
        """Residual mean square of each order at each frequency with the committed response."""
        self._run: list[NDArray[Any]] = []
        self._speed_deg_s = 0.0
        self._samples_at_speed = 0
        """Number of samples at this speed so far."""

    def use(self, response: Response | None) -> None:
        """Switches to another response."""
        if response != self._response:
            before = self._before_arcsec2
            if self._answers is not None and self._response == self._committed:
                before, self.refinements = self._answers.left_arcsec2(), 0
            self.refinements += 1
            self._use(response, self._answers)
            self._before_arcsec2 = before

    def forget_load(self) -> None:
        """Discards the load encoder's results."""
        self._before_arcsec2 = {}
        if self._answers is not None:
            self._answers.forget_load()

    @property
    def worse(self) -> bool:
        """True if the response leaves more load error than the committed one, at common frequencies."""
        before = self._before_arcsec2
        if self._answers is None or self._response == self._committed:
            return False
        now = self._answers.left_arcsec2()
        both = before.keys() & now.keys()
        return sum(now[each] for each in both) > sum(before[each] for each in both)

    def refined(self, bound: float) -> Response | None:
        """Returns a response that leaves less load error than the current one; None if uncertain.

        ``bound`` limits the relative deviation from the committed response.
        """
        if self._answers is None or self._committed is None or len(self._answers.lags_ms) < MIN_RUNS:
            return None
        changed = self.retuned or self._response != self._committed
        return self._answers.refined(self._committed, self._limits, bound, retuned=changed)

    def take(self, axis: NDArray[Any], *, contiguous: bool, encoder_trusted: bool) -> str | None:
        """Processes the next samples of the axis; returns the evidence if the verdict changes.

        ``contiguous`` is False if cycles are missing before or within the samples, ``encoder_trusted``
        during a fault of the load encoder.
        """
        if self._answers is None or not self._orders or not len(axis):
            return None
        velocity, flags = axis["velocity_deg_s"], axis["flags"]
        speed = float(velocity[0])
        even = bool(speed and np.all(abs(velocity - speed) < SPEED_TOLERANCE * abs(speed)))
        even &= bool(np.all((flags & (NEEDED | EXCLUDED)) == NEEDED))
        even &= bool(np.all(axis["state"] == AxisState.ENABLED))
        if not (even and contiguous and abs(speed - self._speed_deg_s) < SPEED_TOLERANCE * abs(speed)):
            self._run, self._samples_at_speed = [], 0
            self._speed_deg_s = speed if even else 0.0
        if not even:
            return None
        self._samples_at_speed += len(axis)
        assert self._response is not None
        if (
            self._samples_at_speed * self._period_s < TRANSIENT_S
            or abs(speed) < self._response.filter.full_speed_deg_s
        ):
            return None
        self._run.append(axis)
        count = sum(map(len, self._run))
        duration_s = count * self._period_s
        turns = duration_s * abs(speed) * self._ratio / DEG_PER_TURN
        if duration_s < RUN_S or turns < RUN_TURNS or count < samples_needed(len(self._orders)):
            return None
        run, self._run = np.concatenate(self._run), []
        return self._judge(run, speed, encoder_trusted=encoder_trusted)

    def _judge(self, run: NDArray[Any], speed_deg_s: float, *, encoder_trusted: bool) -> str | None:
        """Adds a run; returns the evidence if the verdict changes."""
        stored, answers = self._response, self._answers
        assert stored is not None
        assert answers is not None
        if not np.all(np.isfinite(run["issued_deg"])):
            return None
        names = ("load_target_deg", "issued_deg", "motor_position_deg", "load_position_deg")
        target, issued, motor, load = (run[each] for each in names)
        if not encoder_trusted:
            self.forget_load()
            load = np.full(len(run), np.nan)
        answers.take(speed_deg_s, target, issued, motor, load, run["correction_arcsec"])
        if len(answers.lags_ms) < MIN_RUNS:
            return None
        difference, lag_ms = answers.difference, median(answers.lags_ms)
        limit = CLEAR_SHARE * DIFFERENT if self.retuned else DIFFERENT
        retuned = difference > limit or not lags_agree(stored.following_lag_ms, lag_ms)
        if retuned == self.retuned:
            return None
        self.retuned = retuned
        return (
            f"following lag {lag_ms:.1f} ms, {stored.following_lag_ms:.1f} when the response was measured; "
            f"the response differs by {100.0 * difference:.0f} %"
        )
