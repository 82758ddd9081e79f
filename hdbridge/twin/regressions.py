"""Start values of a fit: linear regressions on the recordings, without replays.

For any spring and loops, the motor's torque is the sum of its inertia times its acceleration, the load's
divided by the ratio, Coulomb friction times the sign of the speed, and viscous friction times the speed. The
load's acceleration comes from its own encoder, because it does not follow the command near its resonance. The
motor inertia is in the regression but not used: the motor accelerates in the first milliseconds after a new
demand, and the torque is recorded at the end of the cycle. The following error at constant speed is the speed
times the age of the demand. The highest torque, if held for several rows, may be the drive's limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.commands import MOVING_DEG_S
from hdbridge.twin.misfit import Data, Piece, demand_deg, rounding
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_values
from hdbridge.units import ARCSEC_PER_DEG

SMOOTHED_S = 0.03
"""Averaging time of all signals: without it, quantised angles give no usable acceleration."""
HELD_ROWS = 3
"""Minimum rows at the highest torque for a limit; a mere peak lasts one or two."""
LEAST_ROWS = 50
LEAST_SHARE = 0.15
"""Maximum relative standard error of a coefficient that is used: a fifth of the prior's width."""


@dataclass(frozen=True, slots=True)
class Readings:
    """Results of the regressions; None for values that the motion does not show."""

    lag_s: float | None
    """Age of the demand: following error over speed."""
    load_inertia_kg_m2: float | None
    coulomb_nm: float | None
    viscous_nm_s_per_rad: float | None
    held_nm: float | None
    """Highest motor torque, if it is held while the motor moves."""


def read_off(data: Data) -> Readings:
    """Runs the regressions over all pieces."""
    return Readings(_lag_s(data), *_mechanics(data), _held_nm(data))


def start_of(truth: Truth, data: Data) -> Truth:
    """Returns the truth with the values that the regressions give."""
    found = read_off(data)
    values: dict[str, float] = {}
    load, servo = truth.load_, truth.servo
    if found.load_inertia_kg_m2 is not None:
        scale = found.load_inertia_kg_m2 / load.whole_inertia_kg_m2
        values["load inertia"] = load.inertia_kg_m2 * scale
        # Spring and damping are scaled to keep the resonance frequency of the start.
        values["gear stiffness"] = truth.gear.stiffness_nm_per_rad * scale
        values["gear damping"] = truth.gear.damping_nm_s_per_rad * scale
    if found.coulomb_nm is not None:
        values["Coulomb friction"] = found.coulomb_nm
    if found.viscous_nm_s_per_rad is not None:
        values["viscous friction"] = found.viscous_nm_s_per_rad
    if found.held_nm is not None:
        held_percent = 100.0 * found.held_nm / truth.motor.rated_torque_nm
        if held_percent < min(servo.torque_limit_percent, data.axis.limits.torque_percent):
            values["current limit"] = held_percent
    if found.lag_s is not None:
        filtered_ms = 2.0 * servo.command_filter_ms
        dead_ms = 1e3 * found.lag_s - filtered_ms
        if dead_ms >= 0.0:
            values["servo dead time"] = dead_ms
        else:
            values |= {"servo dead time": 0.0, "command filter": max(500.0 * found.lag_s, 0.1)}
    return with_values(truth, values)


def _mechanics(data: Data) -> tuple[float | None, float | None, float | None]:
    """Returns load inertia, Coulomb friction and viscous friction."""
    tables, torques = zip(*(_torques(piece, data) for piece in data.pieces), strict=True)
    table, torque = np.concatenate(tables), np.concatenate(torques)
    if not table[:, -1].any():
        table = table[:, :-1]
    if len(torque) <= LEAST_ROWS:
        return None, None, None
    columns = list(table.T)
    found = _slope(torque, columns, LEAST_SHARE)
    if found and (found[0] is None or found[0] <= 0.0):
        # The motor inertia is not visible: estimate the load's without it.
        found = [None, *(_slope(torque, columns[1:], LEAST_SHARE) or [None] * 4)]
    load, coulomb, viscous = found[1:4] if found else (None, None, None)
    return _positive(load), _positive(coulomb), _positive(viscous)


def _torques(piece: Piece, data: Data) -> tuple[FloatArray, FloatArray]:
    """Returns the regressors of the motor's torque, shape (n, 5), and the torque, shape (n,).

    The regressors are the accelerations of motor and load (the latter seen by the motor), direction, speed,
    and a constant for the weight, which is unknown unless the torque on the load is recorded.
    """
    commands, truth = piece.commands, data.base
    cycle_s, ratio = commands.cycle_s, truth.gear.ratio
    width = _width(cycle_s)
    motor = np.radians(demand_deg(commands, data.axis) - piece.measured[FOLLOWING])
    load = np.radians(piece.measured[LOAD] / ARCSEC_PER_DEG)
    torque = piece.measured[TORQUE]
    weighs = np.ones(len(motor))
    if commands.told_nm is not None:
        weighs = np.zeros(len(motor))
        cycles = np.arange(len(commands.told_nm) - commands.lead)
        told = np.interp(commands.row_cycles, cycles, commands.told_nm[commands.lead :])
        torque = torque + truth.load_.torque_sense * told / ratio
    speed = _smoothed(np.gradient(motor, cycle_s), 3)
    direction = np.sign(speed) * (np.abs(speed) > math.radians(MOVING_DEG_S))
    # A linear law holds between signals that passed the same filter.
    accelerations = [
        np.gradient(np.gradient(_smoothed(each, width), cycle_s), cycle_s) for each in (motor, load)
    ]
    columns = [
        accelerations[0], accelerations[1] / ratio, _smoothed(direction, width), _smoothed(speed, width),
        weighs,
    ]  # fmt: skip
    counts = (piece.counts[TORQUE] > 0.0).astype(np.float64)
    counts[:width] = counts[-width:] = 0.0
    whole = _smoothed(counts, width + 2) > 1.0 - 1e-9
    return np.stack(columns, axis=1)[whole], _smoothed(torque, width)[whole]


def _held_nm(data: Data) -> float | None:
    """Returns the highest torque if it is held for `HELD_ROWS`; rows at standstill do not count."""
    told = [np.abs(piece.measured[TORQUE]) * (piece.counts[TORQUE] > 0.0) for piece in data.pieces]
    highest = max(float(np.max(each)) for each in told)
    for each in told:
        there = np.concatenate([[0.0], each > highest - 0.5 * rounding(data.axis)[TORQUE], [0.0]])
        first, end = np.flatnonzero(np.diff(there) > 0.0), np.flatnonzero(np.diff(there) < 0.0)
        if highest > 0.0 and np.any(end - first >= HELD_ROWS):
            return highest
    return None


def _lag_s(data: Data) -> float | None:
    """Returns the ratio of following error and speed."""
    lag_s: float | None = None
    for _ in range(2):  # the second time with the command delayed by the lag
        late_s = min(max(lag_s or 0.0, 0.0), 0.1)
        rows = [_following(piece, data, late_s) for piece in data.pieces]
        speed, following = (np.concatenate(each) for each in zip(*rows, strict=True))
        moving = np.abs(speed) > MOVING_DEG_S
        lag = _slope(following[moving], [speed[moving]])
        lag_s = lag[0] if lag else None
    return lag_s


def _following(piece: Piece, data: Data, late_s: float) -> tuple[FloatArray, FloatArray]:
    """Returns the speed of the command, delayed by ``late_s``, and the following error."""
    commands = piece.commands
    demand = demand_deg(commands, data.axis)
    late = np.interp(commands.row_cycles - late_s / commands.cycle_s, commands.row_cycles, demand)
    width = _width(commands.cycle_s)
    return np.gradient(_smoothed(late, width), commands.cycle_s), _smoothed(piece.measured[FOLLOWING], width)


def _width(cycle_s: float) -> int:
    """Returns the number of rows to average."""
    return max(3, round(SMOOTHED_S / cycle_s))


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _smoothed(column: FloatArray, width: int) -> FloatArray:
    """Smooths a column with a Hann window; the ends are held."""
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    left, right = (width - 1) // 2, width // 2
    return np.convolve(np.pad(column, (left, right), mode="edge"), window, mode="valid")


def _slope(
    wanted: FloatArray, columns: list[FloatArray], least_share: float = math.inf
) -> list[float | None] | None:
    """Fits coefficients by least squares; None for one whose relative standard error is too large."""
    if len(wanted) <= 2 * len(columns):
        return None
    table = np.stack(columns, axis=1)
    size = np.linalg.norm(table, axis=0)
    if not np.all(size > 0.0):
        return None
    scaled = table / size
    values, *_ = np.linalg.lstsq(scaled, wanted, rcond=None)
    left = wanted - scaled @ values
    spread = math.sqrt(float(left @ left) / (len(wanted) - len(columns)))
    covariance = np.linalg.pinv(scaled.T @ scaled)
    errors = spread * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = errors <= least_share * np.abs(values)
    return [float(value) if sure else None for value, sure in zip(values / size, known, strict=True)]
