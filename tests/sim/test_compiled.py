"""The compiled axis equals the Python one bit for bit for any truth file."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.exercised import booted
from support.keys import with_keys

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.sim import fast
from hdbridge.sim.axis import Axis
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

compiled = pytest.importorskip("hdbridge.sim.compiled")

ARTICLE = Path(__file__).parents[2] / "profiles" / "article"
DATA = Truth.load(ARTICLE).model_dump(by_alias=True)
PLACES = (
    "motor_counts",
    "load_counts",
    "velocity_counts_s",
    "torque_nm",
    "temperature_c",
    "load_torque_nm",
    "true_motor_deg",
    "true_load_deg",
    "true_output_deg",
)


@pytest.fixture(autouse=True)
def may_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(fast.SWITCH, "1")
    monkeypatch.setattr(fast.waiting, "left", 0)


def truth(changes: dict[str, Any]) -> Truth:
    """The article's axis with keys like ``load__gravity`` changed."""
    return Truth.model_validate(with_keys(DATA, changes))


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


ORDERS = st.lists(
    st.builds(
        lambda order, amplitude, phase: {
            "order": order,
            "amplitude_arcsec": amplitude,
            "phase_deg": phase,
        },
        st.integers(1, 12),
        numbers(0.0, 15.0),
        numbers(-180.0, 180.0),
    ),
    max_size=4,
    unique_by=lambda each: each["order"],
)
LAWS = st.one_of(
    st.none(),
    st.fixed_dictionaries(
        {
            "law": st.just("rolling_friction"),
            "offset_arcsec": numbers(1.0, 60.0),
            "width_deg": numbers(1.0, 40.0),
            "exponent": st.one_of(st.just(2.0), numbers(1.1, 3.0)),
        }
    ),
    st.fixed_dictionaries(
        {
            "law": st.just("maxwell_slip"),
            "elements": st.lists(
                st.fixed_dictionaries({"limit_arcsec": numbers(1.0, 30.0), "yield_deg": numbers(0.5, 30.0)}),
                min_size=1,
                max_size=6,
            ),
        }
    ),
    st.fixed_dictionaries(
        {
            "law": st.just("bouc_wen"),
            "offset_arcsec": numbers(1.0, 60.0),
            "yield_deg": numbers(1.0, 30.0),
            "exponent": numbers(1.0, 3.0),
            "beta": numbers(0.5, 1.0),
        }
    ),
    st.fixed_dictionaries(
        {
            "law": st.just("dahl"),
            "offset_arcsec": numbers(1.0, 60.0),
            "yield_deg": numbers(1.0, 30.0),
            "exponent": st.one_of(st.just(1.0), numbers(0.5, 2.0)),
        }
    ),
)
SOMETIMES = {
    "gear__motor_orders": ORDERS,
    "gear__flexspline_orders": ORDERS,
    "gear__load_orders": ORDERS,
    "gear__hysteresis": LAWS,
    "gear__second_hysteresis": LAWS,
    "gear__ratio": numbers(30.0, 160.0),
    "gear__torque_growth_per_nm": numbers(0.0, 0.01),
    "gear__flank": st.just({"shift_deg": 2.0, "travel_deg": 9.0}),
    "gear__rate_dependence": st.just({"growth_per_decade": 0.2, "from_deg_s": 3.0}),
    "gear__wear": st.just({"arcsec_per_1000_turns": 900.0, "exponent": 0.7}),
    "gear__ageing": st.just(
        {
            "duration_s": 3.0,
            "hysteresis_growth": 0.3,
            "motor_orders": [{"order": 3, "amplitude_arcsec": 4.0, "phase_deg": 10.0}],
        }
    ),
    "gear__creep": st.just([{"time_constant_s": 0.3, "amplitude_arcsec": 4.0, "arcsec_per_nm": 0.2}]),
    "gear__jumps": st.just([{"time_s": 0.2, "teeth": 1}, {"time_s": 0.5, "teeth": -1}]),
    "gear__damage": st.just([{"at_deg": 0.5, "width_deg": 2.0, "height_arcsec": 12.0}]),
    "gear__roller": st.just({"order": 1.37, "amplitude_arcsec": 3.0, "sharpness": 2.2}),
    "gear__stiffening": st.just(
        {
            "first_torque_nm": 2.0,
            "second_stiffness_nm_per_rad": 19_000.0,
            "second_torque_nm": 5.0,
            "third_stiffness_nm_per_rad": 23_000.0,
        }
    ),
    "gear__backlash_arcsec": numbers(0.0, 20.0),
    "load__inertia_kg_m2": numbers(0.12, 0.5),
    "load__coulomb_nm": numbers(0.0, 1.0),
    "load__viscous_nm_s_per_rad": numbers(0.0, 4.0),
    "load__stribeck": st.just({"breakaway_nm": 1.4, "speed_rad_s": 0.03}),
    "load__thinning": st.just({"speed_rad_s": 0.1, "exponent": 0.6}),
    "load__gravity": st.just({"mass_kg": 1.0, "arm_m": 0.2, "down_deg": 30.0, "tilt_deg": 5.0}),
    "load__vibration": st.just([{"frequency_hz": 11.0, "torque_nm": 0.3, "phase_deg": 20.0}]),
    "load__presliding": st.just([{"limit_nm": 0.4, "travel_deg": 0.1}, {"limit_nm": 0.2, "travel_deg": 0.3}]),
    "load__encoder__coupling": st.one_of(
        st.none(), st.just({"frequency_hz": 150.0, "damping_ratio": 0.1, "play_arcsec": 3.0})
    ),
    "load__encoder__late_ms": numbers(0.0, 6.0),
    "load__encoder__noise_arcsec": numbers(0.0, 1.0),
    "load__encoder__cable": st.just({"taut_from_deg": 0.1, "arcsec_per_deg": 4.0, "drag": 0.3}),
    "load__encoder__sensor_warming": st.just({"arcsec_at_10_deg_s": 20.0, "time_constant_s": 0.5}),
    "motor__encoder__late_ms": numbers(0.0, 6.0),
    "motor__encoder__disc": st.just({"eccentricity_um": 1.5, "radius_mm": 20.0, "ovality_um": 0.4}),
    "load__encoder__disc": st.just({"eccentricity_um": 2.5, "radius_mm": 30.0}),
    "load__encoder__losses": st.just([{"time_s": 0.4, "counts": -7}, {"time_s": 0.2, "counts": 3}]),
    "load__encoder__signals": st.just({"lines_per_turn": 1800, "sine_offset": 0.02, "third_harmonic": 0.01}),
    "motor__encoder__losses": st.just([{"time_s": 0.3, "counts": 3}]),
    "motor__coulomb_nm": numbers(0.0, 0.06),
    "motor__stribeck": st.just({"rise": 0.6, "speed_rad_s": 2.0}),
    "servo__dead_time_ms": numbers(0.0, 3.0),
    "servo__moving_average_ms": numbers(0.0, 5.0),
    "servo__speed_filter_ms": numbers(0.0, 2.0),
    "servo__torque_filter_ms": numbers(0.0, 2.0),
    "servo__integral_of": st.sampled_from(["speed", "position"]),
    "servo__notch": st.just({"frequency_hz": 80.0, "depth": 0.2, "width": 0.7}),
    "servo__observer": st.just({"frequency_hz": 60.0, "share": 0.8, "inertia_kg_m2": 3e-5}),
    "servo__load_feedforward": st.none(),
    "servo__torque_limit_percent": numbers(20.0, 300.0),
    "temperature__copper_loss_w": numbers(0.0, 50.0),
    "temperature__zero_drift_arcsec_per_k": numbers(-3.0, 3.0),
    "temperature__zero_time_constant_s": numbers(0.0, 5.0),
    "temperature__friction_growth_per_k": numbers(-0.02, 0.02),
    "temperature__tooth_growth_per_k": numbers(-0.02, 0.02),
}


@st.composite
def truths(draw: st.DrawFn) -> Truth:
    chosen = draw(st.lists(st.sampled_from(sorted(SOMETIMES)), unique=True, max_size=14))
    return truth({name: draw(SOMETIMES[name]) for name in chosen})


def led(machine: Machine, seed: int, cycles: int = 150) -> list[tuple[Any, ...]]:
    """Readings in moves, at rest and without power."""
    lot = random.Random(seed)
    rows, place, speed = [], 0.0, 0.0
    for cycle in range(cycles):
        if cycle % 61 == 50:
            machine.coast(lot.randrange(9), lot.random() < 0.5)
            place, speed = float(machine.motor_counts), 0.0
        if cycle % 23 == 0:
            speed = lot.choice((0.0, lot.uniform(-25.0, 25.0), lot.uniform(-1.0, 1.0)))
        machine.torque_limit_permille = lot.choice((3000.0, 800.0))
        machine.follow(place, place + speed, lot.choice((8, 8, 3)))
        place += speed
        rows.append(tuple(getattr(machine, each) for each in PLACES))
    return rows


@settings(max_examples=20)
@given(truths(), st.integers(0, 1000))
def test_compiled_and_python_agree_bit_for_bit(known: Truth, seed: int) -> None:
    ours, theirs = Machine(known, seed), Machine(known, seed, may_compile=True)
    assert led(ours, seed) == led(theirs, seed)
    assert isinstance(ours._axis, Axis)
    assert isinstance(theirs._axis, compiled.CompiledAxis)


def test_a_held_motor_starts_from_its_torque_compiled_or_not() -> None:
    known = truth({"motor__coulomb_nm": 0.05})
    counts = [0.0] * 20 + [4.0 * cycle for cycle in range(60)]
    held_nm = np.full(len(counts) - 1, np.nan)
    held_nm[15] = -0.04
    found = []
    for may_compile in (False, True):
        machine = Machine(known, 1, may_compile=may_compile)
        found.append(machine.follow_all(counts, [8] * len(held_nm), held_nm=held_nm))
        assert found[-1].torque_nm[14] == 0.0
        assert found[-1].torque_nm[15:19] == pytest.approx(-0.04, abs=0.000501 * known.motor.rated_torque_nm)
    for ours, theirs in zip(*found, strict=True):
        assert np.array_equal(ours, theirs)


def test_compilation_may_take_over_during_a_bench_run(monkeypatch: pytest.MonkeyPatch) -> None:
    axis, known = AxisConfig.load(ARTICLE / "axis.yaml"), Truth.load(ARTICLE)

    def record() -> dict[str, np.ndarray]:
        with booted(axis, known, 1) as (drive, node):
            columns = Bench(drive).run(Stepping(count=3)).record.columns
            axes.append(node.firmware.motion.machine._axis)  # type: ignore[attr-defined]
            return dict(columns)

    axes: list[object] = []
    monkeypatch.setattr(fast.waiting, "left", 10**9)
    before = record()
    monkeypatch.setattr(fast.waiting, "left", 4000)
    after = record()
    assert [type(each) for each in axes] == [Axis, compiled.CompiledAxis]
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_uncompilable_truths_stay_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    seat = truth({"gear__seat": {"slip_arcsec": 5.0, "travel_deg": 200.0}})
    with pytest.raises(compiled.Uncompilable, match="Seat"):
        compiled.CompiledAxis(Axis(seat))
    axis = Axis(seat)
    assert fast.compiled_axis(axis) is axis
    monkeypatch.setenv(fast.SWITCH, "0")
    assert led(Machine(seat, 1, may_compile=True), 1, 20) == led(Machine(seat, 1), 1, 20)
    axis = Axis(truth({}))
    assert fast.compiled_axis(axis) is axis


def test_a_mismatch_falls_back_to_python(monkeypatch: pytest.MonkeyPatch) -> None:
    class Wrong(compiled.CompiledAxis):  # type: ignore[misc]
        def drive(self, *arguments: Any) -> Any:
            first, *rest = super().drive(*arguments)
            return (np.nextafter(first, 1e9), *rest)

    axis = Axis(truth({}))
    monkeypatch.setattr(fast, "_agreeing", {})
    monkeypatch.setattr(compiled, "CompiledAxis", Wrong)
    assert fast.compiled_axis(axis) is axis


def test_every_state_of_the_simulation_is_known_to_the_compiler() -> None:
    known = {cls for kinds in compiled.KINDS.values() for cls in kinds.classes}
    for protocol, kinds in compiled.KINDS.items():
        (method,) = [
            name for name in vars(protocol) if not name.startswith("_") and callable(getattr(protocol, name))
        ]
        assert kinds.classes
        assert all(hasattr(cls, method) for cls in kinds.classes)
    assert known <= set(compiled.STATES)


def states_in(value: Any) -> Iterator[Any]:
    """The state objects of an axis."""
    if type(value) in compiled.STATES:
        yield value
        for each in vars(value).values():
            yield from states_in(each)
    elif isinstance(value, tuple | list):
        for each in value:
            yield from states_in(each)


@given(truths())
def test_every_attribute_of_a_state_has_its_declared_type_or_is_a_float(known: Truth) -> None:
    for each in states_in(Axis(known)):
        declared = compiled._attributes(type(each))
        assert vars(each).keys() == declared.keys()
        for name, kind in declared.items():
            assert kind not in {float, int, bool} or type(getattr(each, name)) is kind


@pytest.mark.parametrize("may_compile", [False, True])
def test_a_copy_of_a_machine_moves_like_it_and_alone(may_compile: bool) -> None:
    known = truth({"load__encoder__noise_arcsec": 1.0})
    machine = Machine(known, 7, may_compile=may_compile)
    machine.follow(0.0, 900.0, 8)
    copies = [machine.copy(), machine.copy()]
    assert [type(each._axis) for each in copies] == [type(machine._axis)] * 2
    found = [led(each, 3, 20) for each in (copies[0], machine, copies[1])]
    assert found[0] == found[1] == found[2]


def test_an_external_torque_acts_alike_compiled_or_not() -> None:
    """The load yields with the spring alone, because this torque does not break the motor away."""
    made = truth({})
    outer_nm = np.concatenate([np.zeros(20), np.full(300, 0.2)])
    runs = [
        Machine(made, 7, may_compile=each, loaded=True).follow_all([0.0] * 321, [4] * 320, outer_nm)
        for each in (False, True)
    ]
    assert all(np.array_equal(getattr(runs[0], name), getattr(runs[1], name)) for name in runs[0]._fields)
    per_arcsec = made.load_.encoder.counts_per_turn / 1_296_000.0
    yields_arcsec = np.diff(runs[0].load_reading[[19, 319]])[0] / per_arcsec
    assert yields_arcsec == pytest.approx(0.2 * 206_265.0 / made.gear.stiffness_nm_per_rad, rel=0.02)
    assert runs[0].load_torque_nm[-1] == 0.2


@pytest.mark.parametrize("may_compile", [False, True])
def test_a_load_sensor_reads_external_torque_without_power(may_compile: bool) -> None:
    machine = Machine(truth({}), 7, may_compile=may_compile, loaded=True)
    machine.follow(0.0, 0.0, 4)
    machine.coast(4, True, 0.2)
    assert machine.load_torque_nm == 0.2


def test_batched_cycles_equal_single_cycles() -> None:
    wrong: dict[str, Any] = {"motor__encoder__late_ms": 0.3, "load__encoder__noise_arcsec": 1.0}
    wrong["load__encoder__signals"] = {"lines_per_turn": 1800, "cosine_offset": 0.03}
    wrong["load__encoder__losses"] = wrong["motor__encoder__losses"] = [{"time_s": 0.1, "counts": 5}]
    made = truth(wrong | {"temperature__friction_growth_per_k": -0.01, "temperature__copper_loss_w": 40.0})
    counts = [0.0] * 5 + [float(100 * k) for k in range(60)] + [5_900.0] * 20
    substeps = [3 + k % 2 for k in range(len(counts) - 1)]
    at_once, each = Machine(made, 7, may_compile=True), Machine(made, 7, may_compile=True)
    run = at_once.follow_all(counts, substeps)
    for cycle, steps in enumerate(substeps):
        each.follow(counts[cycle], counts[cycle + 1], steps)
        for name in run._fields:
            assert getattr(run, name)[cycle] == getattr(each, name), (name, cycle)
    each.follow(counts[-1], counts[-1] + 90.0, 4)
    at_once.follow(counts[-1], counts[-1] + 90.0, 4)
    assert {name: getattr(each, name) for name in PLACES} == {name: getattr(at_once, name) for name in PLACES}
