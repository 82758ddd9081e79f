"""The example of docs/ci.md, taken from the page: on every bus that is here, by real runs of pytest."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support import ci_page

LEAN = [f"-p no:{each}" for each in ("xdist", "hypothesispytest", "schemathesis", "anyio", "cacheprovider")]
"""Other packages' plugins only take time here."""
NO_CANOPEN = "--ignore=test_with_canopen.py"


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    ci_page.write(pytester.path)
    options = [word for each in LEAN for word in each.split()]
    return pytester.runpytest_subprocess("-q", *options, *arguments, timeout=120)


def test_the_example_in_lockstep(pytester):
    """And the one with canopen, which says by its marker that it needs real time."""
    run(pytester).assert_outcomes(passed=13)


def test_the_example_in_real_time(pytester):
    done = run(
        pytester, "--hdbridge-bus", "virtual", NO_CANOPEN, "-k", "goes or encoder_jump or cable_pulled"
    )
    done.assert_outcomes(passed=3, deselected=9)


def test_the_example_in_two_processes(pytester):
    bus = "udp_multicast:239.74.163.7"
    done = run(pytester, "--hdbridge-bus", bus, NO_CANOPEN, "-k", "goes or drive_fault")
    done.assert_outcomes(passed=2, deselected=10)


def steps() -> list[str]:
    """The commands of the workflow."""
    workflow = yaml.safe_load(ci_page.files()[ci_page.WORKFLOW])
    return [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]


def test_the_workflow_runs_what_is_tested_here():
    assert [each for each in steps() if each.startswith("python -m pytest")] == [
        "python -m pytest",
        "python -m pytest --hdbridge-bus virtual",
        'python -m pytest --hdbridge-bus "$BUS"',
    ]
    workflow = yaml.safe_load(ci_page.files()[ci_page.WORKFLOW])
    assert [*workflow["jobs"]] == ["one-process", "two-processes"]


@pytest.mark.parametrize(
    ("has_vcan", "bus"), [(True, "socketcan:vcan0"), (False, "udp_multicast:239.74.163.2")]
)
def test_the_workflow_takes_vcan_where_it_is(tmp_path: Path, has_vcan: bool, bus: str):
    (script,) = (each for each in steps() if "modprobe" in each)
    sudo = tmp_path / "sudo"
    sudo.write_text(f"#!/bin/sh\nexit {0 if has_vcan else 1}\n", encoding="utf-8")
    sudo.chmod(0o755)
    environment = tmp_path / "environment"
    subprocess.run(
        ["bash", "-e", "-c", script],
        env={"PATH": f"{tmp_path}:{os.environ['PATH']}", "GITHUB_ENV": str(environment)},
        check=True,
    )
    assert environment.read_text(encoding="utf-8") == f"BUS={bus}\n"


def test_the_program_knows_nothing_of_hdbridge(tmp_path):
    """It runs where there is none."""
    ci_page.write(tmp_path)
    loaded = "sorted(each for each in sys.modules if each.partition('.')[0] in ('hdbridge', 'canopen'))"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys, positioner; print({loaded})"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
