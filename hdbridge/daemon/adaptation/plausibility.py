"""Plausibility: tests if wear or temperature can explain a window of observations.

Both are slow, so sudden or inconsistent changes have another cause. The health of the load encoder itself
(frozen, noisy, jumping) is judged per sample in `hdbridge.daemon.watch.encoder_health`; the tests here need
the estimate. A shift common to all observations, or a zero that moves too fast, does not end automatically:
the zero must be taken again (`Doubt.lasting`).
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
"""Ratio of the scatter of standstills to its usual value above which it is noise."""
SLOWLY = 0.02
"""Weight of one window in the usual scatter."""
TREND_FREE = 4
"""Degrees of freedom required to fit a trend in a window."""
ZEROS_KEPT = 256
DRIFT_S = 120.0
"""Time span in which a drift of the zero is searched."""
DRIFT_WINDOWS = 6
"""Minimum number of windows to detect a drift."""
SURE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Doubt:
    """Reason why nothing is learned."""

    reason: str
    """The reason in words, with figures."""
    lasting: bool
    """True if it does not end automatically: the zero must be taken again."""


class Plausibility:
    """Judges the windows of one axis."""

    def __init__(self, zero_rate_arcsec_per_hour: float, quiet_arcsec: float) -> None:
        """Takes the fastest drift of a zero, and the scatter that is always permitted (one count)."""
        self._zero_rate_arcsec_s = zero_rate_arcsec_per_hour / 3600.0
        self._quiet_arcsec = quiet_arcsec
        self._usual_arcsec: float | None = None
        """Usual scatter of a standstill."""
        self._zeros: deque[tuple[float, float]] = deque(maxlen=ZEROS_KEPT)

    def restart(self) -> None:
        """Forgets the zeros of earlier windows."""
        self._zeros.clear()

    def judge(
        self,
        window: Sequence[Observation],
        residual_arcsec: FloatArray,
        sigma_arcsec: FloatArray,
        others: FloatArray,
    ) -> Doubt | None:
        """Returns a doubt, or None for a plausible window.

        ``residual_arcsec`` are the residuals by the present estimate, ``sigma_arcsec`` their permitted
        standard deviations, both of shape (n,). ``others`` (n, m) are columns that may not be mistaken for a
        drift: the zero, the loop, the load encoder's disc.
        """
        return (
            self._noise(window)
            or self._shift(residual_arcsec, GATE_SIGMAS * sigma_arcsec)
            or self._trend(window, residual_arcsec, others)
        )

    def follow(self, window: Sequence[Observation], zero_arcsec: float) -> Doubt | None:
        """Takes the zero of a plausible window; returns a doubt if the last zeros together drift too fast."""
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
        """Tests for a fast drift within one window, which passes with it."""
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
    """Returns the median scatter of a window's standstills; None without any."""
    stands = [each.scatter_arcsec for each in window if not math.isnan(each.scatter_arcsec)]
    return float(np.median(stands)) if stands else None


def _slope(time_s: FloatArray, values: FloatArray, others: FloatArray) -> tuple[float, float]:
    """Returns the slope of values (n,), fitted with other columns (n, m), and its standard error."""
    columns = np.column_stack([time_s - np.mean(time_s), others])
    found, _, rank, _ = np.linalg.lstsq(columns, values, rcond=None)
    free = len(values) - rank
    left = values - columns @ found
    own = columns[:, 0] - others @ np.linalg.lstsq(others, columns[:, 0], rcond=None)[0]
    spread = float(own @ own)
    if free < 1 or spread <= 0.0:
        return 0.0, math.inf
    return float(found[0]), math.sqrt(float(left @ left) / free / spread)
