"""Measured response: fall-back for drives whose loops differ in structure from the simulated servo.

The residuals of following error and torque with the best servo are fitted by finite impulse responses to the
speed and the direction of the command (`hdbridge.sim.response`), by ridge regressions. The simulated motor
follows a change of the demand in the same way as the command, so the response of the demand is fitted to the
simulated motor's speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hdbridge.axis.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.motor import TrueResponse
from hdbridge.twin.fit import MAX_MISFIT_RATIO, Fitted
from hdbridge.twin.misfit import Data, Piece, Replays, misfit, motor_deg
from hdbridge.twin.parameters import FOLLOWING, TORQUE
from hdbridge.units import rounded

SPEED_S: Final = 0.4
"""Length of the responses to the speed. A load that rings at 15 Hz with a damping ratio of 0.06 decays to a
tenth."""
DIRECTION_S: Final = 0.12
"""Length of the torque's response to the direction of motion: three periods of a velocity loop at 25 Hz."""
RIDGES: Final = (1e-1, 1e-2, 1e-3, 1e-4)
"""Ridge weights of the squared taps, as fractions of each tap's information in the rows; held-out legs decide
between them."""
ROUNDS: Final = 2
"""Number of fits of the demand's response; the second corrects for friction."""


def with_response(replays: Replays, fitted: Fitted) -> Fitted:
    """Returns the fit with measured responses if they explain held-out legs better.

    A response of the demand also changes the torque, so it is kept only if both channels together improve.
    """
    best = fitted
    for demanded, ridge in product((0, ROUNDS), RIDGES):
        truth, found = fitted.truth, fitted.residuals
        for channel in (*[FOLLOWING] * demanded, TORQUE):
            truth = _added(truth, replays.data, found, ridge, channel)
            (found,) = replays([truth])
        if misfit(replays.data, found) < MAX_MISFIT_RATIO * misfit(replays.data, best.residuals):
            best = replace(fitted, truth=truth, residuals=found)
    return best


def _added(truth: Truth, data: Data, found: dict[str, FloatArray], ridge: float, channel: str) -> Truth:
    """Returns the truth with the response that explains most of a channel's residuals."""
    cycle_s = data.pieces[0].commands.cycle_s
    lengths = [math.ceil(SPEED_S / cycle_s), math.ceil(DIRECTION_S / cycle_s)]
    tables, wanted = [], []
    for piece, part in zip(data.pieces, data.parts, strict=True):
        rows = piece.counts[channel] & ~piece.out
        if channel == FOLLOWING:
            simulated_deg = motor_deg(piece, data.axis) + found[channel][part]
            speed = np.gradient(np.radians(simulated_deg), piece.commands.time_s)
            tables.append(_lagged(speed, lengths[0])[rows])
            wanted.append(-np.radians(found[channel][part][rows]))
        else:
            speed = _command_speed(piece, data)
            at = piece.commands.lead + np.round(piece.commands.row_cycles).astype(np.intp)
            table = [_lagged(speed, lengths[0]), _lagged(np.sign(speed), lengths[1])]
            tables.append(np.concatenate(table, axis=1)[at][rows])
            wanted.append(found[channel][part][rows])
    taps = _ridge(np.concatenate(tables), np.concatenate(wanted), ridge)
    own = truth.servo.response or TrueResponse(cycle_ms=1e3 * cycle_s)
    if channel == FOLLOWING:
        own = own.model_copy(update={"demand_ms": _rounded(_grown(own.demand_ms, 1e3 * taps))})
    else:
        own = own.model_copy(
            update={
                "torque_nm_s_per_rad": _rounded(_grown(own.torque_nm_s_per_rad, taps[: lengths[0]])),
                "torque_nm": _rounded(_grown(own.torque_nm, taps[lengths[0] :])),
            }
        )
    return truth.model_copy(update={"servo": truth.servo.model_copy(update={"response": own})})


def _command_speed(piece: Piece, data: Data) -> FloatArray:
    """Returns the speed of the demand in each cycle, including the approach; motor rad/s."""
    encoder = data.axis.motor_encoder
    turned = math.tau * encoder.direction / encoder.counts_per_turn * np.asarray(piece.commands.counts)
    return np.asarray(np.diff(turned, prepend=turned[0]) / piece.commands.cycle_s, dtype=np.float64)


def _lagged(column: FloatArray, length: int) -> FloatArray:
    """Returns a column and its past as columns, latest first, shape (n, length)."""
    return sliding_window_view(np.concatenate([np.zeros(length - 1), column]), length)[:, ::-1]


def _ridge(table: FloatArray, wanted: FloatArray, ridge: float) -> FloatArray:
    size = np.sqrt(np.mean(np.square(table), axis=0)) + 1e-12
    scaled = table / size
    gram = scaled.T @ scaled + ridge * len(table) * np.eye(len(size))
    return np.asarray(np.linalg.solve(gram, scaled.T @ wanted) / size, dtype=np.float64)


def _grown(before: Sequence[float], taps: FloatArray) -> FloatArray:
    """Returns the sum of the taps so far and the new taps."""
    return np.append(before, np.zeros(len(taps)))[: len(taps)] + taps


def _rounded(taps: FloatArray) -> tuple[float, ...]:
    return tuple(rounded(float(each)) for each in taps)
