"""Tests of the computer's clock."""

import subprocess
import sys

import pytest

LATER_S = 86_400
AHEAD = (
    "import time; from hdbridge.clock import MonotonicClock; print(MonotonicClock().now() - time.monotonic())"
)


def test_the_time_in_which_the_computer_is_suspended_counts() -> None:
    """A namespace in which CLOCK_BOOTTIME is a day later shows what a suspended day shows."""
    suspended = ("unshare", "--map-root-user", "--fork", "--time", "--boottime", str(LATER_S))
    try:
        subprocess.run([*suspended, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no time namespace: {error}")
    run = subprocess.run(
        [*suspended, sys.executable, "-c", AHEAD], check=True, capture_output=True, text=True
    )
    assert float(run.stdout) > 0.9 * LATER_S
