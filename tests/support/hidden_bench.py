"""Bench on the virtual bus with hidden causes in its axis: measure, diagnose, extend, step.

The axis is that of profiles/demo with sensors for torque and temperature. The hidden causes are random by
seed, and are physical changes of the truth. The diagnosis receives the model of an earlier calibration, whose
parameters are a few per cent off. Everything else is as for a user: frames on a python-can bus, a recording
folder, ``hdbridge diagnose``, model files.
"""

import math
import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.stepping import Stepped, quantisation_floor_arcsec
from hdbridge.control.bench import Bench, axis_view, compensation_for
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.chain import Chain
from hdbridge.motion.procedures.moves import AxisView, Dwell, Procedure, Steps
from hdbridge.motion.procedures.rehearsal import legs_of
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from support.bare_axis import truth
from support.exercised import booted
from support.hidden import Hidden, Run, hide_all

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
CYCLE_MS = 40
"""Cycle time for most causes, which are equally visible in a quarter of the samples of `FAST_MS`."""
MORE_MS = 20
"""Cycle time for causes that are small in each sample or visible only in part of the record."""
FAST_MS = 10
"""Cycle time for causes that depend on speed or acceleration, and for backlash, which is crossed within a few
samples."""
MOTOR_COUNTS = 32_768
"""Motor counts per turn; high, because the motor follows whole-count commands at a fixed fraction of a count,
which biases a sweep by up to half a count."""
SPEED_DEG_S = 6.1
"""Speed of the load. At a higher speed, the higher motor orders would excite the load's resonance."""
ACCELERATION_DEG_S2 = 5.0
"""Acceleration of the load; low, because acceleration winds up the gear."""
REACH_DEG = (0.0, 372.0)
"""Range of the load angle: slightly more than one turn."""
SENSORS = """
load_torque:
  source: {index: 0x2101, type: int32}
  newton_metres_per_count: 0.001
temperature:
  source: {index: 0x2100, type: int16}
  celsius_per_count: 0.1
"""


@dataclass(frozen=True)
class Still:
    """Procedure that stands still."""

    duration_s: float

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields a dwell."""
        yield Dwell(self.duration_s)


STEPPING = Stepping(count=20, step_deg=403.56)
"""Stepping test with steps at all phases of the motor turn, over most of a load turn."""


def axis_config(folder: Path, cycle_ms: int) -> AxisConfig:
    """Writes the axis file into a folder and loads it."""
    text = (DEMO / "axis.yaml").read_text() + SENSORS
    for old, new in (
        ("cycle_ms: 4", f"cycle_ms: {cycle_ms}"),
        ("heartbeat_ms: 50", f"heartbeat_ms: {max(50, 2 * cycle_ms)}"),
        ("turn: 8000", f"turn: {MOTOR_COUNTS}"),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / "axis.yaml"
    path.write_text(text)
    return AxisConfig.load(path)


def bare_truth() -> Truth:
    """Returns the truth of the axis without hidden causes."""
    return truth(
        "demo", substep_ms=1.0, motor__encoder__counts_per_turn=MOTOR_COUNTS,
        motor__encoder__interpolation=16, gear__stiffness_nm_per_rad=45_000.0,
        gear__damping_nm_s_per_rad=40.0, servo__load_feedforward__frequency_hz=65.0,
    )  # fmt: skip


def model_text(truth: Truth, rng: random.Random) -> str:
    """Returns the model file of an earlier calibration: right effects with parameters a few per cent off."""
    law = truth.gear.hysteresis
    rows = "\n".join(
        f"        - {{order: {each.order}, amplitude_arcsec: "
        f"{each.amplitude_arcsec * rng.uniform(0.96, 1.04):.3f}, "
        f"phase_deg: {each.phase_deg + rng.uniform(-3.0, 3.0):.2f}}}"
        for each in truth.gear.motor_orders
    )
    return f"""schema: hdbridge.model/1
ratio: {truth.gear.ratio:g}
effects:
  - effect: synchronous
    parameters:
      orders:
{rows}
  - effect: hysteresis
    parameters:
      offset_arcsec: {law.offset_arcsec * rng.uniform(0.96, 1.04):.3f}
      width_deg: {law.width_deg * rng.uniform(0.95, 1.05):.3f}
      exponent: {law.exponent + rng.uniform(-0.03, 0.03):.3f}
provenance:
  reason: an earlier calibration, a few per cent off
"""


class Cell:
    """Booted drive with hidden causes in its axis, and a folder for the results."""

    def __init__(self, drive: Drive, folder: Path, bare: Truth, hidden: Sequence[Hidden]) -> None:
        self.drive = drive
        self.folder = folder
        self.bare = bare
        self.hidden = hidden
        self.model = folder / "model.yaml"
        self.recording = folder / "recording"
        self.stepping = STEPPING

    def measure(self, parts: Sequence[Procedure[Any]]) -> None:
        """Runs the procedures as a single one and saves the recording."""
        Bench(self.drive).run(Chain(tuple(parts), ACCELERATION_DEG_S2)).save(self.recording)

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Diagnosis of the recording folder against the model file."""
        return diagnose(Recording.load(self.recording), TransmissionModel.load(self.model))

    def step(self, model: TransmissionModel) -> float:
        """Returns the pooled three sigma of the load error at rest with a model, arcsec."""
        run = Bench(self.drive, compensation_for(self.drive.axis, model)).run(self.stepping)
        return Stepped.of("", run.outcome).pooled.three_sigma_arcsec

    @property
    def floor_arcsec(self) -> float:
        """Best possible three sigma, due only to whole counts of the motor target and load encoder noise."""
        axis, encoder = self.drive.axis, self.bare.load_.encoder
        rounding = quantisation_floor_arcsec(axis.motor_encoder.counts_per_turn, axis.gear.ratio)
        readings = self.stepping.settle.window_s / axis.drive.cycle_s
        return math.hypot(rounding, 3.0 * encoder.noise_arcsec / math.sqrt(readings))


def run_of(parts: Sequence[Procedure[Any]], axis: AxisConfig, highest_deg_s2: float) -> Run:
    """Returns the properties of a plan that determine the sizes of causes; accelerations are of the load."""
    legs = legs_of(Chain(tuple(parts), ACCELERATION_DEG_S2), axis_view(axis))
    duration_s, way_deg, place = 0.0, 0.0, 0.0
    for _, path in legs:
        there = path.at(path.duration_s)
        duration_s, way_deg, place = duration_s + path.duration_s, way_deg + abs(there - place), there
    return Run(
        duration_s=duration_s,
        load_speed_deg_s=SPEED_DEG_S,
        load_acceleration_deg_s2=highest_deg_s2,
        motor_turns=way_deg * axis.gear.ratio / 360.0,
        load_reach_deg=REACH_DEG,
    )


@contextmanager
def hidden_bench(
    folder: Path,
    causes: Sequence[tuple[str, float]],
    seed: int,
    parts: Sequence[Procedure[Any]],
    highest_deg_s2: float = ACCELERATION_DEG_S2,
    truth: Truth | None = None,
    cycle_ms: int = CYCLE_MS,
) -> Iterator[Cell]:
    """Provides an axis with causes of given sizes, which has already been measured."""
    rng = random.Random(f"hidden {seed} {causes}")
    folder.mkdir(parents=True, exist_ok=True)
    axis = axis_config(folder, cycle_ms)
    bare = truth or bare_truth()
    (folder / "model.yaml").write_text(model_text(bare_truth(), rng))
    known, hidden = hide_all(bare, causes, rng, run_of(parts, axis, highest_deg_s2))
    with booted(axis, known, seed) as (drive, _):
        cell = Cell(drive, folder, bare, hidden)
        cell.measure(parts)
        yield cell
