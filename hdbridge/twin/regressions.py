"""Where a fit starts: what can be read off the recordings without any replay, by linear regressions.

While the motor follows its command, torque is inertia times acceleration, Coulomb friction by the sign of
the speed and viscous friction by the speed; and the following error at a constant speed is that speed times
the age of the demand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import Data, Piece
from hdbridge.twin.parameters import FOLLOWING, TORQUE, with_values

SMOOTHED_S = 0.06
"""All that is compared is averaged over so long: a command in whole counts has no acceleration of its own."""
MOVING_DEG_S = 5.0
"""Motor speed above which the direction of friction is beyond doubt."""
LEAST_SHARE = 0.03
"""A coefficient that is known no better than this, relatively, is not used."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What the regressions give; None where the motion does not show it."""

    lag_s: float | None
    """Age of the demand: following error by speed."""
    inertia_kg_m2: float | None
    """Of motor and load, at the motor."""
    coulomb_nm: float | None
    viscous_nm_s_per_rad: float | None


def read_off(data: Data) -> Readings:
    """The regressions over all pieces."""
    speed, acceleration, following, torque = _columns(data)
    moving = np.abs(speed) > MOVING_DEG_S
    lag = _slope(following[moving], [speed[moving]])
    lag_s = lag[0] if lag else None
    inertia = coulomb = viscous = None
    rad = math.pi / 180.0
    if moving.sum() > 50:
        ones = [np.sign(speed[moving]), np.ones(int(moving.sum()))]
        found = _slope(
            torque[moving], [rad * acceleration[moving], ones[0], rad * speed[moving], ones[1]], LEAST_SHARE
        )
        if found:
            inertia, coulomb, viscous, _ = found
    return Readings(lag_s, inertia, coulomb, viscous)


def start_of(truth: Truth, data: Data) -> Truth:
    """The truth with what the regressions give in place of what it had."""
    found = read_off(data)
    values: dict[str, float] = {}
    ratio = truth.gear.ratio
    motor, load, servo = truth.motor, truth.load_, truth.servo
    inertia = motor.inertia_kg_m2
    if found.inertia_kg_m2 is not None and found.inertia_kg_m2 > 0.0:
        scale = found.inertia_kg_m2 / (inertia + load.whole_inertia_kg_m2 / ratio**2)
        values |= {"motor inertia": inertia * scale, "load inertia": load.inertia_kg_m2 * scale}
        # The spring with its damping keeps the frequency that the start had.
        values["gear stiffness"] = truth.gear.stiffness_nm_per_rad * scale
        values["gear damping"] = truth.gear.damping_nm_s_per_rad * scale
    if found.coulomb_nm is not None and found.coulomb_nm > 0.0:
        values["Coulomb friction"] = found.coulomb_nm
    if found.viscous_nm_s_per_rad is not None and found.viscous_nm_s_per_rad > 0.0:
        values["viscous friction"] = found.viscous_nm_s_per_rad
    if found.lag_s is not None:
        filtered_ms = 2.0 * servo.command_filter_ms
        dead_ms = 1e3 * found.lag_s - filtered_ms
        if dead_ms >= 0.0:
            values["servo dead time"] = dead_ms
        else:
            values |= {"servo dead time": 0.0, "command filter": max(500.0 * found.lag_s, 0.1)}
    return with_values(truth, values)


def _columns(data: Data) -> tuple[FloatArray, ...]:
    """Speed and acceleration of the command at the motor; following error and torque as measured."""
    rows: list[list[FloatArray]] = [[] for _ in range(4)]
    lag_s = 0.0
    for again in range(2):  # the second time the command is taken as late as the drive takes it
        rows = [[] for _ in range(4)]
        for piece in data.pieces:
            for column, values in zip(rows, _of_piece(piece, data, lag_s), strict=True):
                column.append(values)
        if not again:
            speed, following = np.concatenate(rows[0]), np.concatenate(rows[2])
            moving = np.abs(speed) > MOVING_DEG_S
            lag = _slope(following[moving], [speed[moving]])
            lag_s = min(max(lag[0] or 0.0, 0.0), 0.1) if lag else 0.0
    return tuple(np.concatenate(each) for each in rows)


def _of_piece(piece: Piece, data: Data, lag_s: float) -> list[FloatArray]:
    commands, axis = piece.commands, data.axis
    cycle_s = commands.cycle_s
    counts = np.asarray(commands.counts[commands.lead :], dtype=np.float64)
    encoder = axis.motor_encoder
    demand = encoder.direction * counts * 360.0 / encoder.counts_per_turn
    place = np.clip(commands.row_cycles - lag_s / cycle_s, 0.0, len(demand) - 1.0)
    late = np.interp(place, np.arange(len(demand)), demand)
    # A linear law holds between signals that went through the same filter.
    width = max(3, round(SMOOTHED_S / cycle_s))
    late, following, torque = (
        _smoothed(each, width) for each in (late, piece.measured[FOLLOWING], piece.measured[TORQUE])
    )
    speed = np.gradient(late, cycle_s)
    acceleration = np.gradient(speed, cycle_s)
    return [speed, acceleration, following, torque]


def _smoothed(column: FloatArray, width: int) -> FloatArray:
    """Under a Hann window; the ends are held."""
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    left, right = (width - 1) // 2, width // 2
    return np.convolve(np.pad(column, (left, right), mode="edge"), window, mode="valid")


def _slope(
    wanted: FloatArray, columns: list[FloatArray], least_share: float = math.inf
) -> list[float | None] | None:
    """Least squares; a coefficient is None where its own standard error is more than a share of it."""
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
