"""Particulars of each cause: the figures of its source, its limits, its characteristic form."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from hdbridge.axis.effects import (
    AmplitudeDrift,
    Backlash,
    Channel,
    ChannelSkew,
    Compliance,
    CountLoss,
    Creep,
    DirectionPhase,
    FlexsplineOrders,
    Hysteresis,
    HysteresisMemory,
    InertialWindup,
    LoadOrders,
    LocalDefect,
    Loop,
    Moment,
    Motion,
    MotorEncoderEccentricity,
    MotorOrder,
    MotorOrders,
    Observer,
    RateDependence,
    RatioError,
    Relaxation,
    Start,
    Step,
    SubdivisionalError,
    Synchronous,
    TorqueModulation,
    VelocityWindup,
    Wear,
    ZeroDrift,
    moments,
    readings,
)

ORDER_4 = MotorOrder(order=4, amplitude_arcsec=10, phase_deg=30)
LOOP = Loop(offset_arcsec=40, width_deg=20, exponent=1.6)


# ---- derived channels ------------------------------------------------------------------------


def test_speed_acceleration_and_direction_are_backward_differences_over_uneven_time_steps():
    motion = Motion(np.array([0.0, 1.0, 1.0, 4.0, 2.0]), np.array([0.0, 0.5, 1.0, 2.0, 2.25]))
    seen = list(moments(motion))
    assert [each.motor_speed_deg_s for each in seen] == [0, 2, 0, 3, -8]
    assert [each.motor_acceleration_deg_s2 for each in seen] == [0, 0, -4, 3, -44]
    assert [each.direction for each in seen] == [0, 1, 1, 1, -1]
    observer = Observer()
    assert [observer.moment(a, t) for a, t in zip(motion.motor_deg, motion.time_s, strict=True)] == seen


def test_a_recorded_speed_takes_precedence():
    motion = Motion(
        np.zeros(3), np.arange(3.0), motor_speed_deg_s=np.array([5.0, 0.0, -5.0]),
        motor_acceleration_deg_s2=np.array([1.0, 2.0, 3.0]),
    )  # fmt: skip
    assert [each[2:5] for each in moments(motion)] == [(5, 1, 1), (0, 2, 1), (-5, 3, -1)]


# ---- orders ----------------------------------------------------------------------------------


def test_a_flexspline_order_is_a_motor_order_whose_phase_runs_through_once_per_load_turn():
    orders = (MotorOrder(order=2, amplitude_arcsec=3, phase_deg=0),)
    flexspline = FlexsplineOrders(orders=orders, ratio=50)
    motor = MotorOrders(orders=orders)
    start, quarter = np.array([0.0]), np.array([50 * 360 / 4.0])
    assert flexspline.predict(Motion(start)) == pytest.approx(motor.predict(Motion(start)))
    assert flexspline.predict(Motion(quarter)) == pytest.approx(-motor.predict(Motion(quarter)))


def test_a_load_order_repeats_with_the_load_and_is_compensated_only_as_the_gears():
    effect = LoadOrders(orders=(MotorOrder(order=1, amplitude_arcsec=20, phase_deg=0),), ratio=50)
    np.testing.assert_allclose(effect.predict(Motion(np.array([0.0, 9000.0, 18000.0]))), [20, -20, 20])
    assert not effect.is_compensable()
    assert effect.model_copy(update={"origin": "gear"}).is_compensable()


def test_an_eccentric_disc_has_no_third_order():
    with pytest.raises(ValidationError, match="only orders 1, 2"):
        MotorEncoderEccentricity(orders=(MotorOrder(order=3, amplitude_arcsec=1, phase_deg=0),))


def test_an_order_may_stand_only_once():
    with pytest.raises(ValidationError, match="only once"):
        Synchronous(orders=(ORDER_4, ORDER_4))


def test_new_motor_orders_are_sought_outside_the_model():
    model = [
        Synchronous(orders=tuple(MotorOrder(order=k, amplitude_arcsec=1, phase_deg=0) for k in (1, 2, 4)))
    ]
    found = {each.order for each in MotorOrders.candidate(50.0, model).orders}
    assert found == {3, 5, 6, 7, 8, 9, 10, 11, 12}


def test_a_direction_phase_and_the_mean_of_both_flanks_are_the_shifted_tooth_error():
    angle = np.concatenate([np.linspace(0, 360, 500), np.linspace(360, 0, 500)])
    sign = np.where(np.arange(1000) < 500, 1, -1)
    sign[500] = 1  # at rest at the turning point, so the direction is kept
    mean = ORDER_4.model_copy(
        update={"amplitude_arcsec": ORDER_4.amplitude_arcsec * math.cos(math.radians(4 * 5.0))}
    )
    both = Synchronous(orders=(mean,)).predict(Motion(angle))
    both += DirectionPhase(orders=(mean,), shift_deg=5.0).predict(Motion(angle), Start.FORWARD)
    tooth = Synchronous(orders=(ORDER_4,)).predict(Motion(angle + sign * 5.0))
    np.testing.assert_allclose(both, tooth, atol=1e-9)


def test_a_small_direction_phase_is_linear_in_its_shift():
    motion = Motion(np.linspace(0, 360, 100))
    one, two = (DirectionPhase(orders=(ORDER_4,), shift_deg=each).predict(motion) for each in (0.1, 0.2))
    np.testing.assert_allclose(two, 2 * one, atol=1e-4)
    column = DirectionPhase(orders=(ORDER_4,), shift_deg=0.0).columns(motion)[:, 0]
    np.testing.assert_allclose(0.1 * column, one, atol=1e-4)


# ---- torque, speed, time ---------------------------------------------------------------------


def test_ripple_grows_with_the_magnitude_of_the_torque_up_to_the_limit():
    effect = TorqueModulation(orders=(ORDER_4,), growth_percent_per_nm=2, limit_nm=10)
    ripple = Synchronous(orders=(ORDER_4,)).predict(Motion(np.array([5.0])))[0]
    torque = np.array([0.0, 5.0, -5.0, 1000.0])
    error = effect.predict(Motion(np.full(4, 5.0), measured={Channel.LOAD_TORQUE: torque}))
    np.testing.assert_allclose(error, ripple * np.array([0, 0.1, 0.1, 0.2]))


def test_wind_up_stiffens_at_two_torques():
    effect = Compliance.candidate(50.0)
    torque = np.array([0.0, 1.0, 7.0, 10.0, 25.0, 30.0, -10.0])
    error = effect.predict(Motion(np.zeros(7), measured={Channel.LOAD_TORQUE: torque}))
    at = [0, 15.9, 111.3, 111.3 + 3 * 11.5, 111.3 + 18 * 11.5, 111.3 + 18 * 11.5 + 5 * 9]
    np.testing.assert_allclose(error, [*at, -at[3]])
    assert 206265.0 / effect.c1_arcsec_per_nm == pytest.approx(1.3e4, rel=0.01)


def test_a_torque_of_the_other_sign_convention_turns_the_sense_not_the_stiffness():
    effect = Compliance.candidate(50.0)
    turned = effect.fitted(-effect.coefficients())
    assert turned.violations() == []
    assert (turned.sense, turned.c1_arcsec_per_nm) == (-1, effect.c1_arcsec_per_nm)


def test_the_lower_torque_comes_first():
    with pytest.raises(ValidationError, match="T1"):
        Compliance(c1_arcsec_per_nm=1, c2_arcsec_per_nm=1, c3_arcsec_per_nm=1, torque1_nm=9, torque2_nm=3)


def test_skew_is_what_a_late_sample_shows_also_while_it_accelerates():
    """The skew is compared with positions sampled late, at the true speed; the remainder is of third
    order.
    """
    time_s = np.linspace(0, 1, 400)
    angle = 3000 * np.sin(3 * time_s)
    late = 3000 * np.sin(3 * (time_s + 0.002))
    motion = Motion(
        angle, time_s, motor_speed_deg_s=9000 * np.cos(3 * time_s),
        motor_acceleration_deg_s2=-27000 * np.sin(3 * time_s),
    )  # fmt: skip
    measured = (late - angle) / 50 * 3600
    np.testing.assert_allclose(
        ChannelSkew(ratio=50.0, delay_ms=2.0, second_order_ms2=4.0).predict(motion), measured, atol=0.01
    )
    assert np.ptp(measured) > 1000


def test_a_load_lags_while_accelerating():
    effect = InertialWindup(ratio=50, inertia_over_stiffness_s2=1 / (2 * math.pi * 50) ** 2)
    motion = Motion(
        np.zeros(1), motor_speed_deg_s=np.zeros(1), motor_acceleration_deg_s2=np.array([200.0 * 50])
    )
    assert effect.predict(motion)[0] == pytest.approx(-7.3, abs=0.01)


def test_drag_falls_off_by_half_at_the_shear_speed_and_is_gone_at_rest():
    effect = VelocityWindup(coulomb_arcsec=2, viscous_arcsec_s_per_deg=0.01, shear_deg_s=1000)
    motion = Motion(np.zeros(4), motor_speed_deg_s=np.array([0.0, 1.0, 1000.0, -1000.0]))
    np.testing.assert_allclose(effect.predict(motion), [0, -2.00999, -7, 7], atol=1e-4)


def test_the_loop_grows_by_its_growth_per_decade_of_speed():
    effect = RateDependence(loop=LOOP, growth_percent=10, reference_deg_s=1)
    motion = Motion(np.array([0.0, 100.0, 200.0, 300.0]), motor_speed_deg_s=np.array([0.0, 9.0, 99.0, 0.0]))
    np.testing.assert_allclose(effect.predict(motion, Start.FORWARD), [0, 4, 8, 0])


def test_a_lost_count_stays_lost():
    effect = CountLoss(steps=(Step(time_s=1.0, size_arcsec=3.24), Step(time_s=2.0, size_arcsec=-1.0)))
    error = effect.predict(Motion(np.zeros(4), np.array([0.0, 1.0, 1.5, 9.0])))
    np.testing.assert_allclose(error, [0, 3.24, 3.24, 2.24])
    assert effect.fitted(np.array([1.0, 2.0]), {"time_s": 5.0}).steps[1].time_s == 5.0


def test_a_wrong_ratio_is_784_arcsec_per_step_between_40_and_50():
    effect = RatioError(ramp_arcsec_per_turn=360 * 3600 * (1 / 40 - 1 / 50))
    assert effect.predict(Motion(np.array([43.56])))[0] == pytest.approx(784, abs=0.5)
    assert effect.true_ratio(50) == pytest.approx(40)


def test_lines_of_the_load_encoder_count_on_the_predicted_load_angle():
    effect = SubdivisionalError(
        lines_per_turn=9000, orders=(MotorOrder(order=2, amplitude_arcsec=1, phase_deg=0),)
    )
    line = 360 / 9000
    error = effect.predict(Motion(np.zeros(3), load_deg=np.array([0.0, line / 4, line / 2])))
    np.testing.assert_allclose(error, [1, -1, 1], atol=1e-9)


def test_a_defect_is_met_once_per_load_turn_and_nowhere_else():
    effect = LocalDefect(ratio=50, height_arcsec=5, centre_deg=350, half_width_deg=20)
    at = 50 * np.array([350.0, -10.0, 710.0, 360.0, 329.9, 10.1])
    np.testing.assert_allclose(effect.predict(Motion(at)), [5, 5, 5, 2.5, 0, 0], atol=1e-9)


# ---- play, wear, creep, drift ----------------------------------------------------------------


def test_the_load_rests_while_the_motor_crosses_an_ideal_gap():
    effect = Backlash(gap_arcsec=36.0, crossing_deg=0.5)
    assert effect.crossing_deg == pytest.approx(0.5)
    angle = np.array([0.0, 10.0, 9.9, 9.7, 9.5, 9.4])
    load = angle / 50 * 3600 + effect.predict(Motion(angle))
    np.testing.assert_allclose(load[1:5], load[1])
    assert load[5] < load[4]
    np.testing.assert_allclose(effect.predict(Motion(angle))[[1, 5]], [-18, 18])


def test_a_saturated_start_has_the_load_lag_already():
    angle = np.array([0.0, 5.0])
    for start, lag in ((Start.FORWARD, -5.0), (Start.BACKWARD, 5.0), (Start.VIRGIN, 0.0)):
        effect = Backlash(gap_arcsec=10, crossing_deg=1)
        np.testing.assert_allclose(effect.predict(Motion(angle), start), [lag, -5.0])


def test_lost_motion_grows_with_the_turns_run():
    effect = Wear(growth_arcsec_per_kiloturn=4, width_deg=1, turns_before=500, turns_limit=2000)
    thousand = 360_000.0
    error = effect.predict(Motion(np.array([0.0, thousand, 0.0, thousand])))
    np.testing.assert_allclose(error, [0, 3, -4, 4])  # half of the growth 1.5 * 4, then of 2 * 4 (limit)


def test_a_gear_that_runs_in_wears_less_and_less():
    effect = Wear(growth_arcsec_per_kiloturn=-40, width_deg=1, exponent=0.5)
    turns = np.array([0.0, 10.0, 40.0, 1000.0])
    np.testing.assert_allclose(effect.predict(Motion(360.0 * turns)), [0, -2, -4, -20])
    later = effect.after(10.0).predict(Motion(360.0 * (turns[1:] - turns[1])), Start.FORWARD)
    np.testing.assert_allclose(later, [-2, -4, -20])


PLAY = [
    Backlash(gap_arcsec=20, crossing_deg=0.01),
    Hysteresis(offset_arcsec=-20, width_deg=1.0, exponent=1.6),
    HysteresisMemory(offset_arcsec=-30, width_deg=0.5, exponent=1.3),
    RateDependence(
        loop=Loop(offset_arcsec=-20, width_deg=1.0, exponent=1.6), growth_percent=30, reference_deg_s=30
    ),
    AmplitudeDrift(
        orders=(ORDER_4,),
        loop=Loop(offset_arcsec=-20, width_deg=1.0, exponent=2.0),
        ripple_percent_per_k=0.0,
        friction_percent_per_k=0.5,
        driven_by="time",
        tau_s=100.0,
    ),
    Wear(growth_arcsec_per_kiloturn=-100, width_deg=0.05, exponent=0.7, turns_before=40),
]


@pytest.mark.parametrize("effect", PLAY, ids=lambda each: each.name)
def test_play_for_an_inverse_is_crossed_no_steeper_than_asked_and_is_the_same_beyond(effect):
    gentle, exact = effect.gentle_tracker(Start.FORWARD, 50.0), effect.tracker(Start.FORWARD)
    for angle in (0.0, 720.0):
        gentle.advance(angle, Moment())
        exact.advance(angle, Moment())
    back = 720.0 - np.linspace(0, 5, 5001)
    soft = np.array([gentle.peek(float(each), Moment()) for each in back])
    assert np.max(np.diff(soft)) <= 50.0 * 0.001 * (1 + 1e-6)
    assert soft[0] == pytest.approx(exact.peek(720.0, Moment()), rel=1e-12)
    assert soft[-1] == pytest.approx(exact.peek(715.0, Moment()), rel=1e-12)


def test_the_load_relaxes_exponentially_at_any_sampling():
    effect = Creep(parts=(Relaxation(amplitude_arcsec=6, tau_s=2),), build_up=0.01)
    for rest in ([2.0, 4.0, 10.0], [0.3, 1.9, 2.0, 3.0, 4.0, 7.7, 10.0]):
        time_s = np.array([0.0, 1.0, *[1.0 + each for each in rest]])
        angle = np.array([0.0, *[100.0] * (len(rest) + 1)])
        error = dict(zip(time_s, effect.predict(Motion(angle, time_s)), strict=True))
        for after in (2.0, 4.0, 10.0):
            assert error[1.0 + after] == pytest.approx(6 * math.exp(-after / 2))


def test_short_moves_strain_a_viscoelastic_gear_little():
    effect = Creep(parts=(Relaxation(amplitude_arcsec=6, tau_s=10),), build_up=1.0)
    error = effect.predict(Motion(np.array([0.0, 1.0, 1.0]), np.array([0.0, 1.0, 11.0])))
    assert error[1] == pytest.approx(6 * (1 - math.exp(-0.1)))
    assert error[2] == pytest.approx(error[1] * math.exp(-1))


def test_the_zero_follows_the_temperature_with_its_time_constant():
    effect = ZeroDrift(drift_arcsec_per_k=2, tau_s=600, reference_c=20)
    time_s = np.array([0.0, 600.0, 1200.0, 9000.0])
    error = effect.predict(
        Motion(np.zeros(4), time_s, {Channel.TEMPERATURE: np.array([20.0, 30.0, 30.0, 30.0])})
    )
    np.testing.assert_allclose(error, 20 * (1 - np.exp(-time_s / 600)), atol=1e-9)


def test_without_a_sensor_the_zero_warms_up_from_a_cold_start():
    effect = ZeroDrift(drift_arcsec_per_k=2, tau_s=600, driven_by="time", warm_up_k=15)
    error = effect.predict(Motion(np.zeros(3), np.array([100.0, 700.0, 1e5])))
    np.testing.assert_allclose(error, [0, 30 * (1 - math.exp(-1)), 30])


def test_ripple_and_loop_change_with_warmth():
    effect = AmplitudeDrift(
        orders=(ORDER_4,),
        loop=LOOP,
        ripple_percent_per_k=1,
        friction_percent_per_k=-2,
        tau_s=60,
        reference_c=20,
    )
    motion = Motion(
        np.array([0.0, 100.0]), np.array([0.0, 1.0]), {Channel.TEMPERATURE: np.array([30.0, 30.0])}
    )
    ripple = Synchronous(orders=(ORDER_4,)).predict(motion)
    np.testing.assert_allclose(effect.predict(motion, Start.FORWARD), 0.1 * ripple - 0.2 * 40)


def test_a_lag_over_a_long_record_keeps_its_precision():
    """The record has a million samples, half of them at steps a thousand times the time constant."""
    count = 200_000
    time_s = np.cumsum(np.where(np.arange(count) % 2, 1e-3, 1e3))
    temperature = 20.0 + np.sin(np.arange(count))
    effect = ZeroDrift(drift_arcsec_per_k=1, tau_s=1.0)
    error = effect.predict(Motion(np.zeros(count), time_s, {Channel.TEMPERATURE: temperature}))
    tracker = effect.tracker()
    for i in range(2000):
        on_line = tracker.advance(
            0.0, Moment(float(time_s[i]), readings({Channel.TEMPERATURE: float(temperature[i])}))
        )
        assert error[i] == pytest.approx(on_line, abs=1e-9)


STEEP = [
    LocalDefect(ratio=50, height_arcsec=5, centre_deg=10, half_width_deg=3),
    LocalDefect(ratio=50, height_arcsec=-5, centre_deg=10, half_width_deg=3),
    Synchronous(orders=(ORDER_4,)),
    FlexsplineOrders(orders=(ORDER_4,), ratio=50),
    LoadOrders(orders=(ORDER_4,), ratio=50),
    DirectionPhase(orders=(ORDER_4,), shift_deg=3),
    Backlash(gap_arcsec=10, crossing_deg=2),
    Wear(growth_arcsec_per_kiloturn=-40, width_deg=2, turns_before=1000, turns_limit=1000),
    Wear(growth_arcsec_per_kiloturn=-40, width_deg=2, exponent=0.5, turns_before=1000, turns_limit=1000),
    RatioError(ramp_arcsec_per_turn=-30),
]


@pytest.mark.parametrize("effect", STEEP, ids=lambda each: each.name)
def test_the_slope_bound_is_tight(effect):
    angle = np.linspace(0, 1000, 200_001)
    falls = -np.diff(effect.predict(Motion(angle), Start.BACKWARD)) / np.diff(angle)
    falls = falls[1:]  # in the first step the direction changes, which the command causes
    bound = effect.slope_bound_arcsec_per_deg()
    assert 0.99 * bound <= falls.max() <= bound * (1 + 1e-6)


# ---- mutations that no other test detects -------------------------------------------------------


def test_the_discrepancy_of_a_drag_is_its_derivative_by_the_exponent_of_the_thinning():
    drag = VelocityWindup(coulomb_arcsec=0.0, viscous_arcsec_s_per_deg=0.02, shear_deg_s=400.0)
    motion = Motion(1e-3 * np.arange(0.0, 4000.0) ** 2, np.arange(0.0, 40.0, 0.01))
    speed = np.array([each.motor_speed_deg_s for each in moments(motion)])

    def viscous(exponent: float) -> np.ndarray:
        return -0.02 * speed / (1.0 + (np.abs(speed) / 400.0) ** exponent)

    derivative = (viscous(1.0 + 1e-5) - viscous(1.0 - 1e-5)) / 2e-5
    (found,) = drag.law_discrepancy(motion).T
    scale = float(found @ derivative / (derivative @ derivative))
    assert scale > 0.0
    assert found == pytest.approx(scale * derivative, rel=1e-4, abs=1e-6)


def test_time_that_goes_back_does_not_change_what_has_crept():
    tracker = Creep(parts=(Relaxation(amplitude_arcsec=5.0, tau_s=10.0),), build_up=0.1).tracker()
    tracker.advance(0.0, Moment(time_s=0.0))
    crept = tracker.advance(10.0, Moment(time_s=1.0, motor_speed_deg_s=10.0))
    assert tracker.peek(10.0, Moment(time_s=0.5)) == crept != 0.0


def test_a_grid_of_two_values_is_a_quarter_of_the_range_from_either_end():
    shape = next(each for each in LocalDefect.candidate(50.0).shape if each.name == "centre_deg")
    assert shape.grid(1) == (180.0,)
    assert shape.grid(2) == (90.0, 270.0)
