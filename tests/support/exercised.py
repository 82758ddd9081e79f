"""Records of the simulated axis without a bus."""

from __future__ import annotations

from collections.abc import Callable

from hdbridge.records.record import Record
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth


def record_of(truth: Truth, lead: Callable[[Exercise], None], seed: int = 0) -> Record:
    """Returns the record of a simulated axis that ``lead`` moves, with every channel."""
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
