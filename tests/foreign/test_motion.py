"""The compensation in motion on drives that hdbridge does not simulate itself."""

import numpy as np
import pytest
from foreign.bench import foreign_bench
from foreign.servos import STRUCTURES

from hdbridge import Drive
from hdbridge.analysis.response import HIGHEST
from hdbridge.axis.effects import MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.motion import motion_test

# A third of the SYNC rate is reached by order 4 at these speeds, and later by the others.
SEEDS = {"pi_notch": 3, "piv": 3, "observed": 0, "state_feedback": 0}
QUICK = {"pi_notch"}
"""One structure in every run; `make test-slow` has them all."""


def static_model(truth) -> TransmissionModel:
    orders = tuple(MotorOrder(**each._asdict()) for each in truth.mechanics.motor_orders)
    return TransmissionModel(truth.mechanics.ratio, (Synchronous(orders=orders),))


@pytest.mark.parametrize(
    "structure",
    [each if each in QUICK else pytest.param(each, marks=pytest.mark.slow) for each in STRUCTURES],
)
def test_the_measured_response_removes_the_ripple_at_speed(structure, tmp_path):
    with foreign_bench(SEEDS[structure], structure, tmp_path) as bench:
        with Drive(bench.bus, bench.axis, bench.clock) as drive:
            drive.boot()
            result = motion_test(drive, static_model(bench.truth))
        ratio, cycle_s = bench.axis.gear.ratio, bench.axis.drive.cycle_s
    assert result.response is not None
    for each in result.ripples:
        assert each.filtered_arcsec < 1.05 * each.none_arcsec  # never worse than without correction
        if 4 * each.speed_deg_s * ratio / 360.0 < 0.8 * HIGHEST / cycle_s:
            assert each.removed_percent > 88.0, each
    paths = np.array(
        [[one.path_arcsec for one in (each.none, each.static, each.filtered)] for each in result.paths]
    )
    rms = np.sqrt(np.mean(paths**2, axis=0))
    assert rms[2] < 1.02 * rms[1]
    assert rms[2] < 1.02 * rms[0]  # the model has no hysteresis, which is most of this error
    for each in result.paths:  # the last path ends without a ramp
        assert each.filtered.settle_s <= each.none.settle_s + 0.02 or each.name == "sine", each
    fast = [each for each in result.ripples if 2 * each.speed_deg_s * ratio / 360.0 > 15.0]
    assert max(each.removed_percent - each.removed_static_percent for each in fast) > 15.0
