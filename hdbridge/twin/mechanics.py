"""Load inertia, friction and spring of an axis, by regressions that hold whatever servo supplies the torque.

The first regression is the equation of motion (Swevers, Verdonck and De Schutter, IEEE Control Systems 27,
2007), the second the balance of the load:

    torque = motor inertia * motor acceleration + (load inertia * load acceleration - torque on load) / ratio
             + (Coulomb friction + rise * exp(-(speed / Stribeck speed)^2)) * sign(speed)
             + viscous friction * speed + constant
    twist  = (load inertia * load acceleration - torque on load) / stiffness
             - damping / stiffness * rate of twist + loss * sign(speed) + constant

The twist is the difference between the gear's unloaded output, computed from the motor angle with the known
transmission error, and the load angle. All signals pass the same low-pass filter. The motor's inertia is only
a nuisance, because below the load's resonance both shafts accelerate alike.

On 22 axes, nine of them with servos that the simulated drive does not have, load inertia and stiffness were
0.92 to 1.22 of the true ones if their standard errors were at most 10 %, as on all but one. Two recordings of
one motion compare better, because these errors are the same in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from hdbridge.analysis.linear import counted, sandwich, solve_symmetric
from hdbridge.axis.effects import FloatArray
from hdbridge.sim.gear import Gear
from hdbridge.sim.state import Conditions
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import rms
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
INERTIA, COULOMB, VISCOUS = "load inertia", "Coulomb friction", "viscous friction"
STIFFNESS, DAMPING = "gear stiffness", "gear damping"
HELD: Final = (INERTIA, STIFFNESS)
"""Parameters that are held while a servo structure is sought."""
COMPARED: Final = (INERTIA, COULOMB, STIFFNESS)
"""Parameters whose changes the regressions show."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated value with its standard error."""

    value: float
    error: float

    @property
    def relative(self) -> float:
        """Standard error as a fraction of the value."""
        return self.error / self.value


def measured_mechanics(data: Data, speed_rad_s: float = 0.0) -> dict[str, Estimate]:
    """Returns load inertia, friction, stiffness and damping by parameter name, without those that the motion
    does not show.

    The Coulomb friction is the friction at the motor's ``speed_rad_s``, without its rise. The standard errors
    are those of independent legs. Held-out legs are not used.
    """
    signals = [_signals(each, data) for each in data.pieces]
    moving = np.concatenate([each.moving for each in signals])
    if not moving.any():
        return {}
    torque = np.concatenate([each.torque for each in signals])[moving]
    twist = np.concatenate([each.twist for each in signals])[moving]
    legs = counted(data.leg[moving])
    torque[:, 3] -= speed_rad_s * torque[:, 2]
    inertia, coulomb, viscous, *_ = _regression(torque, legs)
    found = {INERTIA: inertia, COULOMB: coulomb, VISCOUS: viscous}
    if _shown(inertia):
        load_nm = inertia.value * twist[:, 1] - twist[:, 2]
        compliance, decay, _ = _regression(np.column_stack([twist[:, 0], load_nm, twist[:, 3:]]), legs)
        if _shown(compliance):
            relative = math.hypot(compliance.relative, inertia.relative)
            stiffness = 1.0 / compliance.value
            found[STIFFNESS] = Estimate(stiffness, stiffness * relative)
            found[DAMPING] = Estimate(stiffness * decay.value, stiffness * decay.error)
    return {name: each for name, each in found.items() if _shown(each)}


def rms_speed_rad_s(data: Data) -> float:
    """Returns the rms speed of the motor while the command moves."""
    speed = [
        np.gradient(np.radians(motor_deg(each, data.axis)), each.commands.time_s) for each in data.pieces
    ]
    return rms(np.concatenate(speed)[data.moving])


def _shown(each: Estimate) -> bool:
    return each.value > SHOWN * each.error


def _regression(rows: FloatArray, legs: NDArray[np.intp]) -> list[Estimate]:
    """Regresses the first column on the others; the standard errors are those of independent legs."""
    wanted, columns = rows[:, 0], rows[:, 1:]
    size = np.sqrt(np.mean(np.square(columns), axis=0)) + np.finfo(np.float64).tiny
    columns = columns / size
    inverse = solve_symmetric(columns.T @ columns, np.eye(columns.shape[1]))
    found = inverse @ (columns.T @ wanted)
    left = wanted - columns @ found
    scatter = sandwich(left[:, np.newaxis] * columns, legs)
    error = np.sqrt(np.diag(inverse @ scatter @ inverse))
    return [Estimate(*each) for each in zip((found / size).tolist(), (error / size).tolist(), strict=True)]


@dataclass(frozen=True, eq=False)
class _Signals:
    """Terms of both equations in one piece, as columns; the left-hand side comes first."""

    torque: FloatArray
    """Torque; load acceleration over the ratio, direction, speed, motor acceleration, one, rise; (n, 7)."""
    twist: FloatArray
    """Twist; load acceleration, torque on the load, minus the rate of twist, direction; (n, 5)."""
    moving: Mask
    """Mask of the rows in steady motion."""


def _signals(piece: Piece, data: Data) -> _Signals:
    commands, ratio = piece.commands, data.axis.gear.ratio
    step_s = commands.cycle_s
    width = max(FILTER_S / step_s, 1.0)
    motor, load = np.radians(motor_deg(piece, data.axis)), np.radians(piece.measured[LOAD] / ARCSEC_PER_DEG)
    outer_nm = np.zeros(len(motor))
    if commands.torque_on_load_nm is not None:
        outer_nm = commands.torque_on_load_nm[commands.lead :]
        outer_nm = np.interp(commands.row_cycles, np.arange(len(outer_nm)), outer_nm)
        outer_nm = _filtered(data.base.load_.torque_sense * outer_nm, width)
    speed = np.gradient(_filtered(motor, width), step_s)
    way, near = np.sign(speed), speed / STRIBECK_RAD_S
    acceleration = _acceleration(load, width, step_s)
    twist = _filtered(np.radians(_unloaded_deg(data.base, motor, load)) - load, width)
    torque = (
        _filtered(piece.measured[TORQUE], width) + outer_nm / ratio,
        acceleration / ratio,
        way,
        speed,
        _acceleration(motor, width, step_s),
        np.ones_like(speed),
        way * np.exp(-(near**2)),
    )
    terms = np.stack([twist, acceleration, outer_nm, -np.gradient(twist, step_s), way], axis=1)
    length = 2 * math.ceil(REACH * width) + 1
    used = (piece.counts[TORQUE] & ~piece.out).astype(np.uint8)
    moving = minimum_filter1d(speed, length) > SLOWEST_RAD_S
    moving |= maximum_filter1d(speed, length) < -SLOWEST_RAD_S
    moving &= minimum_filter1d(used, length, mode="constant") > 0
    if moving.any():
        terms -= np.mean(terms[moving], axis=0)  # the zeros of the angles differ between pieces
    return _Signals(np.stack(torque, axis=1), terms, moving)


def _unloaded_deg(truth: Truth, motor: FloatArray, load: FloatArray) -> list[float]:
    """Returns the angle to which the gear would turn an unloaded shaft, in each row; degrees."""
    gear, now = Gear(truth), Conditions(truth.temperature.ambient_c)
    found = []
    for now.motor_deg, now.load_deg in np.degrees(np.column_stack([motor, load])).tolist():
        found.append(gear.turned_deg(now))
    return found


def _filtered(column: FloatArray, width: float) -> FloatArray:
    return np.asarray(gaussian_filter1d(column, width, mode="nearest"), dtype=np.float64)


def _acceleration(angle: FloatArray, width: float, step_s: float) -> FloatArray:
    return np.convolve(_filtered(angle, width), [1.0, -2.0, 1.0], mode="same") / step_s**2
