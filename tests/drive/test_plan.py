"""The boot plan: values, units, order and refusals."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.drive import plan
from hdbridge.errors import InputError


def values(axis: AxisConfig, od: Any = None) -> dict[tuple[int, int, int], int]:
    """Returns the last value of each object."""
    return {(row.node_id, row.index, row.sub): row.value for row in plan(axis, od)}


def test_values_come_from_the_axis_file(axis: AxisConfig) -> None:
    written = values(axis)
    assert written[1, 0x60C2, 1] == 4
    assert written[1, 0x60C2, 2] == -3
    assert written[1, 0x605A, 0] == 2
    assert written[1, 0x605D, 0] == 1
    assert written[1, 0x6065, 0] == round(5.0 * 8000 / 360)
    assert written[1, 0x6066, 0] == 20
    assert written[1, 0x6072, 0] == 1000
    assert written[1, 0x6080, 0] == 213  # 20 deg/s and 20,000 arcsec/s at the load, x 50, in rpm
    assert written[1, 0x1017, 0] == 50
    assert written[1, 0x1016, 1] == 127 << 16 | 50
    assert written[1, 0x1400, 5] == 16


@pytest.mark.parametrize(
    ("cycle_ms", "period"), [(1, (1, -3)), (2.5, (25, -4)), (0.5, (5, -4)), (255, (255, -3))]
)
def test_the_cycle_as_mantissa_and_exponent(build_axis, cycle_ms, period):
    written = values(build_axis(drive__cycle_ms=cycle_ms, drive__heartbeat_ms=600))
    assert (written[1, 0x60C2, 1], written[1, 0x60C2, 2]) == period


@given(low=st.floats(-1000, 900), width=st.floats(1, 1000), direction=st.sampled_from([1, -1]))
def test_a_reversed_encoder_swaps_the_ends(build_axis, low, width, direction):
    axis = build_axis(
        limits__position_min_deg=low,
        limits__position_max_deg=low + width,
        motor_encoder__direction=direction,
    )
    written = values(axis)
    least, greatest = written[1, 0x607D, 1], written[1, 0x607D, 2]
    assert least < greatest
    ends = sorted((axis.motor_encoder.degrees(least) / 50, axis.motor_encoder.degrees(greatest) / 50))
    room = 300 / 3600
    assert ends == pytest.approx([low - room, low + width + room], abs=1e-3)
    assert ends[0] >= low - room - 1e-9
    fields = {row.sub: row.field for row in plan(axis) if row.index == 0x607D}
    assert fields[1 if direction == 1 else 2] == "limits.position_min_deg"


def test_a_pdo_is_off_and_empty_while_it_is_changed(axis: AxisConfig) -> None:
    steps = [(row.index, row.sub, row.value) for row in plan(axis) if row.index in (0x1800, 0x1A00)]
    assert steps == [
        (0x1800, 1, 0x8000_0000),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60410010),
        (0x1A00, 2, 0x60640020),
        (0x1A00, 3, 0x60770010),
        (0x1A00, 0, 3),
        (0x1800, 2, 1),
        (0x1800, 1, 0x181),
    ]


def test_a_row_reads_like_a_sentence(axis: AxisConfig) -> None:
    rows = [str(row) for row in plan(axis)]
    assert "605Ah:00 = 2 (2h): what a quick stop does [drive.quick_stop_option]" in rows
    assert all(row.why for row in plan(axis))


def test_a_window_of_less_than_a_count_would_switch_supervision_off(build_axis):
    with pytest.raises(InputError, match="6065h means no supervision"):
        plan(build_axis(drive__following_error_deg=0.01))


def test_a_value_that_its_object_cannot_hold(build_axis: Callable[..., AxisConfig]) -> None:
    axis = build_axis(limits__acceleration_deg_s2=1e7, motor_encoder__counts_per_turn=8_000_000)
    with pytest.raises(InputError, match=r"limits\.acceleration_deg_s2 gives .* 6085h:00"):
        plan(axis)
