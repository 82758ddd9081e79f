"""The fault row of a killed control process can fail: it needs a drive that stops by its own supervision."""

import pytest
from support.daemon_bench import Witness

from hdbridge.testing import SimulatedDrive
from tests.testing.conftest import PERIOD_S, Program

ALLOWED = 25
HEARTBEAT_MS = 60


def silenced(program: Program) -> Witness:
    """Ends the program's frames in motion, and watches the drive."""
    program.put(0x1016, 1, 0x7F << 16 | HEARTBEAT_MS, 4)
    program.send(0x77F, b"\x05")
    program.move(3)
    witness = Witness(program.drive.open_bus(), PERIOD_S, program.drive.time.monotonic)
    witness.begin()
    return witness


def test_a_drive_that_misses_set_points_stops(program: Program, drive: SimulatedDrive) -> None:
    assert silenced(program).cycles_until_own_stop(ALLOWED) == pytest.approx(20e-3 / PERIOD_S, abs=1)
    assert drive.emergencies == (0x8250,)


def test_a_drive_that_misses_heartbeats_stops(program: Program, drive: SimulatedDrive) -> None:
    drive._node.faults.ignore_missing_set_points = True
    assert silenced(program).cycles_until_own_stop(ALLOWED) == pytest.approx(12, abs=2)
    assert drive.emergencies == (0x8130,)


def test_a_drive_without_watchdogs_fails_the_row(program: Program, drive: SimulatedDrive) -> None:
    drive.fault("no_watchdogs")
    with pytest.raises(AssertionError, match="not within 25 cycles"):
        silenced(program).cycles_until_own_stop(ALLOWED)


@pytest.mark.parametrize("ignored", ["by option 6007h", "by its firmware"])
def test_a_drive_that_only_reports_the_lost_master_fails_the_row(program, drive, ignored):
    if ignored == "by option 6007h":
        program.put(0x6007, 0, 0, 2)
    else:
        drive._node.faults.ignore_missing_set_points = True
        drive._node.faults.only_report_lost_heartbeat = True
    with pytest.raises(AssertionError, match="reports a lost master but does not stop"):
        silenced(program).cycles_until_own_stop(ALLOWED)
