"""The stepping test as a person runs it: two processes, one real CAN interface."""

import json
import subprocess
import sys

from support.command import run_here

from hdbridge.errors import SafetyStop

ATTEMPTS = 3
"""A computer that stalls for two periods stops the axis, as intended; the test is then repeated."""


def test_step_masters_the_simulated_drive_in_another_process(interface, profile, tmp_path):
    bus = ("--interface", "socketcan", "--channel", interface)
    result = tmp_path / "stepping.json"
    simulate = [sys.executable, "-m", "hdbridge", "simulate", str(profile), *bus]
    step = ("step", profile, *bus, "--json", result, "--count", 4, "--scheme", "none", "--scheme", "both")
    for _ in range(ATTEMPTS):
        with subprocess.Popen(simulate, stderr=subprocess.PIPE, text=True) as drive:
            try:
                assert "simulated drive: node 1" in drive.stderr.readline()
                done = run_here(tmp_path, *step, status=None)
            finally:
                drive.terminate()
        if done.returncode != SafetyStop.exit_status:
            break
    assert done.returncode == 0, done.stderr
    remarks = " ".join(done.stderr.split())
    assert "on processor 0 booted" in remarks  # as the axis file says
    figures = json.loads(result.read_text())
    assert figures["none"]["cw"]["mean_arcsec"] > 30
    assert figures["none"]["ccw"]["mean_arcsec"] < -30
    assert abs(figures["both"]["cw"]["mean_arcsec"]) < 3
    assert abs(figures["both"]["ccw"]["mean_arcsec"]) < 3
    assert figures["both"]["pooled"]["three_sigma_arcsec"] < 5
