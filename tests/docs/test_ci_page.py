"""The example of docs/ci.md, in docs/ci-example: on every available bus, by real runs of pytest."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import yaml
from support import ci_page

LEAN = [f"-p no:{each}" for each in ("xdist", "hypothesispytest", "schemathesis", "anyio", "cacheprovider")]
"""Other packages' plugins only take time here."""
NO_CANOPEN = "--ignore=test_with_canopen.py"


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    ci_page.write(pytester.path)
    options = [word for each in LEAN for word in each.split()]
    return pytester.runpytest_subprocess("-q", *options, *arguments)


def test_the_example_in_lockstep(pytester):
    """The example with canopen is skipped, because its marker states that it needs real time."""
    run(pytester).assert_outcomes(passed=13, skipped=1)


MY_PROGRAM = """
import positioner


def main(interface, channel):
    assert positioner.main(["--interface", interface, "--channel", channel, "14"]) == 1
"""


def test_the_example_in_real_time(pytester):
    """The run includes the first lines of the page."""
    pytester.makepyfile(my_program=MY_PROGRAM)
    (lines,) = re.findall(
        r"\n\n((?: {4}.*\n)*? {4}def test_my_program.*\n(?: {4}.*\n)*)", ci_page.PAGE.read_text("utf-8")
    )
    pytester.makepyfile(test_ci="import my_program\n" + textwrap.dedent(lines))
    done = run(pytester, "--hdbridge-bus", "virtual", NO_CANOPEN, "-k", "goes or encoder_jump or my_program")
    done.assert_outcomes(passed=3, deselected=11)


def test_the_example_in_two_processes(pytester):
    bus = "udp_multicast:239.74.163.7"
    done = run(pytester, "--hdbridge-bus", bus, NO_CANOPEN, "-k", "goes or killed")
    done.assert_outcomes(passed=2, deselected=11)


def steps() -> list[str]:
    """Returns the commands of the workflow."""
    workflow = yaml.safe_load(ci_page.WORKFLOW.read_text("utf-8"))
    return [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]


def test_the_workflow_runs_what_is_tested_here():
    assert [each for each in steps() if each.startswith("python -m pytest")] == [
        "python -m pytest",
        "python -m pytest --hdbridge-bus virtual",
        'python -m pytest --hdbridge-bus "$BUS"',
    ]


def test_the_gitlab_file_does_the_same():
    after = re.split(r"GitLab\s+CI, in", ci_page.PAGE.read_text("utf-8"))[1]
    lines = re.search(r"\n\n((?: {4}.*\n)+)", after)
    assert lines is not None
    job = yaml.safe_load(textwrap.dedent(lines[1]))["motion"]
    one_process = yaml.safe_load(ci_page.WORKFLOW.read_text("utf-8"))["jobs"]["one-process"]
    assert job["script"] == [step["run"] for step in one_process["steps"] if "run" in step]


@pytest.mark.parametrize(
    ("has_vcan", "bus"), [(True, "socketcan:vcan0"), (False, "udp_multicast:239.74.163.2")]
)
def test_the_workflow_uses_vcan_if_present(tmp_path: Path, has_vcan: bool, bus: str):
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


def test_the_program_does_not_import_hdbridge(tmp_path):
    """The workflow runs on a runner without a CAN interface."""
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
