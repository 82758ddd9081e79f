"""Load inertia and friction of an axis, by regression of the measured torque on the measured motion.

The equation of motion holds whatever servo supplies the torque (Swevers, Verdonck and De Schutter, IEEE
Control Systems 27, 2007):

    torque = motor inertia * motor acceleration + (load inertia * load acceleration - torque on load) / ratio
             + (Coulomb friction + rise * exp(-(speed / Stribeck speed)^2)) * sign(speed)
             + viscous friction * speed + constant

Angles and torque pass the same low-pass filter. The motor's inertia is only a nuisance, because below the
load's resonance both shafts accelerate alike. A fit starts at the other values. On nine axes whose servos the
simulated drive does not have, the load inertia was 1 % low to 15 % high, and the Coulomb friction 1 % low to
8 % high.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from hdbridge.analysis.linear import counted, sandwich, solve_symmetric
from hdbridge.axis.effects import FloatArray
from hdbridge.twin.misfit import Data, Mask, Piece, motor_deg
from hdbridge.twin.parameters import LOAD, STRIBECK_RAD_S, TORQUE
from hdbridge.units import ARCSEC_PER_DEG

FILTER_S: Final = 0.006
"""Standard deviation of the low-pass filter, at least one cycle. Its bandwidth is 25 Hz, above which an
encoder of 8,000 counts shows no acceleration of the motor."""
REACH: Final = 3.0
"""Length of the filter to either side, in standard deviations."""
SLOWEST_RAD_S: Final = 0.3
"""Minimum motor speed over the length of the filter; below it, a sticking motor may carry any torque."""
SHOWN: Final = 2.0
"""Minimum value that the motion shows, in standard errors."""
NAMES: Final = "load inertia", "Coulomb friction", "viscous friction"


def measured_mechanics(data: Data) -> dict[str, float]:
    """Returns load inertia and friction by parameter name, without those that the motion does not show.

    The standard errors are those of independent legs. Held-out legs are not used.
    """
    parts = [_regressors(each, data) for each in data.pieces]
    used = np.concatenate([moving for _, moving in parts])
    if not used.any():
        return {}
    rows = np.concatenate([table for table, _ in parts])[used]
    torque_nm, columns = rows[:, 0], rows[:, 1:]
    inverse = solve_symmetric(columns.T @ columns, np.eye(columns.shape[1]))
    found = inverse @ (columns.T @ torque_nm)
    left_nm = torque_nm - columns @ found
    scatter = sandwich(left_nm[:, np.newaxis] * columns, counted(data.leg[used]))
    error = np.sqrt(np.diag(inverse @ scatter @ inverse))
    each = zip(NAMES, found.tolist(), error.tolist(), strict=False)
    return {name: value for name, value, off in each if value > SHOWN * off}


def _regressors(piece: Piece, data: Data) -> tuple[FloatArray, Mask]:
    """Returns the terms of the equation of motion as columns, shape (n, 7): the torque, those of `NAMES`, and
    the others; and the mask of the rows in steady motion.
    """
    commands, ratio = piece.commands, data.axis.gear.ratio
    step_s = commands.cycle_s
    width = max(FILTER_S / step_s, 1.0)
    motor = np.radians(motor_deg(piece, data.axis))
    torque_nm = piece.measured[TORQUE]
    if commands.torque_on_load_nm is not None:
        outer_nm = commands.torque_on_load_nm[commands.lead :]
        outer_nm = np.interp(commands.row_cycles, np.arange(len(outer_nm)), outer_nm)
        torque_nm = torque_nm + data.base.load_.torque_sense * outer_nm / ratio
    speed = np.gradient(_filtered(motor, width), step_s)
    way, near = np.sign(speed), speed / STRIBECK_RAD_S
    table = np.stack(
        [
            _filtered(torque_nm, width),
            _acceleration(np.radians(piece.measured[LOAD] / ARCSEC_PER_DEG), width, step_s) / ratio,
            way,
            speed,
            _acceleration(motor, width, step_s),
            np.ones_like(speed),
            way * np.exp(-(near**2)),
        ],
        axis=1,
    )
    length = 2 * math.ceil(REACH * width) + 1
    used = (piece.counts[TORQUE] & ~piece.out).astype(np.uint8)
    moving = minimum_filter1d(speed, length) > SLOWEST_RAD_S
    moving |= maximum_filter1d(speed, length) < -SLOWEST_RAD_S
    return table, moving & (minimum_filter1d(used, length, mode="constant") > 0)


def _filtered(column: FloatArray, width: float) -> FloatArray:
    return np.asarray(gaussian_filter1d(column, width, mode="nearest"), dtype=np.float64)


def _acceleration(angle: FloatArray, width: float, step_s: float) -> FloatArray:
    return np.convolve(_filtered(angle, width), [1.0, -2.0, 1.0], mode="same") / step_s**2
