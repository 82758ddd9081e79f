"""The control cycle and the simulated drive, two processes on a real Linux CAN stack."""

import re
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import pytest


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
    assert periods[0] > 0.4 * expected  # late cycles are skipped, never made up for by a burst
