"""The process image: scaling, limits and packed frames."""

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.eds import OWN, mapped, stating, without

from hdbridge.axis import AxisConfig
from hdbridge.drive import PdoLengthError, ProcessImage, State, load_eds
from hdbridge.drive.image import Frames
from hdbridge.errors import InputError, TransitionError

from .conftest import make_axis


def tpdo1(statusword: int, position: int, torque: int = 0) -> bytes:
    return struct.pack("<Hih", statusword, position, torque)


def sent(frames: Frames) -> tuple[int, ...]:
    """Returns controlword and target of the only RPDO."""
    ((can_id, data),) = frames
    assert can_id == 0x201
    return struct.unpack("<Hi", data)


def test_frames_become_values(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    assert image.statusword is None
    assert image.accept(0x181, tpdo1(0x1237, -1234, -55))
    assert image.accept(0x281, struct.pack("<ii", 777, -888))
    assert not image.accept(0x182, bytes(8))
    assert (image.statusword, image.motor_counts, image.torque_permille) == (0x1237, -1234, -55)
    assert (image.load_counts, image.demand_counts) == (777, -888)
    assert image.power.state is State.OPERATION_ENABLED


def test_heartbeats_are_awaited_for_two_periods_and_sent_twice_in_the_drives_time_out(build_axis):
    image = ProcessImage(build_axis(drive__heartbeat_ms=80))
    assert image.heartbeat_timeout_s == pytest.approx(0.16)
    assert image.heartbeat_period_s == pytest.approx(0.04)


def test_a_quick_stop_is_sent_with_the_actual_position(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    image.accept(0x181, tpdo1(0x0027, 500))
    image.pack_rpdo(1000)
    assert sent(image.pack_rpdo_stop()) == (0x02, 500)


ENDS = [end + by for end in ProcessImage(make_axis()).limits_counts for by in (-1, 0, 1)]
"""Position limits of the axis, and the counts next to them."""
END = 2**31
"""First count beyond the range of 32 bits."""


def test_positions_continue_beyond_their_32_bits_from_the_reading_at_boot_up(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    image.seed(END - 10, END - 20, 0x0040)
    image.accept(0x181, tpdo1(0x0027, -END + 5))
    image.accept(0x281, struct.pack("<ii", -END + 3, -END + 7))
    assert (image.motor_counts, image.load_counts, image.demand_counts) == (END + 5, END + 3, END + 7)


def test_without_6062h_the_earlier_target_continues_beyond_its_32_bits(other):
    image = other(without(OWN, 0x6062))
    image.seed(END - 10, 0, 0x0040)
    image.accept(0x181, tpdo1(0x0027, -END + 5))
    for target in (-END + 7, -END + 9):
        image.follow_target(target)
    assert image.demand_counts == END + 7


@given(length=st.integers(0, 64).filter(lambda length: length != 8))
def test_a_frame_of_the_wrong_length_changes_nothing(length, build_axis):
    image = ProcessImage(build_axis())
    image.accept(0x181, tpdo1(0x0040, 100))
    with pytest.raises(PdoLengthError):
        image.accept(0x181, bytes(length))
    assert (image.statusword, image.motor_counts) == (0x0040, 100)


def test_a_second_node_may_send_the_load_position(build_axis: Callable[..., AxisConfig]) -> None:
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


@pytest.mark.parametrize("direction", [1, -1])
@given(deg=st.floats(-20_000, 20_000))
def test_scaling_follows_the_direction(direction, deg, build_axis):
    image = ProcessImage(build_axis(motor_encoder__direction=direction))
    counts = image.target_counts_for(deg)
    assert counts == round(direction * deg * 8000 / 360)
    assert image.motor_deg(counts) == pytest.approx(deg, abs=0.5 * 360 / 8000 + 1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_limits_are_ordered_and_leave_room_for_the_compensation(direction, build_axis):
    axis = build_axis(
        motor_encoder__direction=direction, limits__position_min_deg=-10, limits__position_max_deg=90
    )
    image = ProcessImage(axis)
    room = 300 / 3600 * 50 * 8000 / 360
    expected = sorted(
        direction * load * 50 * 8000 / 360 + sign * direction * room for load, sign in ((-10, -1), (90, 1))
    )
    assert image.limits_counts == (math.ceil(expected[0]), math.floor(expected[1]))


@given(counts=st.integers(-(2**33), 2**33) | st.sampled_from(ENDS) | st.floats() | st.none())
def test_only_targets_within_the_limits_are_packed(counts, build_axis):
    image = ProcessImage(build_axis())
    least, greatest = image.limits_counts
    if isinstance(counts, int) and least <= counts <= greatest:
        assert sent(image.pack_rpdo(counts)) == (0, counts)
    else:
        with pytest.raises(InputError, match="not sent"):
            image.pack_rpdo(counts)  # type: ignore[arg-type]
        assert image.target_counts == 0


@pytest.mark.parametrize("deg", [math.nan, math.inf, -math.inf, 1e300, 20_100.0])
def test_impossible_angles_are_refused(deg: float, axis: AxisConfig) -> None:
    with pytest.raises(InputError, match="not sent"):
        ProcessImage(axis).target_counts_for(deg)


def test_before_power_the_target_is_the_actual_position(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    # Even beyond int32, after a wrap, and outside the limits, no other target is sent.
    image.seed(motor_counts=2**31 - 10, load_counts=5, statusword=0x0040)
    image.accept(0x181, tpdo1(0x0040, -(2**31) + 10))
    assert image.motor_counts == 2**31 + 10
    image.power.go(State.OPERATION_ENABLED)
    assert sent(image.pack_rpdo_idle(image.motor_counts)) == (0x06, -(2**31) + 10)


def test_halt_sets_its_bit(axis: AxisConfig) -> None:
    image = ProcessImage(axis)
    image.accept(0x181, tpdo1(0x0027, 0))
    image.power.go(State.OPERATION_ENABLED)
    image.halt = True
    assert sent(image.pack_rpdo(0)) == (0x010F, 0)


def test_in_ip_the_target_is_enabled_in_operation_enabled_only(build_axis: Callable[..., AxisConfig]) -> None:
    image = ProcessImage(build_axis(drive__mode="ip"))
    assert [entry.mapping for entry in image.rpdos[0].codec.entries] == [0x60400010, 0x60C10120]
    image.accept(0x181, tpdo1(0x0040, 100))
    image.power.go(State.OPERATION_ENABLED)
    for status, word in ((0x0040, 0x06), (0x0021, 0x07), (0x0023, 0x0F), (0x0027, 0x1F)):
        image.accept(0x181, tpdo1(status, 100))
        assert sent(image.pack_rpdo_idle(image.motor_counts)) == (word, 100)
    assert sent(image.pack_rpdo(150)) == (0x1F, 150)
    assert sent(image.pack_rpdo_held()) == (0x1F, 150)
    assert sent(image.pack_rpdo_stop()) == (0x02, 100)
    image.power.quick_stop()
    assert sent(image.pack_rpdo_held()) == (0x02, 150)
    image.accept(0x181, tpdo1(0x0007, 100))
    assert sent(image.pack_rpdo_held()) == (0x02, 150)


STATES = st.sampled_from([0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08, 0xFF])


@given(
    seen=st.lists(st.tuples(STATES, st.sampled_from(["go", "stop", "off", ""])), max_size=20),
    halt=st.booleans(),
)
def test_in_ip_no_other_word_than_enable_operation_has_the_bit(build_axis, seen, halt):
    image = ProcessImage(build_axis(drive__mode="ip"))
    image.halt = halt
    for status, wish in seen:
        image.accept(0x181, tpdo1(status, 0))
        with suppress(TransitionError):
            if wish == "go":
                image.power.go(State.OPERATION_ENABLED)
            elif wish == "off":
                image.power.go(State.SWITCH_ON_DISABLED)
            elif wish == "stop":
                image.power.quick_stop()
        word, _ = sent(image.pack_rpdo(7))
        assert not word & 0x10 or (word & 0x0F == 0x0F and image.power.state is State.OPERATION_ENABLED)


@pytest.fixture
def other(tmp_path: Path, build_axis: Callable[..., AxisConfig]) -> Callable[[str], ProcessImage]:
    """Returns the image of a drive with a different EDS."""

    def make(eds: str) -> ProcessImage:
        path = tmp_path / "drive.eds"
        path.write_text(eds)
        return ProcessImage(build_axis(), load_eds(path, 1))

    return make


def test_a_command_may_be_split_over_two_frames(other: Callable[[str], ProcessImage]) -> None:
    image = other(mapped(mapped(OWN, 0x1400, 0x60600008, 0x60400010), 0x1402, 0x607A0020, 0x60B00020))
    image.accept(0x181, tpdo1(0x0027, 300))
    image.power.go(State.OPERATION_ENABLED)
    assert image.pack_rpdo(123) == (
        (0x201, struct.pack("<bH", 8, 0x0F)),
        (0x401, struct.pack("<ii", 123, 0)),
    )
    assert image.pack_rpdo_stop() == (
        (0x201, struct.pack("<bH", 8, 0x02)),
        (0x401, struct.pack("<ii", 300, 0)),
    )
    with pytest.raises(InputError, match="not sent"):
        image.pack_rpdo(1 << 31)


def test_the_statusword_is_read_from_any_tpdo(other: Callable[[str], ProcessImage]) -> None:
    image = other(mapped(OWN, 0x1801, 0x60E40120, 0x60410010, kind=1))
    assert image.tpdo_ids == (0x181, 0x281, 0x381)
    data = struct.pack("<iH", 5, 0x1237)
    assert image.statusword_in(0x281, data) == 0x1237
    assert image.statusword is None
    assert image.statusword_in(0x181, bytes(8)) is None
    assert image.statusword_in(0x281, bytes(5)) is None
    image.accept(0x281, data)
    assert (image.statusword, image.load_counts) == (0x1237, 5)


def test_without_6062h_the_demand_is_the_earlier_target(other):
    """A target sent after SYNC k is taken at SYNC k+1, and reached at SYNC k+2."""
    image = other(without(OWN, 0x6062))
    image.seed(1000, 0, 0x0027)
    image.power.go(State.OPERATION_ENABLED)
    seen = []
    for target in (1010, 1020, 1030, 1040):
        image.accept(0x181, tpdo1(0x0027, 1000))
        seen.append(image.demand_counts)
        image.pack_rpdo(target)
    assert seen == [1000, 1000, 1010, 1020]
    image.accept(0x181, tpdo1(0x0040, 990))
    assert image.demand_counts == 990


def test_without_6077h_the_torque_is_unknown(other: Callable[[str], ProcessImage]) -> None:
    image = other(without(OWN, 0x6077))
    image.accept(0x181, struct.pack("<Hi", 0x0027, 5))
    assert math.isnan(image.torque_permille)


def test_positions_of_another_width_are_followed_over_their_wrap(other):
    image = other(stating(stating(OWN, "6064", DataType="0x0003"), "6062", DataType="0x0003"))
    for counts in (32_760, -32_766):
        image.accept(0x181, struct.pack("<Hhhh", 0x0027, counts, 0, counts))
    assert image.motor_counts == image.demand_counts == 32_770
