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


def test_with_sync_the_axis_runs_one_period_each(master, motor):
    master.nmt(1)
    master.cycle()
    before = motor.elapsed_s
    for _ in range(100):
        master.cycle(0x00, 0, period_s=0.0035)
    assert motor.elapsed_s - before == pytest.approx(0.4)


def test_a_missed_sync_is_bridged_by_the_clock(master, motor):
    master.nmt(1)
    master.cycle()
    before = motor.elapsed_s
    for k in range(100):
        master.cycle(0x00, 0, period_s=0.008 if k % 10 == 0 else 0.004)
    assert motor.elapsed_s - before == pytest.approx(0.44)


def test_odd_periods_add_up(master, motor):
    master.put(0x60C2, 1, 13, 1)
    master.put(0x60C2, 2, -4, 1)
    master.nmt(1)
    master.cycle(period_s=0.0013)
    before = motor.elapsed_s
    for _ in range(1000):
        master.cycle(0x00, 0, period_s=0.0013)
    assert motor.elapsed_s - before == pytest.approx(1.3, abs=0.0005)


def test_a_stalled_process_does_not_catch_up_hours(master, motor):
    before = motor.elapsed_s
    master.node.poll(master.clock.now() + 3600.0)
    assert motor.elapsed_s - before < 1.1
