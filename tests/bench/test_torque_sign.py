"""The sign of the motor torque, from the simulated drive to the record: it accelerates the motor forward."""

from pathlib import Path

import pytest
from support.bare_axis import truth
from support.exercised import booted, moved, record_of
from support.moves import Moves
from support.torque import check_torque, directed

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.motion.procedures.moves import Dwell, MoveTo
from hdbridge.sim.machine import Machine

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


@pytest.mark.parametrize("direction", [1, -1])
def test_a_record_of_the_bench_has_the_torque_that_accelerates_the_motor(direction: int) -> None:
    known = truth(motor__encoder__direction=direction)
    axis = directed(AxisConfig.load(PROFILE), direction)
    with booted(axis, known) as (drive, _):
        record = (
            Bench(drive)
            .run(Moves(MoveTo(20.0), Dwell(0.2), MoveTo(0.0), Dwell(0.2), MoveTo(-20.0), Dwell(0.2)))
            .record
        )
    check_torque(known, record)


@pytest.mark.parametrize("direction", [1, -1])
def test_readings_of_the_simulated_axis_have_the_torque_that_accelerates_the_motor(direction: int) -> None:
    known = truth(motor__encoder__direction=direction)
    lead = moved((1000.0, 900.0, 9000.0, 0.2), (-2000.0, 900.0, 9000.0, 0.2))
    check_torque(known, record_of(known, lead))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_drive_reports_its_torque_in_the_direction_of_its_encoder(direction: int, way: float) -> None:
    """In counts, the torque has the sign of the acceleration, whichever way the encoder counts."""
    known = truth(motor__encoder__direction=direction)
    machine = Machine(known, 1)
    place = 0.0
    for cycle in range(30):
        here, place = place, place + way * 2.0 * cycle
        machine.follow(here, place, 8)
    assert machine.motor_counts * way > 500
    assert machine.torque_permille * way > 50
    assert machine.torque_nm * way == pytest.approx(
        1e-3 * abs(machine.torque_permille) * known.motor.rated_torque_nm, rel=0.02
    )
