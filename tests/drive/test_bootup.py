"""Booting a drive: checks, order of writes, and every refusal."""

from collections.abc import Callable
from typing import Any

import can
import pytest
from canopen.objectdictionary import ObjectDictionary
from support.ideal_motor import IdealMotor

from hdbridge.axis import AxisConfig
from hdbridge.canframe import DataFrame
from hdbridge.device.node import DriveNode
from hdbridge.drive import Drive, Mode, State
from hdbridge.errors import DriveError, IdentityError, InputError, SdoError

from .conftest import EDS, Later, Slave, holding


@pytest.fixture
def drive(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> Drive:
    return Drive(bus, axis, clock, slave.od, sdo_timeout_s=0.1)


def test_a_drive_comes_up_configured_operational_and_disabled(drive: Drive, slave: Any) -> None:
    report = drive.boot()
    assert report.state is State.SWITCH_ON_DISABLED
    assert set(report.modes) == {Mode.PP, Mode.HM, Mode.IP, Mode.CSP}
    assert report.identity["vendor_id"] == 0x4844
    assert report.names["device"]
    assert report.notes == ()
    assert slave.nmt_state == 5
    for (index, sub), row in {(row.index, row.sub): row for row in report.held}.items():
        assert int(slave.values[index, sub]) & row.compared == row.value & row.compared
    assert slave.values[0x1A01, 1] == 0x60E40120
    assert slave.values[0x1400, 1] == 0x201
    for unused in (0x1401, 0x1402, 0x1403, 0x1802, 0x1803):
        assert slave.values[unused, 1] & 0x8000_0000
    assert drive.monitor.nodes[1].boot_ups == 1


def test_nothing_is_written_before_the_drive_is_known(drive: Drive, slave: Any) -> None:
    slave.values[0x1018, 2] = 0x403
    with pytest.raises(IdentityError, match=r"1018h:02 .*is 403h.*drive\.identity\.product_code is 402h"):
        drive.boot()
    assert slave.sdo_order == []


def test_without_a_reset_no_boot_up_message_is_awaited(drive: Drive, sent: Any) -> None:
    drive.boot(reset=False)
    assert [data for can_id, data in sent if can_id == 0] == [b"\x80\x01", b"\x01\x01"]


def test_an_absent_drive_is_named_within_a_bounded_time(drive, slave, clock, axis):
    slave.node.faults.silent = True
    with pytest.raises(DriveError, match=r"node 1 on virtual:test-.*no other node.*drive\.node_id") as caught:
        drive.boot()
    assert "\n" not in str(caught.value)
    assert clock.now() < 3.5


def booting(slave: Any, clock: Any, boot_up_s: float | None, sdo_s: float) -> None:
    """Delays boot-up message and SDO server by these times after a reset."""
    reset_s = 0.0

    def is_up() -> bool:
        return bool(clock.now() >= reset_s + sdo_s)

    def obeys(command: int) -> bool:
        nonlocal reset_s
        if command == 0x82:
            reset_s = clock.now()
            if boot_up_s is not None:
                Later(clock, reset_s + boot_up_s, lambda: slave.say(0x700, b"\0"))
        return command == 0x82 or is_up()

    slave.obeys = obeys
    slave.sends = lambda message: boot_up_s is None or message.arbitration_id != 0x701 or message.data[0] != 0
    slave.sdo = lambda request: slave.scripted(request) if is_up() else []


@pytest.mark.parametrize(
    ("boot_up_s", "sdo_s"), [(0.1, 1.0), (0.1, 3.5), (1.9, 5.2), (2.8, 5.0), (3.4, 6.8), (None, 3.0)]
)
def test_a_drive_that_answers_seconds_after_its_boot_up_message(slave, bus, axis, clock, boot_up_s, sdo_s):
    booting(slave, clock, boot_up_s, sdo_s)
    assert Drive(bus, axis, clock, slave.od).boot().state is State.SWITCH_ON_DISABLED


def test_a_drive_that_boots_but_never_answers_is_reported_as_heard(drive, slave, bus, clock):
    booting(slave, clock, 0.5, 1e9)
    with pytest.raises(DriveError, match=r"does not answer \(heard of it: its boot-up message\); ") as caught:
        drive.boot()
    assert "no other node" not in str(caught.value)
    assert 4.0 <= clock.now() <= 5.5


def test_a_stopped_node_is_reported_as_heard(drive: Drive, slave: Any, bus: Any) -> None:
    slave.node.dictionary[0x1017, 0].put(100)
    bus.send(DataFrame(0x000, b"\x02\x01"))
    slave.obeys, slave.sdo = lambda _: False, lambda _: []
    with pytest.raises(DriveError, match=r"heard of it: a heartbeat \(04h\)"):
        drive.boot()


def test_an_absent_drive_lists_the_present_nodes(drive: Drive, slave: Any, clock: Any) -> None:
    slave.node.faults.silent = True
    Later(clock, 0.1, lambda: slave.say(0x704, b"\x7f"))  # of node 5
    with pytest.raises(DriveError, match="heard: node 5"):
        drive.boot()


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ((0x1000, 0), 0x0002_0191, "device profile 401; expected 402"),
        ((0x1018, 1), 1, r"drive\.identity\.vendor_id"),
        ((0x1018, 3), 0x10001, r"drive\.identity\.revision"),
        ((0x6502, 0), 0x21, "cyclic synchronous position"),
        ((0x608F, 1), 4000, r"608Fh.*counts 4000 per motor turn.*counts_per_turn.* is 8000"),
        ((0x608F, 2), 2, "counts 4000"),
        ((0x608F, 1), 0, "is 0, over 1: not a ratio"),
        ((0x6092, 1), 360_000, r"6092h.*counts 7200 per motor turn"),
        ((0x6091, 1), 100, r"gear of 100, but .*gear\.ratio is 50"),
        ((0x607E, 0), 0x80, r"reverses positions itself.*motor_encoder\.direction"),
        ((0x60E6, 1), 1_000_000, r"load_encoder\.counts_per_turn.* is 2880000"),
    ],
)
def test_another_drive_or_another_scale_is_refused(drive, slave, key, value, text):
    slave.values[key] = value
    with pytest.raises(IdentityError, match=text) as caught:
        drive.boot()
    assert "\n" not in str(caught.value)
    assert slave.sdo_order == []


def test_a_feed_that_does_not_scale(bus: Any, slave: Any, clock: Any, build_axis: Any) -> None:
    """If 6092h does not scale, the error names the line that does; with it, the drive is accepted."""
    slave.values[0x6092, 1] = 360_000
    with pytest.raises(IdentityError, match=r"'feed_scales: false' under .*axis.yaml:4:1: drive"):
        Drive(bus, build_axis(), clock, slave.od).boot()
    Drive(bus, build_axis(drive__feed_scales=False), clock, slave.od).boot()
    slave.values[0x6091, 1] = 50
    Drive(bus, build_axis(drive__feed_scales=False), clock, slave.od).boot()
    slave.values[0x608F, 1] = 360_000
    with pytest.raises(IdentityError, match="608Fh"):
        Drive(bus, build_axis(drive__feed_scales=False), clock, slave.od).boot()


def test_missing_mandatory_objects_are_refused_before_anything_is_sent(slave, bus, axis, clock, sent):
    with pytest.raises(
        InputError, match=r"drive\.eds: hdbridge-402\.eds lacks 6040h:00 controlword, .* more"
    ):
        Drive(bus, axis, clock, ObjectDictionary())
    del slave.od[0x6064]
    with pytest.raises(InputError, match=r"lacks 6064h:00 position actual value, which"):
        Drive(bus, axis, clock, slave.od)
    assert sent == []


def test_a_different_rated_torque_is_only_noted(drive: Drive, slave: Any) -> None:
    slave.values[0x6076, 0] = 640
    (note,) = drive.boot().notes
    assert "0.64 Nm" in note


WRITTEN = [
    ((0x60C2, 1), "drive.cycle_ms"),
    ((0x60C2, 2), "drive.cycle_ms"),
    ((0x605A, 0), "drive.quick_stop_option"),
    ((0x605D, 0), "drive.halt_option"),
    ((0x607D, 1), "limits.position_min_deg"),
    ((0x607D, 2), "limits.position_max_deg"),
    ((0x6080, 0), "limits.velocity_deg_s"),
    ((0x6072, 0), "limits.torque_percent"),
    ((0x6065, 0), "drive.following_error_deg"),
    ((0x6066, 0), "drive.following_error_time_ms"),
    ((0x1017, 0), "drive.heartbeat_ms"),
    ((0x1016, 1), "drive.heartbeat_ms"),
    ((0x1A01, 1), "load_encoder.source"),
    ((0x1800, 1), ""),
    ((0x6007, 0), "drive.abort_connection_option"),
]
STATED = {
    "quick_stop_option": 6,
    "halt_option": 1,
    "following_error_time_ms": 20,
    "abort_connection_option": 3,
}


@pytest.fixture
def stated(bus: Any, clock: Any, slave: Any, build_axis: Callable[..., AxisConfig]) -> Drive:
    """Provides a drive whose axis file states all options of `STATED`."""
    axis = build_axis(**{f"drive__{key}": value for key, value in STATED.items()})
    return Drive(bus, axis, clock, slave.od, sdo_timeout_s=0.1)


@pytest.mark.parametrize(("key", "field"), WRITTEN)
def test_a_value_that_is_not_kept_is_detected(stated, slave, key, field):
    slave.scripts[key] = holding(77)
    with pytest.raises(DriveError, match=f"{key[0]:04X}h:{key[1]:02X} .*but reads back 77") as caught:
        stated.boot()
    assert field in str(caught.value)
    assert slave.nmt_state == 127


def refusing(code: int, held: int = 0) -> Callable[[bytes], list[bytes]]:
    """A script for an object that can be read but not written."""

    def answer(request: bytes) -> list[bytes]:
        if request[0] >> 5 == 2:
            return [b"\x43" + request[1:4] + held.to_bytes(4, "little")]
        return [b"\x80" + request[1:4] + code.to_bytes(4, "little")]

    return answer


@pytest.mark.parametrize("key", [(0x605A, 0), (0x605D, 0), (0x605B, 0), (0x6007, 0), (0x1029, 1)])
@pytest.mark.parametrize("code", [0x06090030, 0x06090031, 0x06010002, 0x08000000])
def test_a_default_refused_by_the_drive_is_left_to_it(drive, slave, key, code):
    slave.scripts[key] = refusing(code, held=5)
    report = drive.boot()
    (note,) = report.notes
    assert note.startswith("left to the drive (")
    assert f"{key[0]:04X}h:{key[1]:02X}" in note
    assert f"{code:08X}h" in note
    assert "drive." in note
    assert report.left == {key}
    assert key not in {(row.index, row.sub) for row in report.held}
    assert slave.nmt_state == 5


def test_a_read_only_limit_is_left_to_the_drive_even_if_stated(stated: Drive, slave: Any) -> None:
    for key in ((0x6065, 0), (0x605A, 0)):
        slave.scripts[key] = refusing(0x06010002, held=2)
    report = stated.boot()
    assert report.left == {(0x6065, 0), (0x605A, 0)}


def test_a_drive_that_refuses_its_cycle_is_refused(drive: Drive, slave: Any) -> None:
    slave.scripts[0x60C2, 1] = refusing(0x06010002, held=1)
    with pytest.raises(SdoError, match=r"60C2h:01 .*read-only.*drive\.cycle_ms decides it"):
        drive.boot()


def test_a_write_only_object_is_written(drive: Drive, slave: Any) -> None:
    slave.od[0x605A].access_type = "wo"
    slave.scripts[0x605A, 0] = lambda request: [b"\x60" + request[1:4] + bytes(4)]
    assert 0x605A in {row.index for row in drive.boot().written}
    slave.od[0x605A].access_type = "rw"  # the EDS permits reading, the drive does not
    slave.scripts[0x605A, 0] = lambda request: [
        b"\x80" + request[1:4] + (0x06010001).to_bytes(4, "little")
        if request[0] >> 5 == 2
        else b"\x60" + request[1:4] + bytes(4)
    ]
    assert 0x605A in {row.index for row in drive.boot().written}


def test_a_correct_mapping_is_not_written_again(drive: Drive, slave: Any) -> None:
    drive.boot()
    slave.values[0x1800, 2] = 255
    slave.sdo_order.clear()
    drive.boot(reset=False)
    assert slave.sdo_order == [(0x1800, 1, 0x8000_0181), (0x1800, 2, 1), (0x1800, 1, 0x181)]


@pytest.mark.parametrize(("key", "field"), WRITTEN)
def test_a_refused_write_names_the_field(stated: Drive, slave: Any, key: tuple[int, int], field: str) -> None:
    slave.scripts[key] = refusing(0x06090030)
    with pytest.raises(SdoError, match=f"{key[0]:04X}h:{key[1]:02X} .*write refused.*06090030h") as caught:
        stated.boot()
    assert field in str(caught.value)


def test_a_load_encoder_that_cannot_be_mapped(drive: Drive, slave: Any) -> None:
    slave.scripts[0x1A01, 1] = lambda request: [b"\x80" + request[1:4] + (0x06040041).to_bytes(4, "little")]
    with pytest.raises(SdoError, match=r"cannot map it.*another object.*load_encoder\.source"):
        drive.boot()


def test_a_node_that_does_not_start(drive: Drive, slave: Any) -> None:
    slave.obeys = lambda command: command != 1
    with pytest.raises(DriveError, match=r"did not become OPERATIONAL \(it says 7Fh"):
        drive.boot()


def test_a_powered_drive_is_switched_off_first(drive: Drive, slave: Any) -> None:
    slave.enable()
    assert drive.boot(reset=False).state is State.SWITCH_ON_DISABLED
    assert slave.sdo_order[0] == (0x6040, 0, 0)


def test_a_drive_that_stays_under_power_is_refused(drive: Drive, slave: Any) -> None:
    slave.enable()
    slave.scripts[0x6040, 0] = holding(0x0F)
    with pytest.raises(DriveError, match="stays in 'operation enabled'"):
        drive.boot(reset=False)


def test_a_drive_in_fault_boots_and_reports_it(drive: Drive, slave: Any) -> None:
    slave.fail()
    assert drive.boot().state is State.FAULT


def test_the_bit_that_forbids_rtr_is_left_to_the_drive(drive: Drive, slave: Any) -> None:
    slave.values[0x1800, 1] = 0x4000_0181
    drive.boot(reset=False)
    assert slave.values[0x1800, 1] == 0x4000_0181


def test_load_encoder_on_a_separate_node(bus, clock, slave, channel, build_axis):
    source = {"index": 0x60E4, "subindex": 1, "type": "int32", "node": 2}
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as other_bus:
        motor = IdealMotor(5000)
        encoder = Slave(DriveNode(other_bus, motor, EDS, 2, clock), motor)
        clock.nodes.append(encoder.node)
        drive = Drive(bus, build_axis(load_encoder__source=source), clock, slave.od)
        drive.boot()
        assert (encoder.values[0x1800, 1], encoder.values[0x1A00, 1]) == (0x182, 0x60E40120)
        assert (encoder.values[0x1800, 2], encoder.values[0x1017, 0]) == (1, 50)
        assert (slave.nmt_state, encoder.nmt_state) == (5, 5)
        assert slave.values[0x1A01, 0] == 1
        assert drive.read_positions().load_counts == 36_000
        encoder.node.faults.silent = True
        with pytest.raises(DriveError, match=r"node 2 .*load_encoder\.source\.node"):
            drive.boot()
        assert slave.nmt_state == 127
