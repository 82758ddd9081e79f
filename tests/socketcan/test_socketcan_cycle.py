"""The control cycle and the simulated drive, two processes on a real Linux CAN stack."""

import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest

from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction
from hdbridge.errors import BusError
from tests.socketcan.conftest import master_on


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


def test_link_down_latches_and_recovery_needs_a_new_link(master, may_configure, interface: str) -> None:
    master.run(50)
    may_configure("link", "set", "down", interface)
    master.move_until_stopped(2)
    assert master.supervision.reaction is Reaction.LATCH
    assert master.supervision.counts[Fault.BUS_DOWN] == 1
    with pytest.raises(BusError):
        master.drive.link.send(0x080, b"")
    may_configure("link", "set", "up", interface)
    time.sleep(0.5)
    with master_on(interface, shared=True) as again:
        again.boot()
        assert again.run(50)[-1].fresh


def test_a_killed_master_leaves_a_stopped_and_disabled_axis(simulated, interface: str, profile: Path) -> None:
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
    with master_on(interface) as again:
        first = again.drive.read_positions()
        time.sleep(0.3)
        second = again.drive.read_positions()
        assert abs(first.motor_counts - second.motor_counts) <= 2
        assert again.drive.state() is not State.OPERATION_ENABLED
        again.boot()
        again.drive.wait(0.2)
        assert again.drive.state() is not State.OPERATION_ENABLED
