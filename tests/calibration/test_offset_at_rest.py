"""Offset of the hysteresis, fitted to the rests of a stepping test."""

from itertools import pairwise

import numpy as np
import pytest

from hdbridge.axis.effects import Hysteresis, Motion, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.validation import at_rest
from hdbridge.control.bench import Run
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

RATIO, STEPS, SAMPLES = 50.0, 10, 20
ORDERS = Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=9.0, phase_deg=20.0),))


def model(offset_arcsec: float) -> TransmissionModel:
    loop = Hysteresis(offset_arcsec=offset_arcsec, width_deg=20.0, exponent=1.6)
    return TransmissionModel(RATIO, (ORDERS, loop))


def stepped(truth: TransmissionModel, zero_arcsec: float) -> Run[SteppingOutcome]:
    """Steps forward and back, each a move and a rest of `SAMPLES`, on an axis that is exactly ``truth``."""
    stops = 43.56 * np.array([-3, *range(STEPS + 1), *range(STEPS - 1, -1, -1)])
    motor_deg = np.concatenate(
        [[*np.linspace(*each, SAMPLES), *[each[1]] * SAMPLES] for each in pairwise(stops)]
    )
    error = truth.predict(Motion(motor_deg)) + zero_arcsec
    time_s = 0.004 * np.arange(len(motor_deg))
    load_deg = motor_deg / RATIO + error / 3600.0
    columns = {"time_s": time_s, "motor_position_deg": motor_deg, "load_position_deg": load_deg}
    ends = range(4 * SAMPLES - 1, len(motor_deg), 2 * SAMPLES)
    settles = tuple(Segment(kind="settle", start_s=time_s[at - 1], end_s=time_s[at]) for at in ends)
    stands = tuple(Standing(motor_deg[at] / RATIO, error[at], 0.1) for at in ends)
    return Run(Record(columns), settles, outcome=SteppingOutcome(stands[:STEPS], stands[STEPS:]))


@pytest.mark.parametrize("fitted", [41.2, 25.0, -10.0])
@pytest.mark.parametrize("truth", [40.0, -35.0])
def test_the_offset_is_that_of_the_rests(truth: float, fitted: float) -> None:
    orders, loop = at_rest(model(fitted), stepped(model(truth), zero_arcsec=7.0)).effects
    assert orders == ORDERS
    assert loop.offset_arcsec == pytest.approx(truth, abs=1e-6)
