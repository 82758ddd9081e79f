"""Faults of the load encoder are named; gear wear is not mistaken for one."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.axis_samples import SampleMaker, moves_and_rests

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.health import EncoderFault, EncoderHealth

DEMO = Path("profiles/demo/axis.yaml")
AXIS = AxisConfig.from_text(DEMO.read_text().replace("cycle_ms: 4", "cycle_ms: 10"), DEMO)
PERIOD_S = AXIS.drive.cycle_s
FAULT_S = 160.0
FAULT = int(FAULT_S / PERIOD_S)


def model_of(offset=31.6, second=13.7, phase=161.5):
    orders = (
        MotorOrder(order=1, amplitude_arcsec=6.4, phase_deg=38.0),
        MotorOrder(order=2, amplitude_arcsec=second, phase_deg=phase),
        MotorOrder(order=4, amplitude_arcsec=8.1, phase_deg=-22.6),
    )
    effects = (Synchronous(orders=orders), Hysteresis(offset_arcsec=offset, width_deg=26.0, exponent=1.7))
    return TransmissionModel(50.0, effects, provenance={"held_out": {"after_arcsec": 1.0}})


MODEL = model_of()


def judged(samples, follower=None, batch=50, exchanged=False):
    """Returns the encoder's states over the samples, each at its first occurrence.

    If ``exchanged``, the model is replaced after each batch.
    """
    follower = follower or Follower(AXIS, MODEL)
    seen = []
    for first in range(0, len(samples), batch):
        follower.take(samples[first : first + batch])
        if exchanged:
            follower.use_model(MODEL)
        status = follower.health.status
        if not seen or status.fault is not seen[-1][1].fault:
            seen.append((first * PERIOD_S, status))
    return seen


def working(truth=MODEL, duration_s=360.0, seed=1, speed_deg_s=10.0):
    if truth is MODEL:
        return as_modelled(duration_s, seed, speed_deg_s).copy()
    return made(truth, duration_s, seed, speed_deg_s)


def made(truth, duration_s, seed, speed_deg_s):
    return SampleMaker(AXIS, MODEL, truth, seed).make(
        moves_and_rests(duration_s, PERIOD_S, seed, speed_deg_s)
    )


@cache
def as_modelled(duration_s, seed, speed_deg_s):
    """Cached, because most tests begin with the same samples."""
    return made(MODEL, duration_s, seed, speed_deg_s)


def faulty(change, **options):
    samples = working(**options)
    load = samples["axes"]["load_position_deg"][FAULT:, 0]
    load[:] = change(load, PERIOD_S * np.arange(len(load)))
    return samples


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize(
    ("fault", "change", "within_s"),
    [
        (EncoderFault.FROZEN, lambda load, _: load[0], 5.0),
        (EncoderFault.JUMPED, lambda load, _: load + 100.0 / 3600.0, 0.2),
        (EncoderFault.JUMPED, lambda load, _: load + 12.0 / 3600.0, 20.0),
        (
            EncoderFault.NOISY,
            lambda load, _: load + np.random.default_rng(3).normal(0.0, 3.0 / 3600.0, len(load)),
            5.0,
        ),
        (EncoderFault.DRIFTING, lambda load, time_s: load + 6.0 / 60.0 * time_s / 3600.0, 180.0),
    ],
)
def test_faults_are_named_with_figures_and_not_too_early(fault, change, within_s, exchanged):
    seen = judged(faulty(change)[: FAULT + int((within_s + 1.0) / PERIOD_S)], exchanged=exchanged)
    assert [each.fault for _, each in seen][:2] == [None, fault]
    at_s, status = seen[1]
    assert FAULT_S - 0.2 <= at_s <= FAULT_S + within_s
    assert status.reason.startswith(f"load encoder {fault.value}: ")
    assert "arcsec" in status.reason


@pytest.mark.parametrize(("seed", "speed_deg_s"), [(0, 2.0), (1, 20.0)])
def test_a_healthy_encoder_stays_trusted(seed, speed_deg_s):
    assert [each.fault for _, each in judged(working(seed=seed, speed_deg_s=speed_deg_s))] == [None]


@pytest.mark.parametrize("truth", [model_of(offset=38.0), model_of(second=17.0), model_of(phase=150.0)])
def test_a_changed_gear_is_not_an_encoder_fault(truth):
    assert [each.fault for _, each in judged(working(truth))] == [None]


def test_gradual_wear_is_not_an_encoder_fault():
    """The loop grows by a fifth within minutes, faster than in any real gear."""
    path = moves_and_rests(360.0, PERIOD_S, 5)
    before, after = (
        SampleMaker(AXIS, MODEL, truth, 5).make(path) for truth in (MODEL, model_of(offset=38.0))
    )
    share = np.clip(np.linspace(-0.3, 1.3, len(path)), 0.0, 1.0)
    load = before["axes"]["load_position_deg"][:, 0]
    load += share * (after["axes"]["load_position_deg"][:, 0] - load)
    assert [each.fault for _, each in judged(before)] == [None]


def test_one_misread_sample_is_not_a_fault():
    samples = working(duration_s=60.0)
    samples["axes"]["load_position_deg"][3000] += 0.5
    assert [each.fault for _, each in judged(samples)] == [None]


def test_a_recovered_encoder_is_trusted_again():
    def for_a_while(load, time_s):
        return np.where(time_s < 10.0, load[0], load)

    seen = judged(faulty(for_a_while))
    assert [each.fault for _, each in seen] == [None, EncoderFault.FROZEN, None]
    assert seen[2][0] >= FAULT_S + 15.0


def test_a_jump_persists_until_the_drive_is_verified_again():
    samples = faulty(lambda load, _: load + 100.0 / 3600.0)
    follower = Follower(AXIS, MODEL)
    judged(samples, follower)
    assert follower.health.status.fault is EncoderFault.JUMPED
    again = working(duration_s=60.0, seed=9)
    again["cycle"] += samples["cycle"][-1]
    again["axes"]["state"][:10] = 0  # the axis is unverified
    assert judged(again, follower)[-1][1].fault is None


def test_verdicts_are_independent_of_batching():
    samples = faulty(lambda load, _: load + 100.0 / 3600.0, duration_s=165.0)
    before, after = samples[: FAULT - 500], samples[FAULT - 500 :]
    at_s = []
    for batch in (2, 5, 100):
        follower = Follower(AXIS, MODEL)
        for part in (before, after):
            assert follower.health.status.fault is None
            for first in range(0, len(part), batch):
                follower.take(part[first : first + batch])
                if follower.health.status.fault is not None:
                    break
        assert follower.health.status.fault is EncoderFault.JUMPED
        at_s.append(first * PERIOD_S)
    assert max(at_s) - min(at_s) <= 1.1


def test_no_fault_is_reported_while_the_hysteresis_state_is_unknown():
    samples = working()
    samples["axes"]["flags"] &= ~np.uint16(8)
    samples["axes"]["predicted_arcsec"] += np.where(samples["cycle"] % 1000 < 500, 40.0, 0.0)[:, None]
    assert [each.fault for _, each in judged(samples)] == [None]


def test_an_uncalibrated_gear_is_not_an_encoder_fault():
    """An unmodelled loop of 160 arcsec looks like every kind of encoder fault."""
    nothing = TransmissionModel(AXIS.gear.ratio)
    maker = SampleMaker(AXIS, nothing, model_of(offset=160.0, second=30.0), 3, compensated=False)
    samples = maker.make(moves_and_rests(120.0, PERIOD_S, 3, 60.0))
    # If the axis had a model, this would be a fault.
    assert EncoderHealth(AXIS, MODEL).take(samples).fault is EncoderFault.JUMPED
    assert [each.fault for _, each in judged(samples, Follower(AXIS, nothing))] == [None]
    samples["axes"]["load_position_deg"][len(samples) // 2 :] = samples["axes"]["load_position_deg"][0]
    assert EncoderHealth(AXIS, nothing).take(samples).fault is EncoderFault.FROZEN
