"""Every fault of `drive.fault`, by its effect on the bus."""

import math
import struct
from pathlib import Path

import can
import pytest

from hdbridge.drive.supervision import Fault
from hdbridge.errors import InputError
from hdbridge.testing import simulated_drive
from hdbridge.testing.faulttable import FAULTS, OF_THE_PROGRAM

ROOT = Path(__file__).resolve().parents[2]
BOTH = [0x181, 0x281]
READ_TYPE = b"\x40\x00\x10\0\0\0\0\0"


def ids(messages) -> list[int]:
    return [each.arbitration_id for each in messages]


def load_counts(answers) -> int:
    (message,) = (each for each in answers if each.arbitration_id == 0x281)
    return struct.unpack_from("<i", message.data)[0]


def motor_counts(answers) -> int:
    (message,) = (each for each in answers if each.arbitration_id == 0x181)
    return struct.unpack_from("<i", message.data, 2)[0]


def stands(drive) -> bool:
    """Checks that the axis has come to rest on its own within half a second."""
    drive.sleep(0.5)
    before = drive.truth.load_deg
    drive.sleep(0.1)
    return abs(drive.truth.load_deg - before) < 1e-3


def tpdos(drive, program, name: str, **arguments) -> list[list[int]]:
    drive.fault(name, **arguments)
    return [ids(program.cycle()) for _ in range(3)]


TPDOS = {
    "lost_tpdo": ({"count": 3}, [[], [0x281], BOTH]),
    "late_tpdo": ({}, [[0x281], [*BOTH, 0x181], BOTH]),
    "duplicated_tpdo": ({"count": 2}, [[0x181, *BOTH, 0x281], BOTH, BOTH]),
    "reordered_tpdos": ({}, [BOTH[::-1], BOTH, BOTH]),
}
"""Arguments of a fault, and the TPDOs after each of the next three SYNCs."""
FRAMES = {
    "remote_frame": ({}, [(0x181, "remote")]),
    "extended_frame": ({}, [(0x181, "extended")]),
    "error_frame": ({}, [(0x4, "error")]),
    "bus_off": ({}, [(0x40, "error")]),
    "second_master_sync": ({}, [(each, "data") for each in (0x080, *BOTH)]),
    "second_master_set_point": ({}, [(0x201, "data")]),
    "second_master_heartbeat": ({"node_id": 5}, [(0x705, "data")]),
    "second_master_sdo": ({}, [(0x601, "data"), (0x581, "data")]),
}
"""Arguments of a fault, and the identifiers and kinds of the frames that it puts on the bus at once."""
STOPS = {
    "master_missed": ({"code": 0x8250}, 0x8250),
    "drive_fault": ({"code": 0x2310}, 0x2310),
    "motor_weak": ({}, 0x8611),
}
"""Arguments of a fault, and the EMCY code with which the drive goes into fault within 100 cycles."""


def kind(message) -> str:
    flags = {"remote": message.is_remote_frame, "error": message.is_error_frame}
    flags["extended"] = message.is_extended_id and not message.is_error_frame
    return next((name for name, present in flags.items() if present), "data")


def check_symptom(drive, program, name: str) -> None:
    """Checks the symptom of a fault on a drive in motion, by one of the tables or a function of its name."""
    if name in TPDOS:
        arguments, expected = TPDOS[name]
        assert tpdos(drive, program, name, **arguments) == expected
    elif name in FRAMES:
        arguments, expected = FRAMES[name]
        drive.fault(name, **arguments)
        assert [(each.arbitration_id, kind(each)) for each in program.messages()] == expected
    elif name in STOPS:
        arguments, code = STOPS[name]
        drive.fault(name, **arguments)
        program.move(100)
        assert (drive.emergencies, drive.state) == ((code,), "fault")
        assert stands(drive)
    else:
        globals()[name](drive, program)


def drive_deaf(drive, program):
    drive.fault("drive_deaf")
    assert program.move(30) == [[]] * 30
    assert drive.emergencies == (0x8250,)
    assert 0x701 in dict(program.seen)
    assert stands(drive)


def emergency_burst(drive, program):
    drive.fault("emergency_burst", count=5, code=0x4210)
    assert [data[:2] for _, data in program.take()] == [b"\x10\x42"] * 5
    assert drive.state == "operation enabled"


def stale_tpdo(drive, program):
    before = {each.arbitration_id: bytes(each.data) for each in program.cycle()}
    drive.fault("stale_tpdo")
    found = dict(program.take())
    assert {can_id: found[can_id] for can_id in BOTH} == before


def short_tpdo(drive, program):
    drive.fault("short_tpdo")
    assert [len(each.data) for each in program.cycle()] == [7, 8]


def tpdo_stopped(drive, program):
    fault = drive.fault("tpdo_stopped", number=2)
    assert [ids(each) for each in program.move(2)] == [[0x181], [0x181]]
    fault.end()
    assert ids(program.cycle()) == BOTH


def cable_pulled(drive, program):
    with drive.fault("cable_pulled"):
        assert program.move(2) == [[], []]
        assert stands(drive)
    assert drive.state == "fault"


def program_stalls(drive, program):
    drive.fault("program_stalls", duration_s=0.3)
    begin_s = drive.now
    program.cycle()
    assert drive.now - begin_s == pytest.approx(0.304, abs=1e-6)
    assert drive.emergencies == (0x8250,)


def babbling_node(drive, program):
    drive.fault("babbling_node", count=70)
    assert ids(program.messages()) == [0x7E5] * 70
    assert ids(program.cycle()) == BOTH


def enable_lost(drive, program):
    drive.fault("enable_lost")
    assert drive.state == "switch on disabled"
    assert drive.emergencies == ()
    assert stands(drive)


def restart(drive, program):
    drive.fault("restart")
    assert (0x701, b"\0") in program.take()
    assert drive.nmt_state == "pre operational"


def leaves_operational(drive, program):
    drive.fault("leaves_operational")
    assert (0x701, b"\x7f") in program.take()
    assert program.cycle() == []
    assert stands(drive)


def heartbeat_lost(drive, program):
    drive.fault("heartbeat_lost")
    program.move(50)
    assert 0x701 not in dict(program.seen)


def second_master_nmt(drive, program):
    drive.fault("second_master_nmt")
    assert drive.nmt_state == "pre operational"


def encoder_jump(drive, program):
    before = load_counts(program.cycle())
    with drive.fault("encoder_jump", counts=50_000):
        program.cycle()
        assert load_counts(program.cycle()) - before == pytest.approx(50_000, abs=2000)
    program.cycle()
    assert load_counts(program.cycle()) - before == pytest.approx(0, abs=3000)


def encoder_glitch(drive, program):
    before = load_counts(program.cycle())
    drive.fault("encoder_glitch", counts=50_000)
    jumps = [load_counts(each) - before > 25_000 for each in program.move(4)]
    assert jumps == [False, True, False, False]


def encoder_frozen(drive, program):
    drive.fault("encoder_frozen")
    program.cycle()
    assert len({load_counts(each) for each in program.move(5)}) == 1


def encoder_drift(drive, program):
    before = load_counts(program.cycle()) - drive.truth.load_deg * 8000
    drive.fault("encoder_drift", counts_per_s=100_000.0)
    after = load_counts(program.move(25)[-1]) - drive.truth.load_deg * 8000
    assert after - before == pytest.approx(10_000, abs=1000)


def motor_encoder_jump(drive, program):
    before = motor_counts(program.cycle())
    drive.fault("motor_encoder_jump", counts=1500)
    program.cycle()
    assert motor_counts(program.cycle()) - before > 1000
    true_before = drive.truth.motor_deg
    program.move(4)
    assert drive.truth.motor_deg < true_before - 10.0  # the control loops follow the faulty encoder


def bus_down(drive, program):
    with drive.fault("bus_down"):
        with pytest.raises(can.CanOperationError, match="Network is down"):
            program.bus.recv(0)
        assert program.bus.recv(0.1) is None  # SocketCAN reports it once
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="Network is down"):
                program.send(0x080)
        with pytest.raises(can.CanInitializationError, match="Network is down"):
            drive.open_bus()
    program.take()
    assert ids(program.cycle()) == BOTH


def bus_deleted(drive, program):
    with drive.fault("bus_deleted"), pytest.raises(can.CanOperationError, match="No such device"):
        program.bus.recv(0.1)
    assert program.bus.recv(0.1) is None
    with pytest.raises(can.CanOperationError, match="No such device"):
        program.send(0x080)
    program.bus = drive.open_bus()
    program.put(0x6040, 0, 0x80, 2)
    assert ids(program.cycle()) == BOTH


def transmit_queue_full(drive, program):
    drive.fault("transmit_queue_full")
    with pytest.raises(can.CanOperationError, match="buffer full"):
        program.send(0x080)
    assert ids(program.cycle()) == BOTH


def sdo_silent(drive, program):
    with drive.fault("sdo_silent"):
        assert program.requests(READ_TYPE) == []
    assert len(program.requests(READ_TYPE)) == 1


def wrong_value(drive, program):
    with drive.fault("wrong_value", index=0x6064, subindex=0, value=77):
        assert program.read(0x6064) == 77
        assert motor_counts(program.cycle()) == 77
    assert motor_counts(program.cycle()) > 1000


def wrong_identity(drive, program):
    drive.fault("wrong_identity", product_code=9)
    assert program.read(0x1018, 2) == 9


def missing_object(drive, program):
    drive.fault("missing_object", index=0x60E5, subindex=1)
    assert program.abort_of_read(0x60E5, 1) == 0x06090011


def no_watchdogs(drive, program):
    drive.fault("no_watchdogs")
    drive.sleep(0.5)
    assert drive.state == "operation enabled"
    assert drive.emergencies == ()


def slow_brakes(drive, program):
    """The stop takes the time given by this deceleration: 10,000 counts/s at 20,000 counts/s2."""
    drive.fault("slow_brakes", counts_per_s2=20_000.0)
    drive.fault("drive_fault")
    drive.sleep(0.4)
    assert drive.state == "fault reaction active"
    drive.sleep(0.2)
    assert drive.state == "fault"


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_injected_as_described(drive, program, name):
    check_symptom(drive, program, name)


def test_without_a_fault_no_symptom_is_seen(drive, program):
    """A drive in operation without a fault shows no symptom."""
    assert tpdos(drive, program, "heartbeat_lost") == [BOTH] * 3
    assert drive.emergencies == ()
    assert drive.state == "operation enabled"


def test_every_fault_of_the_supervision_can_be_made():
    answered = {each.reported_as for each in FAULTS.values() if each.reported_as} | {*OF_THE_PROGRAM}
    assert answered == {fault.value for fault in Fault}


def test_the_drive_lists_its_faults(drive):
    assert list(drive.faults) == list(FAULTS)
    assert "load encoder" in drive.faults["encoder_jump"]


@pytest.mark.parametrize(
    ("name", "arguments", "complaint"),
    [
        ("encoder_jmp", {}, "no fault is called 'encoder_jmp'; did you mean 'encoder_jump'"),
        ("zzz", {}, "expected one of: lost_tpdo, late_tpdo"),
        ("encoder_jump", {"cuonts": 3}, "'cuonts'; expected: counts=100000; did you mean 'counts'"),
        ("cable_pulled", {"count": 3}, "expected: none"),
        ("lost_tpdo", {"count": "two"}, "count is 'two'; expected an integer"),
        ("lost_tpdo", {"count": 1.5}, "count is 1.5; expected an integer from 0 to 100000"),
        ("tpdo_stopped", {"number": 7}, "has no object 1806h"),
        ("missing_object", {"index": 0x7000}, "has no object 7000h:01"),
        ("lost_tpdo", {"after_s": -1.0}, "after_s is -1.0; expected a number of at least 0"),
        ("lost_tpdo", {"after_s": "a"}, "after_s is 'a'; expected a number of at least 0"),
        ("lost_tpdo", {"for_s": math.nan}, "for_s is nan; expected a number of at least 0"),
        ("lost_tpdo", {"beyond_deg": "a"}, "beyond_deg is 'a'; expected a number$"),
        (5, {}, "the name of the fault is 5; expected text"),
        ("lost_tpdo", {"after_s": 1.0, "beyond_deg": 3.0}, "both given"),
    ],
)  # fmt: skip
def test_unknown_faults_are_refused_with_the_known_ones(drive, name, arguments, complaint):
    with pytest.raises(InputError, match=complaint):
        drive.fault(name, **arguments)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e30, 1e30, 10**30, -(10**30), None, [], "1", True])
def test_an_argument_that_no_drive_can_have_is_refused(drive, value):
    for name, row in FAULTS.items():
        for argument in row.arguments:
            with pytest.raises(InputError, match=rf"^fault '{name}': {argument} is .*; expected an? "):
                drive.fault(name, **{argument: value})


@pytest.mark.parametrize("name", ["program_stalls"])
def test_a_fault_impossible_on_the_bus_is_refused(name):
    with simulated_drive("article", bus="virtual") as drive, pytest.raises(InputError, match="lockstep"):
        drive.fault(name, after_s=0.1)


# ------------------------------------------------------------------ time and angle of a fault


def test_a_fault_starts_and_ends_at_its_time(drive, program):
    begin_s = drive.now
    fault = drive.fault("encoder_jump", after_s=0.1, for_s=0.05)
    program.move(100)
    assert fault.begun_s == pytest.approx(begin_s + 0.1, abs=1e-6)
    assert fault.ended_s == pytest.approx(begin_s + 0.15, abs=1e-6)


@pytest.mark.parametrize("step", [40, -40])
def test_a_fault_starts_at_a_load_angle(drive, program, step):
    here = drive.truth.load_deg
    fault = drive.fault("encoder_glitch", beyond_deg=here + (0.5 if step > 0 else -0.5))
    for _ in range(100):
        program.cycle(step=step)
        if fault.begun_s is not None:
            break
    assert drive.truth.load_deg == pytest.approx(here + (0.5 if step > 0 else -0.5), abs=0.1)


def test_a_pending_fault_can_be_cancelled(drive, program):
    fault = drive.fault("cable_pulled", after_s=0.1)
    fault.end()
    fault.end()
    assert ids(program.move(50)[-1]) == BOTH
    assert fault.begun_s is None
    assert [each.text for each in drive.log if each.kind == "fault"] == ["cable_pulled is cancelled"]
