"""The conformance suite over a real CAN interface, on the gateway's ideal drive in another process."""

import json
import subprocess
import sys

from support.command import run_here

MACHINE = """
schema: hdbridge.machine/1
name: between
axes:
  - profile: article
gateway:
  bus: {{interface: socketcan, channel: {channel}}}
  nodes: {{article: 5}}
"""
CHECKS = ("nmt.ignores", "sdo.abort", "sdo.block", "tpdo.sync", "rpdo", "guarding.toggle", "402.transition")


def test_conform_checks_a_drive_in_another_process(interface, tmp_path):
    machine, result = tmp_path / "machine.yaml", tmp_path / "result.json"
    machine.write_text(MACHINE.format(channel=interface), encoding="utf-8")
    only = [each for name in CHECKS for each in ("--only", name)]
    simulate = [sys.executable, "-m", "hdbridge", "simulate", str(machine), "--gateway"]
    with subprocess.Popen(simulate, stderr=subprocess.PIPE, text=True) as drive:
        try:
            assert "ideal drive: node 5" in drive.stderr.readline()
            done = run_here(tmp_path, "conform", machine, "--motion", "--json", result, *only, status=None)
        finally:
            drive.terminate()
    found = {each["id"]: each for each in json.loads(result.read_text())["checks"]}
    wrong = {name: each["found"] for name, each in found.items() if each["result"] == "fail"}
    assert wrong == {}, done.stderr
    assert done.returncode == 0
    # Remote frames and 29-bit identifiers, in the representation of the kernel.
    assert found["guarding.toggle"]["result"] == found["nmt.ignores.extended"]["result"] == "pass"
