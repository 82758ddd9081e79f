"""The axis file: its meaning, and one exact line for every error."""

# ruff: noqa: E501  (the table of complaints shows each on one line)

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig, MotorEncoder
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_folder, bundled_profile

from .conftest import AXIS as GOOD


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "test.eds").write_text("")
    return tmp_path


def load(folder: Path, text: str) -> AxisConfig:
    (folder / "axis.yaml").write_text(text)
    return AxisConfig.load(folder / "axis.yaml")


def test_a_valid_file_gives_nested_values_and_defaults(folder):
    axis = load(folder, GOOD)
    assert (axis.name, axis.drive.cycle_s, axis.drive.interpolation_period) == ("test", 0.004, (4, -3))
    assert (axis.drive.heartbeat_ms, axis.drive.master_node_id, axis.drive.quick_stop_option) == (50, 127, 2)
    assert (axis.load_encoder.source.index, axis.load_encoder.source.wraps_at_counts) == (0x60E4, 2**32)
    assert (axis.realtime.priority, axis.realtime.cpus) == (50, ())
    assert (axis.compensation.maximum_arcsec, axis.compensation.slew_arcsec_s, axis.compensation.ramp_s) == (
        300,
        20000,
        0.5,
    )
    assert axis.eds_path == (folder / "test.eds").resolve()
    assert axis.path == folder / "axis.yaml"
    assert axis.motor_encoder.resolution_arcsec / axis.gear.ratio == pytest.approx(3.24)
    assert AxisConfig.load(folder) == axis


@pytest.mark.parametrize(
    ("wanted", "given", "expected"),
    [
        ("cycle_ms: 4", "cycle_ms: 4.25", "8:13: drive.cycle_ms: 60C2h cannot express 4.25 ms: expected 1 to 255 whole milliseconds, or 0.5 to 25.5 ms with one decimal"),
        ("cycle_ms: 4", "cycle_ms: 25.6", "8:13: drive.cycle_ms: 60C2h cannot express 25.6 ms: expected 1 to 255 whole milliseconds, or 0.5 to 25.5 ms with one decimal"),
        ("cycle_ms: 4", "cycle_ms: 40", "5:3: drive: a heartbeat of 50 ms is too short for a cycle of 40 ms; expected heartbeat_ms of at least 80"),
        ("limits:", "realtime: {cpus: [3, 2, 3]}\nlimits:", "15:25: realtime.cpus[2]: processor 3 appears twice; expected it once"),
        ("cycle_ms: 4", "master_node_id: 1\n  cycle_ms: 4", "8:19: drive.master_node_id: node 1 is the drive (drive.node_id); expected another"),
        ("counts_per_turn: 8000", "counts_per_turn: 8000.0", "11:34: motor_encoder.counts_per_turn: found 8000.0; expected an integer from 1 to 2147483647 (counts per turn of the encoder's shaft, after multiplication)"),
        ("direction: -1", "source: {node: 1}", "12:57: load_encoder.source.node: node 1 is drive.node_id; expected another, or no key if the drive sends the reading"),
        ("direction: -1", "source: {node: 127}", "12:57: load_encoder.source.node: node 127 is drive.master_node_id; expected another, or no key if the drive sends the reading"),
        ("direction: -1", "source: {type: int16, range_counts: 65537}", "12:78: load_encoder.source.range_counts: int16 holds no more than 65536 counts"),
        ("ratio: 50", "ratio: .inf", "14:10: gear.ratio: found .inf; expected a finite number from 1 to 1000 (N, motor turns per load turn; a reversing gear has a direction of -1)"),
        ("ratio: 50", "ratio: 50\n  teeth: {flexspline: 80, circular_spline: 82}", "15:10: gear.teeth: 80 and 82 teeth do not give a ratio of 50: zf/(zc-zf) = 40 with flexspline output, 41 with circular-spline output; 50 needs 100 and 102"),
        ("ratio: 50", "ratio: 50\n  teeth: {flexspline: 80, circular_spline: 82, output: circular_spline}", "15:10: gear.teeth: 80 and 82 teeth do not give a ratio of 50: zf/(zc-zf) = 40 with flexspline output, 41 with circular-spline output; 50 needs 98 and 100"),
        ("ratio: 50", "ratio: 50.3\n  teeth: {flexspline: 100, circular_spline: 102}", "15:10: gear.teeth: 100 and 102 teeth do not give a ratio of 50.3: zf/(zc-zf) = 50 with flexspline output, 51 with circular-spline output; 50.3 needs other teeth"),
        ("ratio: 50", "ratio: 50\n  teeth: {flexspline: 102, circular_spline: 100}", "15:45: gear.teeth.circular_spline: 100 is not more than the flexspline's 102; expected the flexspline's teeth and (as a rule) two more"),
        ("position_min_deg: -400", "position_min_deg: 400", "17:21: limits.position_max_deg: found 400; expected more than position_min_deg, 400"),
        ("position_max_deg: 400", "position_max_deg: 2.0e+6", "17:21: limits.position_max_deg: 2e+06 deg is 2.22e+09 motor counts, more than 607Ah can hold (2147483647); expected a smaller range"),
        ("position_max_deg: 400", "position_max_deg: .nan", "17:21: limits.position_max_deg: found .nan; expected a finite number (highest position)"),
        ("torque_percent: 100", "torque_percent: 0.01", "21:19: limits.torque_percent: found 0.01; expected a number from 0.1 to 500 (highest motor torque (6072h), relative to the rated torque)"),
        ("velocity_deg_s: 20", "velocity_deg_s: 1e-12", "18:19: limits.velocity_deg_s: found 1e-12; expected a number from 0.001 to 100000 (highest speed)"),
        ("limits:", "load_torque: {source: {index: 0x60E4, subindex: 1, type: int32}, newton_metres_per_count: 0.001}\nlimits:", "15:31: load_torque.source.index: 60E4h:01 is load_encoder.source already; expected another object"),
        ("limits:", "load_torque: {source: {index: 0x2101, type: int32}, newton_metres_per_count: 0.001, hold_ms: 7}\nlimits:", "15:94: load_torque.hold_ms: 7 ms is too short for a reading every 4 ms (every_cycles 1); expected at least 8"),
        ("limits:", "temperature: {source: {index: 0x2100, type: int16}, celsius_per_count: 0.1, maximum_celsius: -40}\nlimits:", "15:94: temperature.maximum_celsius: found -40; expected more than minimum_celsius, -40"),
        ("name: test", "name: a b", "2:7: name: found 'a b'; expected text (name: letters, digits, '.', '_', '-')"),
        ("channel: test", "channel: [1]", "3:36: bus.channel: found a list; expected text or an integer (channel of that interface, for example can0)"),
        ("hdbridge.axis/1", "hdbridge.model/1", "1:9: schema: found 'hdbridge.model/1'; expected "
            "'hdbridge.axis/1' (schema and version of this file)"),
    ],
)  # fmt: skip
def test_a_wrong_file_gets_one_exact_line(folder, wanted, given, expected):
    """`test_file_reference` has the range of each key, `test_yaml_files` the texts for a value outside it."""
    assert wanted in GOOD
    with pytest.raises(InputError) as caught:
        load(folder, GOOD.replace(wanted, given, 1))
    assert str(caught.value) == f"{folder / 'axis.yaml'}:{expected}"


def test_a_missing_eds_is_one_line_with_both_places(folder):
    with pytest.raises(InputError) as caught:
        load(folder, GOOD.replace("test.eds", "other.eds"))
    assert str(caught.value) == (
        f"{folder / 'axis.yaml'}:6:8: drive.eds: 'other.eds' is neither in {folder} nor among the bundled EDS files "
        f"in {bundled_folder('eds')}; expected an EDS file there, or a different name here"
    )


@pytest.mark.parametrize(
    ("flexspline", "circular", "output", "ratio"),
    [(100, 102, "flexspline", 50), (80, 82, "flexspline", 40), (80, 82, "circular_spline", 41), (160, 161, "flexspline", 160)],
)  # fmt: skip
def test_teeth_that_give_the_ratio_are_accepted(folder, flexspline, circular, output, ratio):
    teeth = f"{{flexspline: {flexspline}, circular_spline: {circular}, output: {output}}}"
    axis = load(folder, GOOD.replace("ratio: 50", f"ratio: {ratio}\n  teeth: {teeth}"))
    assert axis.gear.teeth is not None
    assert axis.gear.teeth.ratio == axis.gear.ratio == ratio


@given(st.integers(5, 255), st.sampled_from([1, 10]))
def test_the_interpolation_period_is_the_cycle(tenths, factor):
    axis = AxisConfig.from_text(
        GOOD.replace("test.eds", str(Path(__file__))).replace(
            "cycle_ms: 4", f"cycle_ms: {tenths * factor / 10}\n  heartbeat_ms: 600"
        )
    )
    mantissa, exponent = axis.drive.interpolation_period
    assert 1 <= mantissa <= 255
    assert (
        axis.drive.cycle_s
        == float(f"{mantissa}e{exponent}")
        == pytest.approx(axis.drive.cycle_ms / 1000, rel=1e-15)
    )


@given(st.integers(1, 2**31 - 1), st.sampled_from([1, -1]), st.floats(-1e6, 1e6))
def test_counts_and_degrees_are_inverses_and_keep_the_direction(counts_per_turn, direction, deg):
    encoder = MotorEncoder(counts_per_turn=counts_per_turn, direction=direction)
    assert encoder.degrees(encoder.counts(deg)) == pytest.approx(deg, rel=1e-14, abs=1e-300)
    assert encoder.counts(360.0) == direction * counts_per_turn


def test_another_bus_keeps_everything_else(folder):
    axis = load(folder, GOOD.replace("channel: test", "channel: test, options: {receive_own_messages: true}"))
    other = axis.on_bus(interface="socketcan", channel="vcan0")
    assert (other.bus.interface, other.bus.channel, other.bus.options) == ("socketcan", "vcan0", {})
    assert axis.on_bus(channel="x").bus.options == {"receive_own_messages": True}
    assert (other.drive, other.limits, other.eds_path, other.path) == (
        axis.drive,
        axis.limits,
        axis.eds_path,
        axis.path,
    )


def test_an_unknown_profile_lists_the_known_ones():
    with pytest.raises(InputError) as caught:
        bundled_profile("articel")
    assert str(caught.value) == (
        "articel: no such file or folder, nor a bundled profile; expected a path or one of: article, demo; "
        "did you mean 'article'?"
    )


def test_bundled_files_are_found_in_a_wheel_and_in_a_working_copy(tmp_path):
    package = tmp_path / "site-packages" / "hdbridge"
    (package / "_bundled" / "eds").mkdir(parents=True)
    (package.parent / "eds").mkdir()  # an unrelated package of that name
    assert bundled_folder("eds", package) == package / "_bundled" / "eds"
    copy = tmp_path / "copy"
    (copy / "eds").mkdir(parents=True)
    (copy / "pyproject.toml").write_text("")
    assert bundled_folder("eds", copy / "hdbridge") == copy / "eds"


def test_the_line_of_a_key_is_known(tmp_path):
    path = tmp_path / "axis.yaml"
    text = (bundled_profile("article") / "axis.yaml").read_text()
    path.write_text(text)
    axis = AxisConfig.load(path)
    line = next(n for n, each in enumerate(text.splitlines(), 1) if each.startswith("  node_id:"))
    assert axis.where("drive.node_id") == f"{path}:{line}:3: drive.node_id"
    assert axis.on_bus(channel="other").where("drive.node_id") == axis.where("drive.node_id")
    source = next(n for n, each in enumerate(text.splitlines(), 1) if each.startswith("  source:"))
    assert axis.where("load_encoder.source.node") == f"{path}:{source}:3: load_encoder.source.node"
