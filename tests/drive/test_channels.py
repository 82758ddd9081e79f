"""Load torque and temperature: mapped, read back, scaled, checked, held and given up."""

import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import LoadTorque, Temperature
from hdbridge.drive import Drive, ProcessImage, load_eds, plan
from hdbridge.drive.channels import ChannelFollower
from hdbridge.drive.supervision import Fault
from hdbridge.errors import SdoError
from hdbridge.files.profile import bundled_folder

from .conftest import holding

TORQUE = {"source": {"index": 0x2101, "type": "int32"}, "newton_metres_per_count": 0.001, "maximum_nm": 50}
TEMPERATURE = {"source": {"index": 0x2100, "type": "int16"}, "celsius_per_count": 0.1}
Build = Callable[..., AxisConfig]


def follower(**changes: Any) -> ChannelFollower:
    return ChannelFollower("load_torque", LoadTorque.model_validate(TORQUE | changes), cycle_ms=4)


def test_both_channels_are_scaled(build_axis: Build) -> None:
    image = ProcessImage(build_axis(load_torque=TORQUE | {"direction": -1}, temperature=TEMPERATURE))
    assert image.readings == (None, None)
    assert image.accept(0x381, struct.pack("<i", 1500))
    assert image.accept(0x481, struct.pack("<h", -35))
    assert not image.step_channels()
    assert image.readings == pytest.approx((-1.5, -3.5))


def test_a_temperature_may_be_in_kelvin() -> None:
    channel = Temperature.model_validate(
        TEMPERATURE | {"celsius_per_count": 0.01, "celsius_at_zero": -273.15}
    )
    each = ChannelFollower("temperature", channel, cycle_ms=4)
    each.accept(29_315)
    assert each.value == pytest.approx(20.0)


def test_the_plan_maps_channels_and_names_their_key(build_axis: Build) -> None:
    axis = build_axis(load_torque=TORQUE, temperature=TEMPERATURE)
    rows = {(row.index, row.sub): row for row in plan(axis)}
    assert (rows[0x1A02, 1].value, rows[0x1A02, 1].field) == (0x2101_0020, "load_torque.source")
    assert (rows[0x1A03, 1].value, rows[0x1A03, 1].field) == (0x2100_0010, "temperature.source")
    assert (rows[0x1802, 2].value, rows[0x1803, 2].value) == (1, 25)
    assert rows[0x1803, 2].field == "temperature.every_cycles"
    assert (rows[0x1802, 1].value, rows[0x1803, 1].value) == (0x381, 0x481)


def test_a_drive_refusing_the_mapping_is_refused(bus: Any, clock: Any, slave: Any, build_axis: Build) -> None:
    slave.scripts[0x1A02, 1] = lambda request: [b"\x80" + request[1:4] + (0x06040041).to_bytes(4, "little")]
    with pytest.raises(SdoError, match=r"cannot map it.*load_torque\.source decides it"):
        Drive(bus, build_axis(load_torque=TORQUE), clock, load_eds_with_2101()).boot()
    slave.scripts[0x1A02, 1] = holding(0)
    with pytest.raises(Exception, match=r"1A02h:01 .*reads back 0; .*load_torque\.source decides it"):
        Drive(bus, build_axis(load_torque=TORQUE), clock, load_eds_with_2101()).boot()


def load_eds_with_2101() -> Any:
    return load_eds(bundled_folder("eds") / "hdbridge-402.eds", 1)


def test_implausible_readings_are_rejected() -> None:
    each = follower()
    each.accept(10_000)
    assert each.step() is None
    each.accept(50_001)
    assert each.step() == (Fault.CHANNEL_HELD, "load_torque: 50.001 Nm is not within -50 to 50 Nm")
    assert each.value == pytest.approx(10.0)
    each.accept(-50_000)
    assert each.step() is None
    assert each.value == pytest.approx(-50.0)


@pytest.mark.parametrize("counts", [-(2**15), 2**15 - 1])
def test_the_extremes_of_the_type_are_not_readings(counts: int) -> None:
    each = follower(source={"index": 0x2101, "type": "int16"})
    each.accept(counts)
    assert each.value is None
    each.accept(counts - 1 if counts > 0 else counts + 1)
    assert each.value is not None


def test_missing_readings_are_held_then_lost_and_may_return() -> None:
    each = follower(hold_ms=20)
    each.accept(1000)
    assert each.step() is None
    for _ in range(5):
        assert each.step() == (Fault.CHANNEL_HELD, "load_torque: none arrived")
        assert each.value == pytest.approx(1.0)
    assert each.step() == (Fault.CHANNEL_LOST, "load_torque: none arrived")
    assert each.value is None
    assert each.lost
    assert each.step() is None  # the fault is reported only once
    each.accept(2000)
    assert (each.step(), each.value, each.lost) == (None, 2.0, False)


def test_before_the_first_reading_there_is_nothing_to_hold() -> None:
    each = follower(hold_ms=20)
    said = [each.step() for _ in range(10)]
    assert [fault for fault in said if fault] == [(Fault.CHANNEL_LOST, "load_torque: none arrived")]


@given(every=st.integers(2, 30), missed=st.integers(0, 5), late=st.lists(st.integers(0, 1), max_size=20))
def test_a_slow_channel_is_missed_once_per_period(every: int, missed: int, late: list[int]) -> None:
    each = follower(every_cycles=every, hold_ms=4 * every * 10)
    arrivals = {i * every + shift for i, shift in enumerate([*late, 0])}
    first = max(arrivals) + 1
    held = 0
    for cycle in range(first + (missed + 1) * every):
        if cycle in arrivals:
            each.accept(1000)
        held += each.step() is not None
        if cycle < first:
            assert not held
    assert held == missed
