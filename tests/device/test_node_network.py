"""NMT, heartbeats, boot-up, and time with and without SYNC."""

import pytest


def test_pre_operational_leaves_a_profile_move_alone(master):
    master.nmt(1)
    master.enable(1)
    master.put(0x607A, 0, 4000, 4)
    master.control(0x1F)
    master.nmt(128)
    master.wait(1.0)
    assert master.read(0x6064) == 4000


def test_without_sync_the_axis_runs_on_the_clock(master, motor):
    before = motor.elapsed_s
    master.wait(1.0)
    assert motor.elapsed_s - before == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    ("period", "gaps_s", "expected_s"),
    [
        ((4, -3), [0.0035] * 100, pytest.approx(0.4)),
        ((4, -3), [0.008, *[0.004] * 9] * 10, pytest.approx(0.44)),
        ((13, -4), [0.0013] * 1000, pytest.approx(1.3, abs=0.0005)),
    ],
    ids=["each SYNC is one period", "a missed SYNC is bridged by the clock", "odd periods add up"],
)
def test_the_time_of_the_axis_with_sync(master, motor, period, gaps_s, expected_s):
    for sub, value in enumerate(period, 1):
        master.put(0x60C2, sub, value, 1)
    master.nmt(1)
    master.cycle(period_s=period[0] * 10.0 ** period[1])
    before = motor.elapsed_s
    for gap_s in gaps_s:
        master.cycle(0x00, 0, period_s=gap_s)
    assert motor.elapsed_s - before == expected_s


def test_a_stalled_process_does_not_catch_up_hours(master, motor):
    before = motor.elapsed_s
    master.node.poll(master.clock.now() + 3600.0)
    assert motor.elapsed_s - before < 1.1
