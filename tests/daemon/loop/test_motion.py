"""The filtered correction in the daemon's loop: moves, streams, re-targets and stops at speed."""

import math

import numpy as np
import pytest
from support.daemon import PROFILE, article_axes, stepped_daemon

from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.daemon.memory import CommandKind

AXIS = article_axes()[0]
SPEED_DEG_S = 18.0


def with_response(**limits) -> TransmissionModel:
    """A sharp filter: it overshoots where it is not looked after."""
    weights = (0.4, -0.8, 1.6, -0.6, 0.3, 0.1, 0.0)
    measured = Response(
        cycle_ms=AXIS.drive.cycle_ms,
        following_lag_ms=10.0,
        known_to_hz=60.0,
        frequency_hz=(5.0, 50.0),
        gain=(1.0, 1.5),
        phase_deg=(0.0, -20.0),
        uncertainty=(0.05, 0.05),
        filter=LeadFilter(lead_cycles=2, per_cycle=2, full_speed_deg_s=4.0, weights=weights),
    )
    model = TransmissionModel.load(PROFILE / "model.yaml")
    return TransmissionModel(model.ratio, model.effects, response=measured)


def corrections(daemon, cycles: int) -> list[float]:
    found = []
    for _ in range(cycles):
        daemon.turn()
        found.append(daemon.axes[0].follower.correction.correction_arcsec)
    return found


@pytest.mark.parametrize("end", [CommandKind.STOP, CommandKind.MOVE])
def test_stops_and_new_targets_cause_no_jump_and_end_at_the_static_correction(end):
    slew_arcsec = AXIS.compensation.slew_arcsec_s * AXIS.drive.cycle_s
    ends = []
    for model in (with_response(), TransmissionModel.load(PROFILE / "model.yaml")):
        with stepped_daemon(model=model) as daemon:
            daemon.verify()
            daemon.enable()
            daemon.run(0.6)
            daemon.post(CommandKind.MOVE, 0, a=100.0, b=SPEED_DEG_S, c=math.nan)
            moving = corrections(daemon, 200)
            daemon.post(end, 0, a=3.0, b=SPEED_DEG_S, c=math.nan)
            stopping = corrections(daemon, 600)
            steps = np.abs(np.diff([*moving, *stopping]))
            assert steps.max() <= slew_arcsec + 1e-9
            assert daemon.axes[0].set_point.at_rest
            ends.append(stopping[-1])
    assert ends[0] == ends[1]
