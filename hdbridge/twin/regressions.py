"""Where a fit starts: what can be read off the recordings without any replay, by linear regressions.

The motor's torque is its own inertia times its acceleration, the load's by the ratio, Coulomb friction by the
sign of the speed and viscous friction by the speed, whatever the spring and the loops are. The load's part is
taken from its own encoder: near its resonance it does not do what the command says. The motor's part is
needed, but not used: a drive takes in a new demand in each cycle, so the motor accelerates in the first
milliseconds of a cycle, and its torque is told at the end. The following error at a constant speed is
that speed times the age of the demand. A torque that is the highest and stays there for rows on end may be
all that the drive has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import Data, Piece, demand_deg, rounding
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_values
from hdbridge.units import ARCSEC_PER_DEG

SMOOTHED_S = 0.03
"""All that is compared is averaged over so long: an angle in whole counts has no acceleration of its own."""
MOVING_DEG_S = 5.0
"""Motor speed above which the direction of friction is beyond doubt."""
HELD_ROWS = 3
"""A torque that only goes through its highest value is there for a row, or for two about it."""
LEAST_ROWS = 50
LEAST_SHARE = 0.15
"""A coefficient that is known no better than this, relatively, is not used: a fifth of what the prior leaves
open."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What the regressions give; None where the motion does not show it."""

    lag_s: float | None
    """Age of the demand: following error by speed."""
    load_inertia_kg_m2: float | None
    coulomb_nm: float | None
    viscous_nm_s_per_rad: float | None
    held_nm: float | None
    """The motor's highest torque, where it stays there while the motor moves."""


def read_off(data: Data) -> Readings:
    """The regressions over all pieces."""
    return Readings(_lag_s(data), *_mechanics(data), _held_nm(data))


def start_of(truth: Truth, data: Data) -> Truth:
    """The truth with what the regressions give in place of what it had."""
    found = read_off(data)
    values: dict[str, float] = {}
    load, servo = truth.load_, truth.servo
    if found.load_inertia_kg_m2 is not None:
        scale = found.load_inertia_kg_m2 / load.whole_inertia_kg_m2
        values["load inertia"] = load.inertia_kg_m2 * scale
        # The spring with its damping keeps the frequency that the start had.
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
    """Load inertia, Coulomb and viscous friction."""
    tables, torques = zip(*(_torques(piece, data) for piece in data.pieces), strict=True)
    table, torque = np.concatenate(tables), np.concatenate(torques)
    if not table[:, -1].any():
        table = table[:, :-1]
    if len(torque) <= LEAST_ROWS:
        return None, None, None
    columns = list(table.T)
    found = _slope(torque, columns, LEAST_SHARE)
    if found and (found[0] is None or found[0] <= 0.0):
        # No motor inertia to be seen: the load's goes without it.
        found = [None, *(_slope(torque, columns[1:], LEAST_SHARE) or [None] * 4)]
    load, coulomb, viscous = found[1:4] if found else (None, None, None)
    return _positive(load), _positive(coulomb), _positive(viscous)


def _torques(piece: Piece, data: Data) -> tuple[FloatArray, FloatArray]:
    """What the motor's torque is made of, shape (n, 5), and the torque, where it counts.

    Accelerations of motor and load, the latter as the motor feels it, direction and speed, and the weight, as
    large everywhere, of which nothing is known where nobody tells the torque on the load.
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
    # A linear law holds between signals that went through the same filter.
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
    """The highest torque where it is told in some rows on end; standing motors may be held by any."""
    told = [np.abs(piece.measured[TORQUE]) * (piece.counts[TORQUE] > 0.0) for piece in data.pieces]
    highest = max(float(np.max(each)) for each in told)
    for each in told:
        there = np.concatenate([[0.0], each > highest - 0.5 * rounding(data.axis)[TORQUE], [0.0]])
        first, end = np.flatnonzero(np.diff(there) > 0.0), np.flatnonzero(np.diff(there) < 0.0)
        if highest > 0.0 and np.any(end - first >= HELD_ROWS):
            return highest
    return None


def _lag_s(data: Data) -> float | None:
    """Following error by speed."""
    lag_s: float | None = None
    for _ in range(2):  # the second time the command is taken as late as the drive takes it
        late_s = min(max(lag_s or 0.0, 0.0), 0.1)
        rows = [_following(piece, data, late_s) for piece in data.pieces]
        speed, following = (np.concatenate(each) for each in zip(*rows, strict=True))
        moving = np.abs(speed) > MOVING_DEG_S
        lag = _slope(following[moving], [speed[moving]])
        lag_s = lag[0] if lag else None
    return lag_s


def _following(piece: Piece, data: Data, late_s: float) -> tuple[FloatArray, FloatArray]:
    """Speed of the command, so late, and following error."""
    commands = piece.commands
    demand = demand_deg(commands, data.axis)
    late = np.interp(commands.row_cycles - late_s / commands.cycle_s, commands.row_cycles, demand)
    width = _width(commands.cycle_s)
    return np.gradient(_smoothed(late, width), commands.cycle_s), _smoothed(piece.measured[FOLLOWING], width)


def _width(cycle_s: float) -> int:
    """Rows that are averaged."""
    return max(3, round(SMOOTHED_S / cycle_s))


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


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
