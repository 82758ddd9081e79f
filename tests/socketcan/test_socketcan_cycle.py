"""The control cycle and the simulated drive, two processes on a real Linux CAN stack."""

import re
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import can
import pytest

from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction
from hdbridge.errors import BusError


def test_the_axis_follows_over_200_cycles(master) -> None:
    feedback = master.run(200)
    assert sum(each.fresh for each in feedback) >= 180
    assert feedback[-1].motor_counts - feedback[0].motor_counts == pytest.approx(1990, abs=100)
    assert feedback[-1].cycle - feedback[0].cycle <= 280


def test_candump_shows_one_cycle_in_order(master, interface: str, tmp_path: Path) -> None:
    log = tmp_path / "candump.log"
    with log.open("wb") as output:
        candump = subprocess.Popen(["candump", "-L", interface], stdout=output)
        try:
            time.sleep(0.5)
            master.run(200)
            time.sleep(0.2)
        finally:
            candump.terminate()
            candump.wait()
    seen = re.findall(r"\(([\d.]+)\) \w+ ([0-9A-F]{3})#", log.read_text())
    cyclic = [(float(time_s), can_id) for time_s, can_id in seen if can_id in ("080", "181", "281", "201")]
    syncs = [place for place, (_, can_id) in enumerate(cyclic) if can_id == "080"]
    orders = [tuple(can_id for _, can_id in cyclic[a:b]) for a, b in pairwise(syncs[-150:])]
    assert orders.count(("080", "181", "281", "201")) >= 0.9 * len(orders)
    periods = sorted(cyclic[b][0] - cyclic[a][0] for a, b in pairwise(syncs[-150:]))
    expected = master.cycle.period_s
    assert periods[len(periods) // 2] == pytest.approx(expected, rel=0.1)
    assert periods[0] > 0.4 * expected  # late ones are skipped, never made up for by a burst


def test_frames_that_canopen_does_not_use_harm_nothing(master, intruder) -> None:
    master.run(50)
    intruder.send(can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True))
    intruder.send(can.Message(arbitration_id=0x181, is_extended_id=True, data=bytes(8)))
    for _ in range(20):
        master.move()
    assert master.supervision.stop is None
    assert master.supervision.counts[Fault.DISCARDED_FRAME] >= 1
    assert master.drive.link.dropped.remote == 1


def test_a_foreign_rpdo_stops(master, intruder) -> None:
    master.run(50)
    intruder.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=b"\x0f\0\0\0\0\0"))
    stop = master.move_until_stopped(5)
    assert "201h" in str(stop)
    assert master.drive.image.power.state is not State.OPERATION_ENABLED


def test_a_drive_that_falls_silent_stops_within_two_cycles(master, simulated) -> None:
    master.run(50)
    simulated.send_signal(signal.SIGSTOP)
    try:
        stop = master.move_until_stopped(3)
    finally:
        simulated.kill()  # continued, it would make up for the time that it has lost
        simulated.wait()
    assert master.supervision.stop.fault is Fault.LOST_TPDO
    assert "did not confirm" in str(stop)


def test_link_down_latches_and_the_way_back_is_a_new_link(
    master, another_master, may_configure, interface: str
) -> None:
    master.run(50)
    may_configure("link", "set", "down", interface)
    master.move_until_stopped(2)
    assert master.supervision.reaction is Reaction.LATCH
    assert master.supervision.counts[Fault.BUS_DOWN] == 1
    with pytest.raises(BusError):
        master.drive.link.send(0x080, b"")
    may_configure("link", "set", "up", interface)
    time.sleep(0.5)
    with another_master(interface, shared=True) as again:
        again.boot()
        assert again.run(50)[-1].fresh


def test_a_deleted_interface_latches(master, may_configure, interface: str) -> None:
    master.run(50)
    may_configure("link", "delete", interface)
    master.move_until_stopped(2)
    assert master.supervision.reaction is Reaction.LATCH
    assert master.supervision.stop.fault is Fault.BUS_DOWN


def test_a_killed_master_leaves_an_axis_that_stands_and_is_disabled(
    simulated, another_master, interface: str, profile: Path
) -> None:
    script = Path(__file__).with_name("master_to_kill.py")
    victim = subprocess.Popen([sys.executable, str(script), interface, str(profile)], stdout=subprocess.PIPE)
    try:
        assert victim.stdout is not None
        assert victim.stdout.readline() == b"moving\n"
    finally:
        victim.kill()
        victim.wait()
        victim.stdout.close()
    time.sleep(1.0)
    with another_master(interface) as again:
        first = again.drive.read_positions()
        time.sleep(0.3)
        second = again.drive.read_positions()
        assert abs(first.motor_counts - second.motor_counts) <= 2
        assert again.drive.state() is not State.OPERATION_ENABLED
        again.boot()
        again.drive.wait(0.2)
        assert again.drive.state() is not State.OPERATION_ENABLED
