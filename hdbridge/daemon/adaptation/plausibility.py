"""Whether a window of observations can be wear or temperature.

Both are slow. What is sudden, and what does not hold together, is neither. Whether the load encoder itself is
well (frozen, noisy, jumping) is judged sample by sample in `hdbridge.daemon.watch.encoder_health`; here only
what the estimate lets one ask. A shift that is common to all observations, or a zero that moves faster than
it may, does not pass by itself: the zero has to be taken again (`Doubt.lasting`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.daemon.adaptation.measuring import Observation
from hdbridge.effects import FloatArray

GATE_SIGMAS = 6.0
NOISIER = 4.0
"""Times by which the scatter of stands must have grown to be noise that was not there before."""
SLOWLY = 0.02
"""Share by which a window changes what is usual."""
TREND_FREE = 4
"""Observations that a trend within a window needs beyond its unknowns."""
ZEROS_KEPT = 256
DRIFT_S = 120.0
"""Time over which a drift of the zero is looked for ..."""
DRIFT_WINDOWS = 6
"""... and windows that it takes."""
SURE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why nothing is learnt."""

    reason: str
    """In words, with figures."""
    lasting: bool
    """True where it does not pass by itself: the zero has to be taken again."""


class Plausibility:
    """The judge of one axis."""

    def __init__(self, zero_rate_arcsec_per_hour: float, quiet_arcsec: float) -> None:
        """The rate that no zero exceeds; the scatter that every stand may have (a count of the encoder)."""
        self._zero_rate_arcsec_s = zero_rate_arcsec_per_hour / 3600.0
        self._quiet_arcsec = quiet_arcsec
        self._usual_arcsec: float | None = None
        """Scatter of a stand, as it has been."""
        self._zeros: deque[tuple[float, float]] = deque(maxlen=ZEROS_KEPT)

    def restart(self) -> None:
        """The zero may be another one."""
        self._zeros.clear()

    def judge(
        self,
        window: Sequence[Observation],
        residual_arcsec: FloatArray,
        sigma_arcsec: FloatArray,
        others: FloatArray,
    ) -> Doubt | None:
        """None where a window is plausible.

        ``residual_arcsec`` is what the present estimate leaves of each observation, ``sigma_arcsec`` what it
        may leave (one standard deviation), both of shape (n,); ``others`` (n, m) are the columns of what a
        drift must not be taken for: the zero, the loop, the load encoder's disc.
        """
        return (
            self._noise(window)
            or self._shift(residual_arcsec, GATE_SIGMAS * sigma_arcsec)
            or self._trend(window, residual_arcsec, others)
        )

    def follow(self, window: Sequence[Observation], zero_arcsec: float) -> Doubt | None:
        """A window was plausible, and its own zero is this: what the last ones together say."""
        scatter = _scatter_arcsec(window)
        if scatter is not None:
            usual = self._usual_arcsec
            self._usual_arcsec = scatter if usual is None else usual + SLOWLY * (scatter - usual)
        now_s = window[-1].time_s
        self._zeros.append((now_s, zero_arcsec))
        while self._zeros[0][0] < now_s - DRIFT_S:
            self._zeros.popleft()
        if len(self._zeros) < DRIFT_WINDOWS:
            return None
        time_s, zero = np.array(self._zeros).T
        return self._run_away(*_slope(time_s, zero, np.ones((len(zero), 1))), SURE_SIGMAS, lasting=True)

    def _noise(self, window: Sequence[Observation]) -> Doubt | None:
        found, usual = _scatter_arcsec(window), self._usual_arcsec
        if found is None or usual is None or found <= NOISIER * max(usual, self._quiet_arcsec):
            return None
        return Doubt(
            f"at rest the load encoder scatters by {found:.1f} arcsec, usually by {usual:.1f}: noise",
            lasting=False,
        )

    @staticmethod
    def _shift(residual_arcsec: FloatArray, gate_arcsec: FloatArray) -> Doubt | None:
        if np.all(np.abs(residual_arcsec) <= gate_arcsec):
            return None
        shift = float(np.median(residual_arcsec))
        if abs(shift) > float(np.median(gate_arcsec)) and np.all(
            np.abs(residual_arcsec - shift) <= gate_arcsec
        ):
            return Doubt(
                f"the load encoder reads {shift:+.1f} arcsec off all at once, alike in both directions: "
                "a scale or coupling that slipped, or a lost zero",
                lasting=True,
            )
        worst = float(np.max(np.abs(residual_arcsec)))
        return Doubt(
            f"the load is read up to {worst:.1f} arcsec off what the model and its rates allow, not alike "
            "at all places",
            lasting=False,
        )

    def _trend(
        self, window: Sequence[Observation], residual_arcsec: FloatArray, others: FloatArray
    ) -> Doubt | None:
        """A fast drift within one window; it is over when it is over."""
        if len(window) < others.shape[1] + 1 + TREND_FREE:
            return None
        time_s = np.array([each.time_s for each in window])
        slope = _slope(time_s, residual_arcsec, others)
        return self._run_away(*slope, GATE_SIGMAS, lasting=False)

    def _run_away(
        self, slope_arcsec_s: float, error_arcsec_s: float, sigmas: float, *, lasting: bool
    ) -> Doubt | None:
        if abs(slope_arcsec_s) - sigmas * error_arcsec_s <= self._zero_rate_arcsec_s:
            return None
        return Doubt(
            f"the zero moves by {3600.0 * slope_arcsec_s:+.0f} arcsec per hour, faster than wear and "
            f"temperature may ({3600.0 * self._zero_rate_arcsec_s:.0f}): the load encoder slips or drifts",
            lasting=lasting,
        )


def _scatter_arcsec(window: Sequence[Observation]) -> float | None:
    """Median scatter of a window's stands."""
    stands = [each.scatter_arcsec for each in window if not math.isnan(each.scatter_arcsec)]
    return float(np.median(stands)) if stands else None


def _slope(time_s: FloatArray, values: FloatArray, others: FloatArray) -> tuple[float, float]:
    """Slope of values (n,) by time with other columns (n, m) fitted in addition, and its standard error."""
    columns = np.column_stack([time_s - np.mean(time_s), others])
    found, _, rank, _ = np.linalg.lstsq(columns, values, rcond=None)
    free = len(values) - rank
    left = values - columns @ found
    own = columns[:, 0] - others @ np.linalg.lstsq(others, columns[:, 0], rcond=None)[0]
    spread = float(own @ own)
    if free < 1 or spread <= 0.0:
        return 0.0, math.inf
    return float(found[0]), math.sqrt(float(left @ left) / free / spread)
