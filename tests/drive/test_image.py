"""The process image: layout, scaling with direction, limits, and what reaches the bus."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.drive import PdoLengthError, ProcessImage, State
from hdbridge.drive.image import Frames
from hdbridge.errors import InputError


def tpdo1(statusword: int, position: int, torque: int = 0) -> bytes:
    return struct.pack("<Hih", statusword, position, torque)


def sent(frames: Frames) -> tuple[int, ...]:
    """Controlword and target of the one RPDO."""
    ((can_id, data),) = frames
    assert can_id == 0x201
    return struct.unpack("<Hi", data)


def test_layout_of_the_cycle(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    assert image.tpdo_ids == (0x181, 0x281)
    assert [(layout.number, layout.can_id) for layout in image.rpdos] == [(1, 0x201)]
    assert image.heartbeat_id == 0x77F
    assert [str(entry) for layout in image.tpdos for entry in layout.codec.entries] == [
        "6041h:00 uint16",
        "6064h:00 int32",
        "6077h:00 int16",
        "60E4h:01 int32",
        "6062h:00 int32",
    ]
    assert image.heartbeat_period_s < axis.drive.heartbeat_ms / 1000 < image.heartbeat_timeout_s


def test_frames_become_values(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    assert image.statusword is None
    assert image.accept(0x181, tpdo1(0x1237, -1234, -55))
    assert image.accept(0x281, struct.pack("<ii", 777, -888))
    assert not image.accept(0x182, bytes(8))
    assert (image.statusword, image.motor_counts, image.torque_permille) == (0x1237, -1234, -55)
    assert (image.load_counts, image.demand_counts) == (777, -888)
    assert image.power.state is State.OPERATION_ENABLED


@given(length=st.integers(0, 64).filter(lambda length: length != 8))
def test_a_frame_of_the_wrong_length_changes_nothing(
    length: int, build_axis: Callable[..., AxisConfig]
) -> None:
    image = ProcessImage(build_axis())
    image.accept(0x181, tpdo1(0x0040, 100))
    with pytest.raises(PdoLengthError):
        image.accept(0x181, bytes(length))
    assert (image.statusword, image.motor_counts) == (0x0040, 100)


def test_a_second_node_may_carry_the_load_encoder(build_axis: Callable[..., AxisConfig]) -> None:
    source = {"index": 0x6004, "subindex": 0, "type": "uint32", "node": 2, "range_counts": 1000}
    image = ProcessImage(build_axis(load_encoder__source=source))
    assert image.tpdo_ids == (0x181, 0x281, 0x182)
    for reading in (990, 5, 999):
        image.accept(0x182, struct.pack("<I", reading))
    assert image.load_counts == 999
    image.accept(0x182, struct.pack("<I", 4))
    assert image.load_counts == 1004
    image.accept(0x281, struct.pack("<i", -5))
    assert image.demand_counts == -5


def test_a_vendor_object_may_carry_it_too(build_axis: Callable[..., AxisConfig]) -> None:
    source = {"index": 0x2030, "subindex": 7, "type": "uint16"}
    image = ProcessImage(build_axis(load_encoder__source=source))
    image.accept(0x281, struct.pack("<Hi", 65535, 1))
    image.accept(0x281, struct.pack("<Hi", 1, 1))
    assert image.load_counts == 65537


@pytest.mark.parametrize("direction", [1, -1])
@given(deg=st.floats(-20_000, 20_000))
def test_scaling_follows_the_direction(
    direction: int, deg: float, build_axis: Callable[..., AxisConfig]
) -> None:
    image = ProcessImage(build_axis(motor_encoder__direction=direction))
    counts = image.target_counts_for(deg)
    assert counts == round(direction * deg * 8000 / 360)
    assert image.motor_deg(counts) == pytest.approx(deg, abs=0.5 * 360 / 8000 + 1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_limits_are_ordered_and_leave_room_for_the_compensation(
    direction: int, build_axis: Callable[..., AxisConfig]
) -> None:
    axis = build_axis(
        motor_encoder__direction=direction, limits__position_min_deg=-10, limits__position_max_deg=90
    )
    image = ProcessImage(axis)
    room = 300 / 3600 * 50 * 8000 / 360
    expected = sorted(
        direction * load * 50 * 8000 / 360 + sign * direction * room for load, sign in ((-10, -1), (90, 1))
    )
    assert image.limits_counts == (math.ceil(expected[0]), math.floor(expected[1]))


@given(counts=st.integers(-(2**33), 2**33) | st.floats() | st.none())
def test_only_targets_within_the_limits_are_packed(
    counts: object, build_axis: Callable[..., AxisConfig]
) -> None:
    image = ProcessImage(build_axis())
    least, greatest = image.limits_counts
    if isinstance(counts, int) and least <= counts <= greatest:
        assert sent(image.pack_rpdo(counts)) == (0, counts)
    else:
        with pytest.raises(InputError, match="not sent"):
            image.pack_rpdo(counts)  # type: ignore[arg-type]
        assert image.target_counts == 0


@pytest.mark.parametrize("deg", [math.nan, math.inf, -math.inf, 1e300, 20_100.0])
def test_angles_that_are_no_targets(deg: float, axis: AxisConfig) -> None:
    with pytest.raises(InputError, match="not sent"):
        ProcessImage(axis).target_counts_for(deg)


def test_before_power_the_target_is_where_the_axis_is(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    # Beyond int32, by way of a wrap, and outside the limits: still no reason to send another target.
    image.seed(motor_counts=2**31 - 10, load_counts=5, statusword=0x0040)
    image.accept(0x181, tpdo1(0x0040, -(2**31) + 10))
    assert image.motor_counts == 2**31 + 10
    image.power.go(State.OPERATION_ENABLED)
    assert sent(image.pack_rpdo_idle()) == (0x06, -(2**31) + 10)


def test_halt_sets_its_bit(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    image.accept(0x181, tpdo1(0x0027, 0))
    image.power.go(State.OPERATION_ENABLED)
    image.halt = True
    assert sent(image.pack_rpdo(0)) == (0x010F, 0)
