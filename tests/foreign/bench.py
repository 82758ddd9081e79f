"""A foreign axis on the virtual bus: bus, clock, node and axis file.

    with foreign_bench(3, "piv", tmp_path) as bench, Drive(bench.bus, bench.axis, bench.clock) as drive:
        drive.boot()

The profile folder has an axis file and nothing else. The truth is in ``bench.truth``, for the judge.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from foreign.draw import Truth, draw
from foreign.machine import ForeignMachine

from hdbridge.axis import AxisConfig
from hdbridge.device.dictionary import Dictionary
from hdbridge.device.nameplate import Nameplate
from hdbridge.device.node import DriveNode
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, lockstep_bench

REACH_DEG = 4000.0
TORQUE = """load_torque:
  source: {index: 0x2101, subindex: 0, type: int32, via: tpdo}
  newton_metres_per_count: 0.001
"""


@dataclass(frozen=True)
class ForeignBench:
    """Test bench with a foreign axis: a servo that the simulated drive does not have."""

    bus: LockstepBus
    clock: VirtualClock
    node: DriveNode
    axis: AxisConfig
    machine: ForeignMachine
    """The plant, for true angles."""
    truth: Truth


@contextmanager
def foreign_bench(
    seed: int, structure: str, folder: Path, cycle_ms: float | None = None
) -> Iterator[ForeignBench]:
    """Switches on the foreign axis of a seed and writes its axis file to ``folder``."""
    with bench_of(draw(seed, structure, cycle_ms), folder) as bench:
        yield bench


@contextmanager
def bench_of(truth: Truth, folder: Path) -> Iterator[ForeignBench]:
    """Switches on the axis of a given truth, for example one that was changed."""
    axis, machine = AxisConfig.load(write_axis(truth, folder)), truth.machine()
    with lockstep_bench(machine, axis.eds_path, axis.drive.node_id, nameplate=nameplate(truth)) as (
        bus,
        clock,
        node,
    ):
        yield ForeignBench(bus, clock, node, axis, machine, truth)


class Commissioned(Nameplate):
    """Nameplate and limits of this motor; the limits of the EDS suit 8000 counts per turn."""

    def engrave(self, dictionary: Dictionary) -> None:
        super().engrave(dictionary)
        turn = self.motor_counts_per_turn
        for index, value in {
            0x6067: max(2, round(0.05 / 360.0 * turn)),  # position window
            0x607F: 120 * turn,  # max profile velocity
            0x6080: 7200,  # max motor speed, rpm
            0x60C5: 2000 * turn,  # max acceleration
            0x60C6: 2000 * turn,  # max deceleration
        }.items():
            dictionary[index, 0].default = dictionary[index, 0].value = value


def nameplate(truth: Truth) -> Nameplate:
    """Identity, units and limits that the drive reports."""
    return Commissioned(
        serial=truth.seed + 1,
        motor_counts_per_turn=truth.encoders.motor_counts_per_turn,
        load_counts_per_turn=truth.encoders.load_counts_per_turn,
        gear_motor_turns=round(truth.mechanics.ratio),
        gear_load_turns=1,
        rated_torque_mnm=round(1000.0 * truth.servo.rated_torque_nm),
    )


def write_axis(truth: Truth, folder: Path) -> Path:
    """Writes the axis file with the data known to the installer of the axis."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "axis.yaml"
    path.write_text(f"""schema: hdbridge.axis/1
name: foreign-{truth.seed}
bus: {{interface: virtual, channel: foreign}}
drive:
  node_id: 1
  eds: hdbridge-402.eds
  identity: {{vendor_id: 0x4844, product_code: 0x402}}
  cycle_ms: {truth.cycle_ms:g}
  following_error_deg: {truth.following_error_deg:g}
  rated_torque_nm: {truth.servo.rated_torque_nm:g}
motor_encoder: {{counts_per_turn: {truth.encoders.motor_counts_per_turn}}}
load_encoder: {{counts_per_turn: {truth.encoders.load_counts_per_turn}}}
gear: {{ratio: {truth.mechanics.ratio:g}}}
limits:
  position_min_deg: {-REACH_DEG:g}
  position_max_deg: {REACH_DEG:g}
  velocity_deg_s: {truth.velocity_deg_s:g}
  acceleration_deg_s2: {truth.acceleration_deg_s2:g}
  jerk_deg_s3: {truth.jerk_deg_s3:g}
  torque_percent: {truth.servo.torque_limit_percent:g}
compensation: {{maximum_arcsec: 600, slew_arcsec_s: 100000}}
{TORQUE if truth.mechanics.gravity_nm else ""}""")
    return path
