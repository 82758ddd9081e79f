"""A valid model raises nothing, wear raises `recalibrate`, anything else `something_changed`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.axis_samples import SampleMaker, moves_and_rests

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import CATALOGUE
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.judging import Verdict

DEMO = Path("profiles/demo/axis.yaml")
AXIS = AxisConfig.from_text(DEMO.read_text().replace("cycle_ms: 4", "cycle_ms: 20"), DEMO)
PERIOD_S = AXIS.drive.cycle_s
ORDERS = ((1, 6.4, 38.0), (2, 13.7, 161.5), (4, 8.1, -22.6))
HALF_WIDTH_ARCSEC, HALF_WIDTH_OFFSET_ARCSEC = 0.02, 0.28


def model_of(offset=31.6, orders=ORDERS):
    series = CATALOGUE["synchronous"](
        orders=[{"order": k, "amplitude_arcsec": a, "phase_deg": p} for k, a, p in orders]
    )
    loop = CATALOGUE["hysteresis"](offset_arcsec=offset, width_deg=26.0, exponent=1.7)
    uncertainty = {
        "synchronous": {
            "orders": [{"order": k, "amplitude_arcsec": 0.02, "phase_deg": 0.2} for k, _, _ in orders]
        },
        "hysteresis": {"offset_arcsec": HALF_WIDTH_OFFSET_ARCSEC, "width_deg": 0.2, "exponent": 0.01},
    }
    return TransmissionModel(50.0, (series, loop), uncertainty, {"held_out": {"after_arcsec": 1.0}})


MODEL = model_of()


def second(by_arcsec):
    return tuple((k, a + by_arcsec * (k == 2), p) for k, a, p in ORDERS)


def with_order(number, amplitude_arcsec):
    order = {"order": number, "amplitude_arcsec": amplitude_arcsec, "phase_deg": 10.0}
    return replace(MODEL, effects=(*MODEL.effects, CATALOGUE["motor_order"](orders=(order,))))


def watched(truth, duration_s=900.0, seed=0, change=None, model=MODEL, batch=250, path=None):
    """Returns the remarks of a watch over an axis at work."""
    path = moves_and_rests(duration_s, PERIOD_S, seed) if path is None else path
    samples = SampleMaker(AXIS, MODEL, truth, seed).make(path)
    if change is not None:
        change(samples)
    follower = Follower(AXIS, model)
    return follower.watch, raised_over(follower, samples, batch)


def raised_over(follower, samples, batch):
    batches = (samples[first : first + batch] for first in range(0, len(samples), batch))
    return [each for batch in batches for each in follower.take(batch) or ()]


def test_normal_work_raises_nothing():
    quiet(0, 1500.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_hours_of_normal_work_raise_nothing(seed):
    quiet(seed, 3600.0)


def quiet(seed, duration_s):
    """Checks that a truth at the edge of the model's intervals raises no remark."""
    sign = (-1) ** seed
    truth = model_of(31.6 + sign * HALF_WIDTH_OFFSET_ARCSEC, second(sign * HALF_WIDTH_ARCSEC))
    watch, raised = watched(truth, duration_s=duration_s, seed=seed)
    assert raised == []
    assert watch.evidence.verdict(Verdict.RECALIBRATE) is Verdict.HOLDS
    assert watch.verdict is Verdict.HOLDS


@pytest.mark.parametrize(
    ("truth", "named"),
    [
        (model_of(offset=31.6 * 1.2), "hysteresis.offset_arcsec 31.6 to 3"),
        (model_of(orders=second(4.0)), "synchronous.orders[2].amplitude_arcsec 13.7 to 1"),
    ],
)
def test_wear_requests_a_calibration_and_names_the_change(truth, named):
    watch, raised = watched(truth)
    assert [each.verdict for each in raised] == [Verdict.RECALIBRATE]
    assert named in raised[0].evidence
    assert raised[0].text.startswith("recalibrate: ")
    assert "arcsec rms (its intervals" in raised[0].evidence
    assert watch.evidence.rms_arcsec > 1.0 > watch.evidence.residual_arcsec - 0.5


@pytest.mark.parametrize("truth", [with_order(5, 5.0), model_of(offset=31.6 * 1.8)])
def test_changes_unlike_wear_are_reported_as_such(truth):
    _, raised = watched(truth)
    assert [each.verdict for each in raised] == [Verdict.SOMETHING_CHANGED]


def test_a_zero_shift_requests_a_calibration():
    def warm(samples):
        minutes = PERIOD_S / 60.0 * np.arange(len(samples))
        samples["axes"]["load_position_deg"][:, 0] += np.minimum(minutes, 15.0) * 1.0 / 3600.0

    _, raised = watched(MODEL, 1500.0, change=warm)
    assert [each.verdict for each in raised] == [Verdict.RECALIBRATE]
    assert "zero: by +" in raised[0].evidence


def test_an_untrusted_load_encoder_is_the_only_report():
    def jump(samples):
        samples["axes"]["load_position_deg"][20_000:] += 50.0 / 3600.0

    watch, raised = watched(MODEL, change=jump)
    assert [each.verdict for each in raised] == [Verdict.ENCODER]
    assert "load encoder jumped: by +" in raised[0].evidence
    assert watch.verdict is Verdict.ENCODER


def test_one_bad_minute_raises_nothing():
    def knocked(samples):
        samples["axes"]["load_position_deg"][20_000:21_500, 0] += (
            np.random.default_rng(1).normal(0.0, 0.5, 1500).cumsum() / 60.0 / 3600.0
        )

    _, raised = watched(MODEL, change=knocked)
    assert raised == []


def test_without_a_model_no_change_is_reported():
    watch, raised = watched(MODEL, model=TransmissionModel(50.0))
    assert raised == []
    assert watch.verdict is Verdict.HOLDS


def test_a_model_without_intervals_gets_typical_ones():
    bare = replace(MODEL, uncertainty={})
    _, raised = watched(model_of(offset=31.6 * 1.3), model=bare)
    assert [each.verdict for each in raised] == [Verdict.RECALIBRATE]


def test_a_resting_axis_raises_nothing():
    watch, raised = watched(model_of(offset=60.0), path=np.zeros(10_000))
    assert raised == []
    assert watch.evidence is None


def test_lost_cycles_leave_the_path_unknown_until_it_is_re_established():
    path = moves_and_rests(900.0, PERIOD_S, 4)
    samples = SampleMaker(AXIS, MODEL, MODEL, 4).make(path)
    follower = Follower(AXIS, MODEL)
    kept = np.ones(len(samples), dtype=bool)
    for first in range(5_000, 45_000, 5_000):
        kept[first : first + 300] = False
    samples = samples[kept]
    assert raised_over(follower, samples, 50) == []
    assert follower.watch.evidence is not None
