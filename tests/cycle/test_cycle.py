"""The control cycle on the simulated drive and a virtual clock: order, deadlines, answers."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest

from hdbridge.control.cycle import Feedback
from hdbridge.drive.states import State


def test_sync_comes_first_and_the_rpdo_after_the_feedback(moving) -> None:
    seen = []

    def command(feedback: Feedback) -> int:
        seen.append([can_id for _, can_id, _ in moving.sent])
        return moving.target

    moving.cycle.tick(command)
    assert seen == [[0x080]]
    assert [can_id for _, can_id, _ in moving.sent][:2] == [0x080, 0x201]


def test_work_between_ticks_does_not_shift_the_deadlines(moving) -> None:
    for _ in range(20):
        moving.clock.sleep_until(moving.clock.now() + 0.0015)
        moving.move()
    times = [time_s for time_s, _ in moving.frames(0x080)]
    assert times[-1] - times[0] == pytest.approx(0.004 * 19, abs=1e-9)
    assert moving.cycle.overruns == 0


def test_no_command_holds_the_last_target(moving) -> None:
    moving.move()
    moving.cycle.tick(None)
    moving.cycle.tick(lambda feedback: None)
    targets = [struct.unpack("<Hi", data)[1] for _, data in moving.frames(0x201)]
    assert targets == [moving.target] * 3


def test_the_target_is_the_actual_position_before_power(idle) -> None:
    for _ in range(10):
        feedback = idle.cycle.tick(123_456)
    assert idle.drive.image.power.state is not State.OPERATION_ENABLED
    for _, data in idle.frames(0x201):
        assert struct.unpack("<Hi", data)[1] == feedback.motor_counts


def test_the_first_cycle_after_a_rest_sends_the_heartbeat(idle) -> None:
    idle.cycle.tick()
    idle.clock.sleep_until(idle.clock.now() + 0.010)
    idle.cycle.restart()
    idle.sent.clear()
    idle.cycle.tick()
    assert [can_id for _, can_id, _ in idle.sent] == [0x201, 0x080, 0x201, 0x77F]


def test_heartbeats_missed_in_a_stall_are_not_sent_later(idle) -> None:
    idle.node.faults.ignore_lost_heartbeat = True
    for pause_s in (0.0, 0.3):
        idle.clock.sleep_until(idle.clock.now() + pause_s)
        for _ in range(50):
            idle.cycle.tick()
    times = [time_s for time_s, _ in idle.frames(0x77F)]
    gaps = [b - a for a, b in pairwise(times)]
    period_s = idle.drive.image.heartbeat_period_s
    assert max(gaps) >= 0.3
    assert min(gaps) >= period_s - idle.cycle.period_s - 1e-9


def test_an_overrun_skips_whole_periods_and_never_bursts(moving) -> None:
    before = moving.move()
    moving.clock.sleep_until(moving.clock.now() + 0.007)
    after = moving.move()
    assert moving.cycle.overruns == 1
    assert moving.cycle.skipped == 1
    assert after.cycle == before.cycle + 2
    moving.move(10)
    times = [time_s for time_s, _ in moving.frames(0x080)]
    gaps = [b - a for a, b in pairwise(times)]
    assert gaps == pytest.approx([0.008] + [0.004] * 10, abs=1e-9)
    assert moving.supervision.stop is None


def test_a_pause_is_not_judged_after_a_restart(moving) -> None:
    moving.cycle.tick()
    number = moving.cycle.tick().cycle
    moving.drive.image.power.go(State.SWITCHED_ON)
    for _ in range(10):
        number = moving.cycle.tick().cycle
    moving.clock.sleep_until(moving.clock.now() + 0.03)
    moving.cycle.restart()
    feedback = moving.cycle.tick()
    assert feedback.cycle == number + 1
    assert feedback.fresh
    assert moving.supervision.stop is None
    assert moving.cycle.skipped == 0


def test_exceptions_of_the_command_propagate(moving) -> None:
    def broken(feedback: Feedback) -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        moving.cycle.tick(broken)
