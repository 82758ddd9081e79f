"""The hooks with which a test makes the drive misbehave."""

import struct

import pytest


@pytest.fixture
def running(master):
    master.nmt(1)
    master.cycle(0x00, 0)
    return master


def sync(master) -> list[tuple[int, bytes]]:
    master.take()
    master.send(0x080)
    frames = master.take()
    master.wait(0.004)
    return frames


def ids(frames) -> list[int]:
    return [can_id for can_id, _ in frames]


def test_lost_tpdos(running):
    running.node.faults.drop_tpdos = 3
    assert [ids(sync(running)) for _ in range(3)] == [[], [0x281], [0x181, 0x281]]


def test_short_tpdos(running):
    running.node.faults.shorten_tpdos = 1
    assert [len(data) for _, data in sync(running)] == [7, 8]
    assert [len(data) for _, data in sync(running)] == [8, 8]


def test_duplicated_tpdos(running):
    running.node.faults.duplicate_tpdos = 1
    assert ids(sync(running)) == [0x181, 0x181, 0x281]


def test_tpdos_held_back_come_after_the_fresh_ones(running, motor):
    running.node.faults.hold_tpdos = 1
    assert ids(sync(running)) == [0x281]
    motor.position = 55.0
    running.wait(0.01)
    frames = sync(running)
    assert ids(frames) == [0x181, 0x281, 0x181]
    assert [struct.unpack_from("<i", frames[k][1], 2)[0] for k in (0, 2)] == [55, 0]


def test_a_muted_heartbeat(running):
    running.put(0x1017, 0, 20, 2)
    running.node.faults.mute_heartbeat = True
    assert ids(running.wait(0.2005)) == []
    running.node.faults.mute_heartbeat = False
    assert ids(running.wait(0.2)) == [0x701] * 10


def test_an_encoder_jump_is_seen_at_the_load_alone(running):
    running.node.faults.load_jump_counts = 5000
    for _ in range(2):
        row = running.cycle(0x00, 0)
    assert (row[1], row[3]) == (0, 5000)


def test_a_load_encoder_that_stands_still_while_the_axis_moves(running):
    running.node.faults.load_reading = lambda counts: 77
    running.enable_csp()
    running.cruise(40, 5)
    running.cycle()
    moved = running.cycle()
    assert moved[1] >= 200
    assert moved[3] == 77
    running.node.faults.load_reading = None
    running.cycle()
    assert running.cycle()[3] == pytest.approx(moved[1] * 7.2, abs=1.0)


def test_a_boot_up_in_motion(master, motor):
    master.enable_csp()
    master.cruise(40, 5)
    master.node.faults.boot_up()
    master.wait(0.001)
    assert (0x701, b"\0") in master.seen
    assert sync(master) == []
    assert master.state == "disabled"
    assert motor.powered is False


def test_a_silent_drive_stops_by_itself(master, motor):
    master.put(0x1400, 5, 10, 2)
    master.enable_csp()
    master.cruise(40, 5)
    master.node.faults.silent = True
    for _ in range(5):
        assert sync(master) == []
    master.wait(0.5)
    assert motor.velocity_counts_s == 0.0
    master.node.faults.silent = False
    assert master.state == "fault"
