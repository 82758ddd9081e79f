"""``tools/socketcan.sh`` without a bootable user-mode-linux states the reason; its exit status is 69."""

import os
import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "socketcan.sh"
UNAVAILABLE, BROKEN = 69, 70
IS_COMPLETE = all(shutil.which(each) for each in ("linux.uml", "insmod", "ip", "candump")) and any(
    Path("/usr/lib/uml/modules").rglob("vcan.ko")
)

pytestmark = pytest.mark.skipif(not IS_COMPLETE, reason="user-mode-linux is not installed")


@pytest.fixture
def run_with(tmp_path: Path):
    """Runs a command with stub programs (name: shell text) in place of the machine's."""

    def run(*options: str, **programs: str) -> subprocess.CompletedProcess[str]:
        for name, text in programs.items():
            path = tmp_path / name.replace("_", ".")
            path.write_text(f"#!/bin/sh\n{text}\n")
            path.chmod(0o755)
        locks = {"SOCKETCAN_LOCKS": str(tmp_path / "locks")}  # the script may run elsewhere on this machine
        environment = dict(os.environ, PATH=f"{tmp_path}:{os.environ['PATH']}") | locks
        return subprocess.run(
            [SCRIPT, "--uml", *options, "true"], env=environment, capture_output=True, text=True, check=False
        )

    return run


def test_an_unbootable_kernel_is_unavailable_with_a_reason(run_with) -> None:
    done = run_with(linux_uml="echo Kernel panic: no floating point; kill -ABRT $$")
    assert done.returncode == UNAVAILABLE
    assert "Kernel panic: no floating point" in done.stderr
    assert "does not boot here" in done.stderr


def test_a_kernel_that_boots_and_then_dies_has_failed(run_with) -> None:
    done = run_with(
        linux_uml='for each; do case $each in uml_dir=*) : >"${each#uml_dir=}/ready";; esac; done'
    )
    assert done.returncode == BROKEN


def test_a_failing_compiler_is_reported_and_the_kernel_tried_as_is(run_with) -> None:
    done = run_with(cc="echo no such header >&2; exit 1", linux_uml="echo preload=$LD_PRELOAD; exit 1")
    assert done.returncode == UNAVAILABLE
    assert "no such header" in done.stderr
    assert "preload=\n" in done.stderr


@pytest.mark.parametrize(("options", "policy"), [((), "SCHED_OTHER"), (("--realtime",), "SCHED_RR")])
def test_real_time_priority_is_given_on_request_only(run_with, options, policy) -> None:
    """Two kernels at real-time priority starve everything else on a machine with two processors."""
    if options and subprocess.run(["chrt", "--rr", "1", "true"], check=False, capture_output=True).returncode:
        pytest.skip("real-time priority is not permitted here")
    done = run_with(*options, linux_uml="chrt -p $$; exit 1")
    assert f"scheduling policy: {policy}" in done.stderr


def test_two_runs_get_a_processor_each(run_with, tmp_path: Path) -> None:
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("this machine has one processor")
    # Each process waits for the other, then prints its processor.
    kernel = tmp_path / "linux.uml"
    kernel.write_text(
        f"#!/bin/sh\ncd {tmp_path}; touch $$.here\n"
        "for i in $(seq 100); do [ $(ls *.here | wc -l) -ge 2 ] && break; sleep 0.1; done\n"
        "taskset -pc $$; exit 1\n"
    )
    kernel.chmod(0o755)
    with ThreadPoolExecutor(2) as pool:
        said = [each.result().stderr for each in [pool.submit(run_with), pool.submit(run_with)]]
    processors = [re.search(r"affinity list: (\d+)$", each, re.MULTILINE) for each in said]
    assert len({each[1] for each in processors if each}) == 2, said


def test_computing_takes_little_time_and_idle_time_is_skipped() -> None:
    """Time is the guest's own, so a busy machine does not affect it.

    This holds from the start of the command, before any idle time. The counting loop takes the machine at
    least a tenth of a second. While the kernel boots, time passes eight times as fast.
    """
    counted = "i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done"
    slept = f"cat /proc/uptime; {counted}; cat /proc/uptime; sleep 3600; cat /proc/uptime"
    done = subprocess.run(
        [SCRIPT, "--uml", "--timeout", "120", "--slowed", "50", "sh", "-c", slept],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == UNAVAILABLE:
        pytest.skip(done.stderr.splitlines()[-1])
    begun, before, after = (float(line.split()[0]) for line in done.stdout.splitlines())
    assert before - begun < 0.3
    assert 3600.0 <= after - before < 3601.0
