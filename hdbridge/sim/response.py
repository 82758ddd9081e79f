"""Measured response of a drive in addition to its loops: finite impulse responses, so always stable.

The speed and direction of the command in the latest control cycles change the demand of the loops and the
reported torque. Both changes are zero once the command has been at rest for the length of the responses.
"""

from typing import Any

import numpy as np

from hdbridge.sim.truth.motor import TrueResponse

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


class Response:
    """State of the response: speed and direction of the command in the latest cycles."""

    demand_counts: float
    """Change of the demand at the end of the latest cycle; motor counts."""
    torque_nm: float
    """Change of the reported torque, Nm, positive forward."""

    def __init__(self, truth: TrueResponse, counts_per_rad: float) -> None:
        self._truth, self._counts_per_rad = truth, counts_per_rad
        self._cycle_s = 0.0
        self._taps = self._at(1e-3 * truth.cycle_ms)
        self.rest()

    def rest(self) -> None:
        """Clears the stored cycles, as after a long rest."""
        self._speed, self._direction = (np.zeros(len(each)) for each in self._taps[1:])
        self.demand_counts = self.torque_nm = 0.0

    def advance(self, start_counts: float, end_counts: float, cycle_s: float) -> None:
        """Adds the command of a cycle, which moves linearly from start to end."""
        if cycle_s != self._cycle_s:
            self._cycle_s, self._taps = cycle_s, self._at(cycle_s)
            self.rest()
        speed = (end_counts - start_counts) / self._counts_per_rad / cycle_s
        for past, now in ((self._speed, speed), (self._direction, float(np.sign(speed)))):
            past[1:] = past[:-1]
            past[:1] = now
        demand, torque, friction = self._taps
        self.demand_counts = self._counts_per_rad * float(demand @ self._speed[: len(demand)])
        self.torque_nm = float(torque @ self._speed + friction @ self._direction)

    def _at(self, cycle_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns the filter taps for this cycle time; both responses to speed have the same length."""
        length = max(len(self._truth.demand_ms), len(self._truth.torque_nm_s_per_rad), 1)
        demand, torque, friction = (
            self._regridded(taps, size, cycle_s)
            for taps, size in (
                ([1e-3 * each for each in self._truth.demand_ms], length),
                (self._truth.torque_nm_s_per_rad, length),
                (self._truth.torque_nm, max(len(self._truth.torque_nm), 1)),
            )
        )
        return demand, torque, friction

    def _regridded(self, taps: Any, size: int, cycle_s: float) -> FloatArray:
        own_s = 1e-3 * self._truth.cycle_ms
        padded = np.append(np.asarray(taps, dtype=np.float64), np.zeros(size - len(taps)))
        if cycle_s == own_s:
            return padded
        cumulated = np.append(0.0, np.cumsum(padded))
        edges = np.arange(int(np.ceil(size * own_s / cycle_s)) + 1) * cycle_s
        return np.diff(np.interp(edges, np.arange(size + 1) * own_s, cumulated))
