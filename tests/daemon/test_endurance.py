"""The endurance tool, for a few minutes of axis time: nothing grows, and every missed cycle is told."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "bench" / "endurance.py"
MINUTES = 4.0
FAULTS = {"bus_down", "emergency", "lost_frames", "node_reset", "odd_frames", "quick_stop", "stall"}
WISHES = {"activate", "compensate", "jog", "move", "queue", "retarget", "stream"}


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_minutes_of_everything_leave_nothing_behind(tmp_path: Path) -> None:
    kept = tmp_path / "found.json"
    hours, every = str(MINUTES / 60.0), str(MINUTES / 16.0)
    done = subprocess.run(
        [sys.executable, TOOL, "--json", kept, "stepped", "--hours", hours, "--every", every],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "no growth" in done.stdout
    assert "Traceback" not in done.stderr
    found = json.loads(kept.read_text(encoding="utf-8"))
    assert found["axis_h"] >= MINUTES / 60.0
    assert found["happened"].keys() >= FAULTS | WISHES
    assert found["overruns"] > 0
    assert found["skipped"] == found["skipped told in events"] == found["accounts"]["missing"]
    assert found["accounts"]["lost"] == 0
    assert found["recorder"]["dropped"] == found["recorder"]["refused"] == 0
