"""Bus load: worst-case bits of a frame and of a cycle."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.daemon import article_axis

from hdbridge.axis import AxisConfig
from hdbridge.drive.busload import FRAME_BITS, MAXIMUM_LOAD, bus_load, check_bus_load, cycle_bits
from hdbridge.errors import InputError


def axes(count: int, **drive: object) -> list[AxisConfig]:
    return [article_axis(node_id, **drive) for node_id in range(1, count + 1)]


def with_bus(axis: AxisConfig, bitrate_bps: int) -> AxisConfig:
    return axis.model_copy(update={"bus": axis.bus.model_copy(update={"bitrate_bps": bitrate_bps})})


def stuffed_bits(bits: list[int]) -> list[int]:
    """Applies the bit-stuffing rule: a complementary bit follows five equal ones."""
    sent: list[int] = []
    alike = 0
    for bit in bits:
        alike = alike + 1 if sent and sent[-1] == bit else 1
        sent.append(bit)
        if alike == 5:
            sent.append(1 - bit)
            alike = 1
    return sent


def test_bits_of_a_frame() -> None:
    assert [FRAME_BITS[length] for length in (0, 1, 6, 8)] == [55, 65, 115, 135]
    assert len(FRAME_BITS) == 9


@given(st.integers(0, 8), st.data())
def test_no_frame_is_longer_than_the_worst_case(length: int, data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.integers(0, 1), min_size=34 + 8 * length, max_size=34 + 8 * length))
    assert len(stuffed_bits(bits)) + 13 <= FRAME_BITS[length]


@pytest.mark.parametrize("length", range(9))
def test_the_worst_case_frame_exists(length):
    # Five equal bits, then alternating runs of four: each stuff bit begins the next run.
    bits, value = [0] * 5, 1
    while len(bits) < 34 + 8 * length:
        bits += [value] * 4
        value = 1 - value
    assert len(stuffed_bits(bits[: 34 + 8 * length])) + 13 == FRAME_BITS[length]


def test_a_cycle_is_the_sum_of_its_frames() -> None:
    sync, tpdos, rpdo, sdo = 55, 2 * 135, 115, 2 * 135
    heartbeats = 65 * 4 / 50 + 65 * 2 * 4 / 50
    assert cycle_bits(axes(1)) == pytest.approx(sync + tpdos + rpdo + sdo + heartbeats)
    two = sync + 2 * (tpdos + rpdo) + sdo + 65 * 2 * 4 / 50 + 65 * 2 * 4 / 50
    assert cycle_bits(axes(2)) == pytest.approx(two)


def test_a_channel_counts_in_proportion_to_its_rate(build_axis) -> None:
    torque = {
        "source": {"index": 0x2101, "type": "int32"},
        "newton_metres_per_count": 0.001,
        "maximum_nm": 50,
    }
    temperature = {
        "source": {"index": 0x2100, "type": "int16"}, "celsius_per_count": 0.1, "every_cycles": 10,
    }  # fmt: skip
    plain = cycle_bits([build_axis()])
    assert cycle_bits([build_axis(load_torque=torque)]) == pytest.approx(plain + FRAME_BITS[4])
    assert cycle_bits([build_axis(temperature=temperature)]) == pytest.approx(plain + FRAME_BITS[2] / 10)


def test_the_load_needs_a_bit_rate() -> None:
    assert bus_load(axes(2)) is None
    assert check_bus_load(axes(6)) is None
    assert bus_load([]) is None
    load = bus_load(axes(2), 1_000_000)
    assert load == pytest.approx(cycle_bits(axes(2)) / 4000)
    assert bus_load([with_bus(axis, 1_000_000) for axis in axes(2)]) == load


def test_too_many_axes_are_refused_with_a_feasible_alternative() -> None:
    fast = axes(6, cycle_ms=2.0)
    assert check_bus_load(axes(6), 1_000_000) < MAXIMUM_LOAD
    with pytest.raises(InputError) as refused:
        check_bus_load(fast, 1_000_000)
    text = str(refused.value)
    assert "axis1 and axis2" in text
    assert "at most 80 % is allowed" in text
    assert "or 3 of the 6 axes" in text
    longer_ms = float(text.split("a cycle_ms of ")[1].split(maxsplit=1)[0])
    assert check_bus_load(axes(6, cycle_ms=longer_ms), 1_000_000) <= MAXIMUM_LOAD
    with pytest.raises(InputError):
        check_bus_load(axes(6, cycle_ms=longer_ms - 1.0), 1_000_000)
    assert check_bus_load(fast[:3], 1_000_000) <= MAXIMUM_LOAD
    with pytest.raises(InputError):
        check_bus_load(fast[:4], 1_000_000)


def test_axes_with_different_bus_settings_are_refused() -> None:
    with pytest.raises(InputError, match=r"drive\.cycle_ms gives 8.*gives 4"):
        bus_load([article_axis(1), article_axis(2, cycle_ms=8.0)], 1_000_000)
    with pytest.raises(InputError, match=r"bus\.bitrate_bps gives 500000.*gives 1e\+06"):
        bus_load([with_bus(article_axis(1), 1_000_000), with_bus(article_axis(2), 500_000)])
