"""Samples of an axis without a control loop, computed from a path, a model and the truth.

The truth is also a model: the gear obeys the same laws as the model but with other parameters, and a watch
must notice changes of the parameters. The motor follows its target one cycle late, both encoders have finite
resolution, and the load encoder is noisy.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Motion
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.memory import NO_FAULT, SampleFlag, sample_dtype

ENABLED, HOLD, GOTO = 3, 0, 1
OPERATION_ENABLED = 4

FloatArray = NDArray[np.float64]


@dataclass
class SampleMaker:
    """Generates consecutive samples of an axis."""

    axis: AxisConfig
    model: TransmissionModel
    truth: TransmissionModel
    seed: int = 0
    noise_arcsec: float = 0.3
    zero_arcsec: float = 7.0
    compensated: bool = True

    def make(self, load_target_deg: FloatArray, first_cycle: int = 1000) -> Any:
        """Returns one sample per cycle for a path of load targets."""
        random = np.random.default_rng([self.seed, first_cycle])
        count = len(load_target_deg)
        period_s, ratio = self.axis.drive.cycle_s, self.model.ratio
        cycle = first_cycle + np.arange(count)
        time_s = cycle * period_s
        velocity = np.gradient(load_target_deg, period_s)
        velocity[np.abs(velocity) < 1e-9] = 0.0
        issued = ratio * load_target_deg
        if self.compensated:
            for _ in range(2):
                said = self.model.predict(Motion(issued, time_s))
                issued = ratio * (load_target_deg - said / 3600.0)
        predicted = self.model.predict(Motion(issued, time_s))
        motor = np.concatenate([issued[:1], issued[:-1]])
        error = self.truth.predict(Motion(motor, time_s)) + self.zero_arcsec
        load = motor / ratio + error / 3600.0 + random.normal(0.0, self.noise_arcsec, count) / 3600.0
        samples = np.zeros(count, sample_dtype(1))
        samples["sequence"] = cycle - first_cycle + 1
        samples["cycle"] = cycle
        samples["time_ns"] = (time_s * 1e9).astype(np.int64) + 5_000_000_000
        samples["busy_us"] = 300.0
        samples["bus_load"] = 0.2
        axis = samples["axes"][:, 0]
        axis["state"], axis["power"], axis["fault"] = ENABLED, OPERATION_ENABLED, NO_FAULT
        axis["mode"] = np.where(velocity == 0.0, HOLD, GOTO)
        axis["statusword"] = 0x1237
        axis["flags"] = SampleFlag.FRESH | SampleFlag.COMPENSATING | SampleFlag.MEMORY_KNOWN
        axis["flags"] += np.where(velocity == 0.0, SampleFlag.AT_REST, 0).astype(np.uint16)
        axis["load_target_deg"] = load_target_deg
        axis["velocity_deg_s"] = velocity
        axis["issued_deg"] = issued
        axis["motor_target_deg"] = motor
        axis["motor_position_deg"] = counted(motor, self.axis.motor_encoder.counts_per_turn)
        axis["load_position_deg"] = counted(load, self.axis.load_encoder.counts_per_turn)
        axis["motor_torque_nm"] = 0.05 * np.sign(velocity)
        axis["predicted_arcsec"] = predicted
        axis["correction_arcsec"] = 3600.0 * (load_target_deg - issued / ratio)
        axis["weight"] = float(self.compensated)
        return samples


def counted(angle_deg: FloatArray, counts_per_turn: int) -> FloatArray:
    """Rounds an angle to whole counts."""
    counted_deg: FloatArray = np.round(angle_deg * counts_per_turn / 360.0) * 360.0 / counts_per_turn
    return counted_deg


def moves_and_rests(
    duration_s: float, period_s: float, seed: int = 0, speed_deg_s: float = 10.0
) -> FloatArray:
    """Returns load targets of an axis at work: smooth moves to random places within 60 degrees,
    at several speeds, and rests.
    """
    random = np.random.default_rng(seed)
    parts: list[FloatArray] = []
    place, samples = 0.0, 0
    while samples * period_s < duration_s:
        goal = random.uniform(-60.0, 60.0)
        cruise = speed_deg_s * random.uniform(0.1, 1.0)
        steps = max(int(abs(goal - place) / cruise / period_s), 10)
        parts.append(_ramped(place, goal, steps, period_s))
        place = goal
        rest = int(random.uniform(0.3, 4.0) / period_s)
        parts.append(np.full(rest, goal))
        samples += len(parts[-2]) + rest
    return np.concatenate(parts)[: int(duration_s / period_s)]


def _ramped(start: float, goal: float, steps: int, period_s: float) -> FloatArray:
    """Returns a move at constant speed between two smooth ramps of 0.2 s."""
    ramp = min(int(0.2 / period_s), steps // 3 + 1)
    window = np.hanning(ramp + 2)[1:-1]
    speed = np.convolve(np.ones(steps), window / np.sum(window))
    path: FloatArray = start + (goal - start) * np.cumsum(speed) / np.sum(speed)
    path[-1] = goal
    return path
