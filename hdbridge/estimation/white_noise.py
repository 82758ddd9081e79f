"""How large the noise is, from differences of neighbouring samples: never from the residual of a fit.

A noise model fitted to a residual takes an effect for noise. Third differences see nothing that is slow,
so an
effect of any size leaves them alone; they are taken apart for standing and moving, and quantisation is a
floor. What is slow (wander, drift) is met later by statistics over blocks of seconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray
from hdbridge.observations.reading import third_deviation


def noise_arcsec(
    error_arcsec: FloatArray,
    still: NDArray[np.bool_],
    motor_count_arcsec: float,
    load_count_arcsec: float,
    commanded: bool,
) -> FloatArray:
    """Standard deviation of the white noise of each sample, shape (n,)."""
    floor = load_count_arcsec / np.sqrt(12.0)
    if not commanded:
        floor = float(np.hypot(floor, motor_count_arcsec / np.sqrt(12.0)))
    third = np.diff(error_arcsec, 3)
    inner = still[1:-2]
    result = np.empty(len(error_arcsec))
    for rows, part in ((still, third[inner]), (~still, third[~inner])):
        size = third_deviation(part) if len(part) >= 20 else 0.0
        result[rows] = max(size, floor, 0.02)
    if np.any(still) and np.any(~still):  # in motion nothing is quieter than at rest
        result[~still] = max(float(result[~still][0]), 0.5 * float(result[still][0]))
    return result
