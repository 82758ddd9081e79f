"""Models as truth files: the simulated drive errs like the model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.demo import AXIS as DEMO
from support.demo import TRUTH
from support.effect_examples import EXAMPLES
from support.exercised import moved, record_of
from support.keys import changed

from hdbridge.axis import AxisConfig, effects
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.sim import fast
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from hdbridge.twin.parameters import default_truth, with_load_encoder
from hdbridge.twin.translate import TABLE, translate

N = 50.0


def fine_axis() -> AxisConfig:
    """Returns the demo's axis with encoders whose counts are negligible, one of them counting down."""
    motor = DEMO.motor_encoder.model_copy(update={"counts_per_turn": 800_000, "direction": -1})
    load = DEMO.load_encoder.model_copy(update={"counts_per_turn": 28_800_000})
    return DEMO.model_copy(update={"motor_encoder": motor, "load_encoder": load})


AXIS = fine_axis()
ORDERS = tuple(
    effects.MotorOrder(order=k, amplitude_arcsec=a, phase_deg=p)
    for k, a, p in [(1, 6.4, 38.0), (2, 13.7, 161.5)]
)
FURTHER = tuple(
    effects.MotorOrder(order=k, amplitude_arcsec=a, phase_deg=p)
    for k, a, p in [(1, 9.0, -70.0), (2, 5.0, 25.0)]
)
LOOP = {"offset_arcsec": 30.0, "width_deg": 25.0, "exponent": 1.7}
BASIC: tuple[effects.Effect, ...] = (effects.Synchronous(orders=ORDERS), effects.Hysteresis(**LOOP))


to_and_fro = moved(*((each, 60.0, 200.0, 0.5) for each in (150.0, -200.0, 100.0, -10.0, 12.0, -20.0, 150.0)))
"""Slow moves both ways, with reversals inside the loop."""
far = moved((360.0 * N, 900.0, 400.0, 0.0), (-360.0 * N, 900.0, 400.0, 0.0))
"""A load turn each way."""
several_speeds = moved(
    *((way * (200.0 + speed), speed, 1500.0, 0.4) for speed in (60.0, 200.0, 900.0) for way in (1.0, -1.0))
)
nested = moved(
    (60.0, 30.0, 200.0, 0.0),
    *((way, 30.0, 200.0, 0.0) for k in (2.0, 4.0, 8.0, 12.0) for way in (-60.0, 60.0 - k, -k, k, k)),
)
"""Small back-steps within the loop, each undone."""
rests = moved((800.0, 200.0, 800.0, 8.0), (-800.0, 200.0, 800.0, 8.0))
within_lines = moved((60.0, 20.0, 100.0, 0.0))
"""Slowly over some lines of the load encoder."""


def stand(bench: Exercise) -> None:
    bench.hold(4.0)


def brisk(bench: Exercise) -> None:
    """Moves in sines with high acceleration, but without steps of it that would make the load ring."""
    bench.sine(200.0, 0.5, 3.0)
    bench.sine(100.0, 1.0, 3.0)


def warming(truth: Truth) -> Truth:
    """Returns a truth with an ambient temperature that rises by a kelvin per second, and an axis that starts
    warmer.
    """
    heat = {"ambient_k_per_hour": 3600.0, "time_constant_s": 0.5, "start_c": 25.0}
    return changed(truth, **{f"temperature__{key}": value for key, value in heat.items()})


def hanging(truth: Truth) -> Truth:
    """Returns a truth with a mass that causes up to 5.9 Nm on the axis."""
    return changed(truth, load__gravity={"mass_kg": 3.0, "arm_m": 0.2, "down_deg": -60.0})


@dataclasses.dataclass(frozen=True)
class Case:
    """An effect in a model, a motion that shows it, and its permitted residual."""

    parts: tuple[effects.Effect, ...]
    lead: Callable[[Exercise], None] = to_and_fro
    left: float = 0.03
    """Permitted rms residual, as a fraction of the effect's own signal, if the plant's law has a different
    shape.
    """
    floor_arcsec: float = 0.5
    """Permitted residual due to the plant's dynamics at these speeds."""
    plant: Callable[[Truth], Truth] = lambda truth: truth
    in_python: bool = False
    """True if the plant runs uncompiled, because compiling an axis with that many elements takes far
    longer.
    """


SPRING = effects.Compliance(
    c1_arcsec_per_nm=14.0, c2_arcsec_per_nm=10.0, c3_arcsec_per_nm=8.0, torque1_nm=2.0, torque2_nm=4.0
)
BY_TEMPERATURE = {"tau_s": 3.0, "reference_c": 24.0}
CASES = {
    "synchronous": Case((effects.Synchronous(orders=ORDERS),)),
    "hysteresis": Case((effects.Hysteresis(**LOOP),)),
    "motor_order": Case((*BASIC, effects.MotorOrders(orders=FURTHER))),
    "motor_encoder_eccentricity": Case((*BASIC, effects.MotorEncoderEccentricity(orders=FURTHER))),
    "load_order": Case((*BASIC, effects.LoadOrders(ratio=N, orders=FURTHER, origin="load_encoder")), far),
    "flexspline_order": Case((*BASIC, effects.FlexsplineOrders(ratio=N, orders=FURTHER)), far),
    "direction_phase": Case((*BASIC, effects.DirectionPhase(orders=ORDERS, shift_deg=4.0))),
    "torque_modulation": Case(
        (*BASIC, SPRING, effects.TorqueModulation(orders=ORDERS, growth_percent_per_nm=8.0)),
        far,
        plant=hanging,
    ),
    "compliance": Case((*BASIC, SPRING), far, plant=hanging),
    "inertial_windup": Case(
        (BASIC[0], effects.InertialWindup(ratio=N, inertia_over_stiffness_s2=4e-5)), brisk
    ),
    "velocity_windup": Case(
        (
            *BASIC,
            effects.VelocityWindup(coulomb_arcsec=8.0, viscous_arcsec_s_per_deg=0.1, shear_deg_s=300.0),
            effects.InertialWindup(ratio=N, inertia_over_stiffness_s2=2e-5),
        ),
        several_speeds,
        left=0.05,
    ),
    "channel_skew": Case(
        (*BASIC, effects.ChannelSkew(ratio=N, delay_ms=2.0, second_order_ms2=4.0)),
        several_speeds,
        floor_arcsec=2.0,
    ),
    "backlash": Case((*BASIC, effects.Backlash(gap_arcsec=40.0, crossing_deg=40.0 * N / 3600.0)), left=0.15),
    "hysteresis_memory": Case((BASIC[0], effects.HysteresisMemory(**LOOP)), nested, in_python=True),
    "hysteresis_parameters": Case(
        (
            *BASIC,
            effects.HysteresisParameters(
                base=effects.Loop(**LOOP), **{**LOOP, "offset_arcsec": 50.0, "width_deg": 12.0}
            ),
        )
    ),
    "rate_dependence": Case(
        (
            *BASIC,
            effects.RateDependence(loop=effects.Loop(**LOOP), growth_percent=40.0, reference_deg_s=30.0),
        ),
        several_speeds,
        left=0.15,
        floor_arcsec=1.5,
    ),
    "subdivisional_error": Case(
        (
            *BASIC,
            effects.SubdivisionalError(
                lines_per_turn=9000,
                orders=tuple(
                    effects.MotorOrder(order=k, amplitude_arcsec=1.5, phase_deg=p)
                    for k, p in [(1, 50.0), (2, -110.0), (4, 90.0)]
                ),
            ),
        ),
        within_lines,
        left=0.15,
    ),
    "zero_drift": Case(
        (*BASIC, effects.ZeroDrift(drift_arcsec_per_k=3.0, **BY_TEMPERATURE)), rests, plant=warming
    ),
    "amplitude_drift": Case(
        (
            *BASIC,
            effects.AmplitudeDrift(
                orders=ORDERS,
                loop=effects.Loop(**LOOP),
                ripple_percent_per_k=5.0,
                friction_percent_per_k=-3.0,
                tau_s=0.02,
                reference_c=24.0,
            ),
        ),
        plant=warming,
    ),
    "wear": Case(
        (*BASIC, effects.Wear(growth_arcsec_per_kiloturn=-1000.0, width_deg=0.3, exponent=0.9)),
        several_speeds,
        left=0.1,
    ),
    "creep": Case(
        (*BASIC, effects.Creep(parts=(effects.Relaxation(amplitude_arcsec=-12.0, tau_s=1.5),))), rests
    ),
    "ratio_error": Case((*BASIC, effects.RatioError(ramp_arcsec_per_turn=20.0))),
    "count_loss": Case((*BASIC, effects.CountLoss(steps=(effects.Step(time_s=8.0, size_arcsec=-25.0),)))),
    "vibration": Case(
        (*BASIC, effects.Vibration(frequency_hz=7.0, amplitude_arcsec=9.0, phase_deg=40.0)), stand, left=0.1
    ),
    "local_defect": Case(
        (*BASIC, effects.LocalDefect(ratio=N, height_arcsec=-30.0, centre_deg=80.0, half_width_deg=6.0)), far
    ),
}


BEFORE_DEG = 60.0
"""First move, which determines the state of the loop; before it, model and plant begin differently."""


def exercised(truth: Truth, lead: Callable[[Exercise], None]) -> Record:
    """Record of a first move and of the motion after it."""

    def both(bench: Exercise) -> None:
        bench.move(BEFORE_DEG, 100.0, 300.0)
        bench.hold(0.5)
        lead(bench)

    return record_of(truth, both)


def predicted(parts: tuple[effects.Effect, ...], record: Record) -> np.ndarray:
    target, time_s = record.columns["motor_target_deg"], record.time_s
    speed = np.round(np.gradient(target, time_s), 6)  # the target at rest varies by a rounding error
    motion = dataclasses.replace(
        record.motion(),
        motor_deg=record.motor_position_deg,
        motor_speed_deg_s=speed,
        motor_acceleration_deg_s2=np.gradient(speed, time_s),
        load_deg=record.load_position_deg,
    )
    return after(record, TransmissionModel(N, parts).predict(motion))


def after(record: Record, error: np.ndarray) -> np.ndarray:
    """Returns the signal after the first move, without its mean."""
    begun = int(np.argmax(record.columns["motor_target_deg"] >= BEFORE_DEG))
    return error[begun:] - error[begun:].mean()


def test_every_effect_of_the_catalogue_has_its_row() -> None:
    assert set(TABLE) == set(effects.CATALOGUE)
    assert set(CASES) == set(effects.CATALOGUE), "a new effect needs a case here that shows its translation"


@pytest.mark.parametrize("name", CASES)
def test_the_simulated_drive_errs_as_the_model_says(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES[name]
    if case.in_python:
        monkeypatch.setenv(fast.SWITCH, "0")
    base = case.plant(default_truth(AXIS))
    # A spring that no effect needs would wind up without the model's knowledge.
    translation = translate(
        AXIS, TransmissionModel(N, case.parts), base if base != default_truth(AXIS) else None
    )
    record = exercised(with_load_encoder(translation.truth, noise_arcsec=0.0), case.lead)
    error = after(record, record.transmission_error_arcsec(N))
    prediction = predicted(case.parts, record)
    own = prediction - predicted(tuple(each for each in case.parts if each.name != name), record)
    size = float(np.sqrt(np.mean(own**2)))
    left = float(np.sqrt(np.mean((error - prediction) ** 2)))
    allowed = case.left * size + case.floor_arcsec
    assert left < allowed, f"{left:.2f} arcsec of {size:.2f} are left"
    assert allowed < 0.5 * size, "a drive without the effect would pass"
    assert [row.effect for row in translation.rows if row.counterpart is None] == []


LAG = {"offset_arcsec": -25.0, "width_deg": 25.0, "exponent": 2.5}


@pytest.mark.parametrize("law", [effects.Hysteresis, effects.HysteresisMemory])
def test_a_loop_in_which_the_load_lags_is_friction_at_the_load(law: type[effects.Effect]) -> None:
    parts = (law(**LAG),)
    translation = translate(AXIS, TransmissionModel(N, parts))
    record = exercised(with_load_encoder(translation.truth, noise_arcsec=0.0), to_and_fro)
    error, prediction = after(record, record.transmission_error_arcsec(N)), predicted(parts, record)
    assert np.std(error - prediction) < 0.08 * np.std(prediction)
    assert translation.truth.gear.hysteresis is None
    assert translation.truth.load_.presliding


def test_effects_beyond_the_plant_are_reported() -> None:
    parts = (
        effects.Synchronous(
            orders=(*ORDERS, effects.MotorOrder(order=600, amplitude_arcsec=1.0, phase_deg=0.0))
        ),
        effects.TorqueModulation(orders=ORDERS, growth_percent_per_nm=1.0, signed=True),
        effects.Wear(growth_arcsec_per_kiloturn=10.0, width_deg=2.0),
        effects.CountLoss(steps=(effects.Step(time_s=-5.0, size_arcsec=3.0),)),
        effects.Vibration(frequency_hz=900.0, amplitude_arcsec=1.0, phase_deg=0.0),
    )
    rows = {row.effect: row for row in translate(AXIS, TransmissionModel(N, parts)).rows}
    assert "600" in rows["synchronous"].note
    for name in ("torque_modulation", "wear", "count_loss", "vibration"):
        assert rows[name].counterpart is None
        assert rows[name].note


def test_unreachable_spring_stages_are_omitted() -> None:
    """A diagnosis gives a linear spring two further stages, which begin beyond any reachable torque."""
    linear = effects.Compliance(
        c1_arcsec_per_nm=31.0,
        c2_arcsec_per_nm=0.0,
        c3_arcsec_per_nm=0.0,
        torque1_nm=10_000.0,
        torque2_nm=20_000.0,
    )
    made = translate(AXIS, TransmissionModel(AXIS.gear.ratio, (linear,)))
    assert made.truth.gear.stiffening is None
    assert made.truth.gear.stiffness_nm_per_rad == pytest.approx(206_264.8 / 31.0)
    assert made.truth.substep_ms == translate(AXIS).truth.substep_ms
    assert [row.note for row in made.rows] == [""]


def test_custom_effects_without_counterpart_are_reported() -> None:
    class Draught(effects.Synchronous):
        """Effect outside the catalogue."""

        name: ClassVar[str] = "draught"

    model = TransmissionModel(N, (Draught(orders=ORDERS), effects.Synchronous(orders=ORDERS)))
    translation = translate(AXIS, model)
    assert [(row.effect, row.counterpart) for row in translation.rows] == [
        ("synchronous", TABLE["synchronous"].counterpart),
        ("draught", None),
    ]
    assert "own catalogue" in translation.rows[-1].note
    assert translation.truth == translate(AXIS, TransmissionModel(N, model.effects[1:])).truth


@pytest.mark.parametrize("name", effects.CATALOGUE)
@given(st.data())
@settings(max_examples=10, deadline=None)
def test_any_effect_makes_a_plant_that_moves(name: str, data: st.DataObject) -> None:
    effect = data.draw(EXAMPLES[name])
    others = tuple(each for each in BASIC if each.name not in {name, effect.replaces})
    translation = translate(AXIS, TransmissionModel(N, (*others, effect)))
    row = next(row for row in translation.rows if row.effect == name)
    assert row.counterpart or row.note
    machine = Machine(translation.truth, 0)
    machine.follow(0.0, -200.0, 8)
    assert abs(machine.true_load_deg) < 1.0


def test_values_outside_the_model_are_unchanged() -> None:
    translation = translate(AXIS, TransmissionModel(N, BASIC), TRUTH)
    truth = translation.truth
    assert truth.servo == TRUTH.servo
    assert truth.load_.inertia_kg_m2 == TRUTH.load_.inertia_kg_m2
    assert truth.gear.stiffness_nm_per_rad == TRUTH.gear.stiffness_nm_per_rad
    assert [each.order for each in truth.gear.motor_orders] == [1, 2]
    assert (truth.motor.encoder.counts_per_turn, truth.motor.encoder.direction) == (800_000, -1)
    assert translate(AXIS, None, TRUTH).truth.gear == TRUTH.gear


def test_a_plant_of_usual_values_follows_its_axis_file() -> None:
    truth = translate(DEMO).truth
    record = exercised(truth, to_and_fro)
    behind = record.columns["motor_target_deg"] - record.motor_position_deg
    assert np.max(np.abs(behind)) < 1.0, "motor degrees"
    assert np.max(np.abs(record.columns["motor_torque_nm"])) < truth.motor.rated_torque_nm
    assert 30.0 < truth.load_frequency_hz < 50.0


def test_a_model_of_another_gear_is_refused() -> None:
    with pytest.raises(InputError, match="ratio"):
        translate(AXIS, TransmissionModel(80.0, BASIC))
