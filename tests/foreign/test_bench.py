"""The project's public commands on foreign axes, over real frames on the virtual bus."""

import math
from dataclasses import replace

import numpy as np
import pytest
from foreign.bench import bench_of, foreign_bench
from foreign.draw import draw
from foreign.servos import STRUCTURES

from hdbridge import AxisConfig, Bench, Drive, Stepping, Trajectory

every_structure = pytest.mark.parametrize("structure", STRUCTURES)


def there_and_back(axis: AxisConfig, start_deg: float, way_deg: float) -> Trajectory:
    """Returns a smooth path within the limits: two cycloids."""
    limits = axis.limits
    half_s = max(
        2.2 * way_deg / limits.velocity_deg_s,
        math.sqrt(2.2 * math.pi * way_deg / limits.acceleration_deg_s2),
        (1.1 * math.tau**2 * way_deg / limits.jerk_deg_s3) ** (1.0 / 3.0),
    )

    def at(time_s: float) -> float:
        share = min(time_s, 2.0 * half_s - time_s) / half_s
        return start_deg + way_deg * (share - math.sin(math.tau * share) / math.tau)

    return Trajectory.of(at, duration_s=2.0 * half_s)


@every_structure
def test_an_axis_boots_moves_and_follows_a_trajectory(structure, tmp_path):
    with foreign_bench(0, structure, tmp_path) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
        assert [path.name for path in tmp_path.iterdir()] == ["axis.yaml"]
        drive.boot()
        drive.enable()
        drive.move_to(5.0)
        assert drive.read_positions().load_deg == pytest.approx(5.0, abs=0.05)
        assert bench.machine.true_load_deg == pytest.approx(5.0, abs=0.05)
        drive.disable()
        run = Bench(drive).run(there_and_back(bench.axis, 5.0, 60.0))
    record, ratio = run.record, bench.axis.gear.ratio
    assert record.load_position_deg.max() == pytest.approx(65.0, abs=2.0)
    error_arcsec = record.transmission_error_arcsec(ratio)
    assert np.abs(error_arcsec).max() < 700.0
    assert np.ptp(error_arcsec[-20:]) < 30.0
    torque_nm = record.columns["motor_torque_nm"]
    assert (
        0.02 * bench.truth.servo.rated_torque_nm
        < np.abs(torque_nm).max()
        < 3.0 * bench.truth.servo.rated_torque_nm
    )


@every_structure
def test_the_same_seed_gives_the_same_record_over_the_bus(structure, tmp_path):
    def record(folder):
        with foreign_bench(1, structure, folder) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
            drive.boot()
            return Bench(drive).run(there_and_back(bench.axis, 0.0, 10.0)).record

    assert record(tmp_path / "one") == record(tmp_path / "two")


def test_the_stepping_test_measures_the_static_law(tmp_path):
    with foreign_bench(1, "observed", tmp_path) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
        drive.boot()
        outcome = Bench(drive).run(Stepping(count=12)).outcome
    both = zip(outcome.cw[:-1], reversed(outcome.ccw[:-1]), strict=True)
    loop = np.mean([up.error_arcsec - down.error_arcsec for up, down in both])
    law = bench.truth.mechanics.hysteresis
    offset = getattr(law, "offset_arcsec", None) or sum(limit for limit, _ in law.elements)
    assert loop == pytest.approx(2.0 * offset, rel=0.15)


def test_a_changed_axis_and_a_mass_on_it_reach_the_bus(tmp_path):
    truth = draw(1, "pi_notch")
    heavy = replace(truth, mechanics=replace(truth.mechanics, gravity_nm=8.0))
    with bench_of(heavy, tmp_path) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
        drive.boot()
        record = Bench(drive).run(there_and_back(bench.axis, 0.0, 60.0)).record
    torque_nm = record.columns["load_torque_nm"]
    assert torque_nm.min() == pytest.approx(-8.0 * math.sin(math.radians(60.0)), rel=0.03)
