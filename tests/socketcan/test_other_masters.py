"""Masters of other makers as their programs are; skipped where a program is missing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from .test_conform import MACHINE

SCRIPT = Path(__file__).with_name("node_canopen.js")


def test_the_npm_package_canopen_moves_it(interface, tmp_path):
    """The packages are found in NODE_PATH, or in a node_modules above this folder."""
    wanted = "require('canopen'); require('socketcan')"
    try:
        there = subprocess.run(["node", "-e", wanted], cwd=SCRIPT.parent, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("Node.js is not installed")
    if there.returncode:
        pytest.skip("npm install canopen socketcan")
    machine, eds = tmp_path / "machine.yaml", tmp_path / "bridge.eds"
    machine.write_text(MACHINE.format(channel=interface), encoding="utf-8")
    hdbridge = [sys.executable, "-m", "hdbridge"]
    text = subprocess.run([*hdbridge, "gateway", "eds", str(machine)], capture_output=True, check=True).stdout
    eds.write_bytes(text)
    simulate = [*hdbridge, "simulate", str(machine), "--gateway"]
    with subprocess.Popen(simulate, stderr=subprocess.PIPE, text=True) as drive:
        try:
            assert "ideal drive: node 5" in drive.stderr.readline()
            master = ["node", str(SCRIPT), interface, str(eds)]
            done = subprocess.run(master, capture_output=True, text=True, check=False)
        finally:
            drive.terminate()
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["name"] == "hdbridge gateway"
    assert found["profile_deg"] == pytest.approx(2.0, abs=1e-4)
    assert found["cyclic_deg"] == pytest.approx(3.0, abs=1e-4)
    assert found["unconfigured"] is None
