"""The motion program on a simulated drive; pytest.ini or the command line chooses the bus."""

import subprocess
import sys

import positioner
import pytest


@pytest.fixture
def drive(hdbridge_drive, monkeypatch):
    monkeypatch.setattr(positioner, "time", hdbridge_drive.time)  # matters in lockstep only
    return hdbridge_drive


def run(drive, load_deg):
    """The program's exit status: in this process, or in one of its own where the bus reaches that."""
    arguments = ["--interface", drive.interface, "--channel", drive.channel, str(load_deg)]
    if drive.in_process:
        return positioner.main(arguments)
    program = [sys.executable, positioner.__file__, *arguments]
    return subprocess.run(program, timeout=60, check=False).returncode


def test_the_load_goes_where_it_shall(drive):
    assert run(drive, 3.0) == 0
    assert drive.truth.load_deg == pytest.approx(3.0, abs=0.05)
    assert max(moment.load_deg for moment in drive.trace) < 3.1  # no overshoot
    assert drive.emergencies == ()


@pytest.mark.parametrize(
    "fault", ["encoder_jump", "cable_pulled", "drive_fault", "enable_lost", "restart", "motor_weak"]
)
def test_a_fault_on_the_way_stops_the_axis(drive, fault):
    drive.fault(fault, beyond_deg=1.0)
    assert run(drive, 6.0) == 1
    drive.wait_until(lambda: drive.state != "operation enabled")
    drive.sleep(0.2)
    stands_at = drive.truth.load_deg
    drive.sleep(0.3)
    assert drive.truth.load_deg == pytest.approx(stands_at, abs=0.001)
    assert stands_at < 5.0


@pytest.mark.parametrize("fault", ["duplicated_tpdo", "emergency_burst", "remote_frame", "encoder_drift"])
def test_a_harmless_fault_does_not_stop_it(drive, fault):
    drive.fault(fault, beyond_deg=1.0)
    assert run(drive, 3.0) == 0


@pytest.mark.hdbridge_drive(bus="lockstep")
def test_the_drive_stops_by_itself_while_the_program_hangs(drive):
    drive.fault("program_stalls", beyond_deg=1.0, duration_s=2.0)
    assert run(drive, 6.0) == 1
    assert 0x8250 in drive.emergencies
    assert drive.truth.load_deg < 3.0


def test_the_drive_stops_by_itself_when_the_program_is_killed(drive):
    if drive.in_process:
        pytest.skip("the program has no process of its own on this bus")
    arguments = ["--interface", drive.interface, "--channel", drive.channel, "100.0"]
    program = subprocess.Popen([sys.executable, positioner.__file__, *arguments])
    drive.wait_until(lambda: drive.truth.load_deg > 1.0, timeout_s=30)
    program.kill()
    program.wait()
    drive.wait_until(lambda: drive.state == "fault")
    assert drive.emergencies == (0x8250,)  # set-points are missing
