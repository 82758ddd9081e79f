"""Simulated axis, either without a bus or booted on one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hdbridge.axis import AxisConfig
from hdbridge.device.node import DriveNode
from hdbridge.drive import Drive
from hdbridge.records.record import Record
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth


def record_of(truth: Truth, lead: Callable[[Exercise], None], seed: int = 0) -> Record:
    """Returns a record, with every channel, of a simulated axis that is moved by ``lead``."""
    bench = Exercise(Machine(truth, seed, may_compile=True))
    lead(bench)
    readings = bench.readings()
    return Record(
        {
            "time_s": readings.time_s,
            "motor_position_deg": readings.motor_deg,
            "load_position_deg": readings.load_deg,
            "motor_target_deg": readings.target_deg,
            "load_torque_nm": readings.load_torque_nm,
            "motor_torque_nm": readings.motor_torque_nm,
            "temperature_c": readings.temperature_c,
        }
    )


def moved(*rows: tuple[float, float, float, float]) -> Callable[[Exercise], None]:
    """Leads a bench by distances (degrees of the motor), speeds, accelerations, and rests after them (s)."""

    def lead(bench: Exercise) -> None:
        for distance, speed, acceleration, rest_s in rows:
            bench.move(distance, speed, acceleration)
            if rest_s:
                bench.hold(rest_s)

    return lead


@contextmanager
def booted(axis: AxisConfig, truth: Truth | Path, seed: int = 0) -> Iterator[tuple[Drive, DriveNode]]:
    """Provides a booted drive with a simulated axis, and its node."""
    with (
        simulated_bench(truth, axis.eds_path, axis.drive.node_id, seed) as (bus, clock, node),
        Drive(bus, axis, clock) as drive,
    ):
        drive.boot()
        yield drive, node
