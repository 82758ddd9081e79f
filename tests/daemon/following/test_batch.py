"""Without forgetting, the recursion agrees with the identification on one measured record."""

import numpy as np
import pytest
from support.adapting import AXIS, MODEL, Sampler, truth_of
from support.exercised import booted

from hdbridge.analysis.identification import FitOptions
from hdbridge.analysis.identify import fit
from hdbridge.analysis.linear import solve_symmetric
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Start
from hdbridge.commissioning.calibration.identification import measured_of
from hdbridge.control.bench import Bench
from hdbridge.daemon.following.estimator import Estimator
from hdbridge.daemon.following.follower import observation_sigma_arcsec
from hdbridge.daemon.following.measuring import DriftModel, Measuring
from hdbridge.motion.procedures.moves import Settle
from hdbridge.motion.procedures.stepping import Stepping


@pytest.fixture(scope="module")
def run():
    """A stepping test of a gear whose loop is a tenth higher and whose second order is another."""
    truth = truth_of(1e-3, growth=0.1, second_order_arcsec=2.0)  # all of it at once
    with booted(AXIS, truth, 3) as (drive, _):
        return Bench(drive, MODEL).run(Stepping(count=40, settle=Settle(minimum_s=0.3)))


def test_recursion_equals_batch_least_squares(run):
    drift = DriftModel(MODEL)
    samples = Sampler(AXIS, MODEL).samples(run.record)
    measuring = Measuring(drift, 0.5)
    times, axis = 1e-9 * samples["time_ns"].astype(float), samples["axes"][:, 0]
    found = measuring.take(times, axis, np.ones(len(times), dtype=bool))
    assert len(found) == pytest.approx(80, abs=3)
    rows, observed = np.array([each.row for each in found]), np.array([each.error_arcsec for each in found])

    wide = np.full(drift.count, 100.0)
    sigma = observation_sigma_arcsec(AXIS)
    estimator = Estimator(np.zeros(drift.count), np.diag(wide**2), wide)
    for part in np.array_split(np.arange(len(found)), 13):
        estimator.update(rows[part], observed[part], sigma)
    information = rows.T @ rows / sigma**2 + np.diag(1.0 / wide**2)
    batch = solve_symmetric(information, rows.T @ observed / sigma**2)
    assert estimator.estimate == pytest.approx(batch, abs=1e-4)  # which adds a ridge

    model = drift.changed(estimator.estimate[: drift.zero])
    options = FitOptions(start=Start.FORWARD, highest_order=8, load_orders=0, active=MODEL)
    identified = fit(measured_of([run]), AXIS.gear.ratio, options)
    offset = identified.interval("hysteresis", "offset_arcsec")
    assert offset.value == pytest.approx(44.0, abs=0.5)
    ours = {each.name: each for each in model.effects}
    assert ours["hysteresis"].offset_arcsec == pytest.approx(offset.value, abs=max(offset.half_width, 0.3))
    for order in ours["synchronous"].orders:
        theirs = identified.interval("synchronous", f"orders[{order.order}].amplitude_arcsec")
        assert order.amplitude_arcsec == pytest.approx(theirs.value, abs=max(theirs.half_width, 0.3))


def test_measurement_resolution_comes_from_the_axis():
    assert observation_sigma_arcsec(AxisConfig.load(AXIS.path)) == pytest.approx(0.944, abs=0.001)
