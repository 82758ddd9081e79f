"""Compensation in motion: the filter has its stated gain and no effect at rest."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.response import gain
from hdbridge.axis.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.switchover import Correction
from hdbridge.errors import InputError

PERIOD = 0.004
WIDE = CompensationLimits(maximum_arcsec=1000.0, slew_arcsec_s=1e6, ramp_s=0.2)
RATIO = 50.0


def response(weights, lead=4, per_cycle=2, cycle_ms=4.0) -> Response:
    return Response(
        cycle_ms=cycle_ms,
        following_lag_ms=5.0,
        known_to_hz=80.0,
        frequency_hz=(10.0, 20.0),
        gain=(1.0, 1.1),
        phase_deg=(0.0, -5.0),
        uncertainty=(0.1, 0.1),
        filter=LeadFilter(
            lead_cycles=lead, per_cycle=per_cycle, full_speed_deg_s=4.0, weights=tuple(weights)
        ),
    )


filters = st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8).map(
    lambda rest: response([1.0 - math.fsum(rest), *rest], lead=3, per_cycle=4)
)


def model(measured=None, offset=20.0) -> TransmissionModel:
    orders = (
        MotorOrder(order=2, amplitude_arcsec=10.0, phase_deg=30.0),
        MotorOrder(order=4, amplitude_arcsec=6.0, phase_deg=-70.0),
    )
    loop = Hysteresis(offset_arcsec=offset, width_deg=20.0, exponent=1.6)
    return TransmissionModel(RATIO, (Synchronous(orders=orders), loop), response=measured)


def begun(which: TransmissionModel, limits=WIDE) -> Compensation:
    compensation = Compensation(which, limits, PERIOD)
    compensation.reset(0.0)
    compensation.engage()
    return compensation


def smooth_move(far_deg: float, time_s: float) -> np.ndarray:
    share = np.arange(1, round(time_s / PERIOD) + 1) * PERIOD / time_s
    return far_deg * (share - np.sin(math.tau * share) / math.tau)


@settings(deadline=None, max_examples=30)
@given(measured=filters, moves=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=4))
def test_correction_at_rest_equals_the_static_one_bit_for_bit(measured, moves):
    filtered, static = begun(model(measured)), begun(model())
    place = 0.0
    for far in moves:
        for step in smooth_move(far, 0.4):
            filtered.command(place + step)
            static.command(place + step)
        place += far
    for _ in range(60):  # length of the filter and of the ramp
        one, other = filtered.command(place), static.command(place)
    assert one == other
    assert filtered.correction_arcsec == static.correction_arcsec


@pytest.mark.parametrize("speed_deg_s", [-60.0, 5.0, 38.0, 76.0])
def test_at_constant_speed_each_order_has_the_gain_of_the_filter(speed_deg_s):
    rng = np.random.default_rng(1)
    rest = rng.uniform(-0.5, 0.5, 20)
    measured = response([1.0 - rest.sum(), *rest], lead=6, per_cycle=2)
    filtered = begun(model(measured, offset=0.0))
    targets = speed_deg_s * PERIOD * np.arange(1500)
    correction = np.array([(filtered.command(x), filtered.correction_arcsec)[1] for x in targets])[500:]
    angle = np.radians(RATIO * targets[500:])
    design = np.column_stack([f(k * angle) for k in (1, 2, 3, 4, 6, 8) for f in (np.cos, np.sin)])
    cos_sin = np.linalg.lstsq(design, correction, rcond=None)[0]
    for place, (order, amplitude, phase) in {1: (2, 10.0, 30.0), 3: (4, 6.0, -70.0)}.items():
        hertz = order * speed_deg_s * RATIO / 360.0
        wanted = (
            amplitude * np.exp(1j * math.radians(phase)) * gain(measured.filter, np.array([hertz]), PERIOD)[0]
        )
        found = cos_sin[2 * place] - 1j * cos_sin[2 * place + 1]
        # The correction itself shifts the motor angle slightly, a second-order effect.
        assert abs(found - wanted) < 0.02 * abs(wanted) + 0.1


@settings(deadline=None, max_examples=30)
@given(
    measured=filters,
    targets=st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=60),
    missed=st.sets(st.integers(0, 60)),
)
def test_size_and_slew_limits_hold_for_the_filtered_correction(measured, targets, missed):
    """The limits also hold if the targets jump, as after a re-targeted move, a stop or a missed cycle."""
    limits = CompensationLimits(maximum_arcsec=15.0, slew_arcsec_s=1000.0, ramp_s=0.0)
    compensation = begun(model(measured), limits)
    before, place = 0.0, 0.0
    for cycle, step in enumerate(targets):
        place += step
        motor = compensation.hold(place) if cycle in missed else compensation.command(place)
        correction = (place - motor / RATIO) * 3600.0
        assert abs(correction) <= 15.0 + 1e-6
        assert abs(correction - before) <= 1000.0 * PERIOD + 1e-6
        assert correction == pytest.approx(compensation.correction_arcsec, abs=1e-6)
        before = correction


def test_filter_state_follows_the_unfiltered_path():
    """A filter that overshoots must not make the hysteresis reverse."""
    sharp = response([3.0, -2.0, *[0.0] * 7], lead=4)
    filtered, static = begun(model(sharp)), begun(model())
    for target in [*smooth_move(8.0, 0.8), *(8.0 - smooth_move(3.0, 0.5))]:
        filtered.command(target)
        static.command(target)
        assert filtered.predicted_arcsec == pytest.approx(static.predicted_arcsec, abs=1e-6)


def test_changing_the_response_in_motion_causes_no_step():
    first = begun(model())
    correction = Correction(first)
    targets = 20.0 * PERIOD * np.arange(1, 800)
    issued = []
    rest = [0.2] * 10
    for cycle, target in enumerate(targets):
        if cycle == 300:
            new = Compensation(model(response([1.0 - sum(rest), *rest], lead=5)), WIDE, PERIOD)
            correction.change(new)
        correction.command(target)
        issued.append(correction.correction_arcsec)
    assert not correction.changing
    steps = np.abs(np.diff(issued))
    assert steps[298:303].max() < 1.2 * steps[200:298].max()


def test_a_response_of_another_cycle_is_refused():
    with pytest.raises(InputError, match="2 ms, but this axis has 4 ms"):
        Compensation(model(response([1.0], lead=0, per_cycle=1, cycle_ms=2.0)), WIDE, PERIOD)


def test_model_file_keeps_the_response(tmp_path):
    given = model(response([0.5, 0.25, 0.25]))
    given.save(tmp_path / "model.yaml")
    assert TransmissionModel.load(tmp_path / "model.yaml") == given
    assert TransmissionModel.from_document(given.document()) == given
    assert TransmissionModel.from_text(replace(given, response=None).dump()).response is None


@settings(deadline=None, max_examples=20)
@given(measured=filters, far_deg=st.floats(0.3, 10.0))
def test_no_filter_reverses_the_motor_at_the_end_of_a_move(measured, far_deg):
    """After a reversal, the load would stay on the wrong branch of its hysteresis loop."""
    filtered = begun(model(measured))
    targets = [*smooth_move(far_deg, math.sqrt(far_deg / 8.0)), *[far_deg] * 60]
    motor = np.array([filtered.command(target) for target in targets])
    late = motor[-75:]  # the slowest part of the move, and the length of the filter
    assert late.max() - motor[-1] < 0.01
