"""Prints those figures of docs/how-well.md that come from measured records (not part of the project).

    HDBRIDGE_REAL_RECORDS=FOLDER python tools/real_records.py          # ten minutes of CPU time
    HDBRIDGE_REAL_RECORDS=FOLDER python tools/real_records.py twins    # only the figures of twins

The folder contains `cobot/jointJ-R.csv`, the same with the commanded angle in `cobot-command`,
`damper/sine.csv` and `damper/earthquake.csv`.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.driving import CHATTER_COUNTS, steadied
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.readings import reading_of
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Motion, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import Comparison, compare
from hdbridge.twin.replay import replay
from hdbridge.twin.translate import translate
from hdbridge.twin.twin import Twin, fit_twin

NOTHING = TransmissionModel(100.0, ())
ARCSEC_PER_N = 0.01
SIGNALS = ("load_error", "following_error", "motor_torque")
JOINT = """\
schema: hdbridge.axis/1
name: joint
bus: {interface: virtual, channel: joint}
drive:
  node_id: 1
  eds: hdbridge-402.eds
  identity: {vendor_id: 0, product_code: 0}
  cycle_ms: 10
  following_error_deg: 60
  rated_torque_nm: 0.2
motor_encoder: {counts_per_turn: 524288}
load_encoder: {counts_per_turn: 1048576}
gear: {ratio: 100}
limits: {position_min_deg: -400, position_max_deg: 400, velocity_deg_s: 60,
         acceleration_deg_s2: 300, jerk_deg_s3: 6000, torque_percent: 300}
"""
"""Axis file for the robot's joints; the encoder resolutions come from the records, the rest is assumed."""


FOLDER = Path(os.environ.get("HDBRIDGE_REAL_RECORDS") or os.devnull)
"""Folder of the measured records; no folder if the variable is not set."""


def main() -> None:
    """Prints the figures."""
    if sys.argv[1:] not in ([], ["twins"]):
        sys.exit(f"found {' '.join(sys.argv[1:])!r}; expected nothing, or 'twins'")
    if not FOLDER.is_dir():
        sys.exit("HDBRIDGE_REAL_RECORDS: not set, or no folder; expected the folder of the measured records")
    if sys.argv[1:] != ["twins"]:
        _causes(FOLDER)
    _twins(FOLDER)


def _causes(folder: Path) -> None:
    """Prints the diagnoses of the robot's joints and of the damper."""
    for name, joint in product(("cobot", "cobot-command"), (4, 5)):
        records = [Record.read_csv(each) for each in sorted(folder.glob(f"{name}/joint{joint}-*.csv"))]
        print(f"{name}, joint {joint}, all recordings")
        _print(diagnose(concatenate(records), NOTHING, independent_zeros=True))
        _leave_one_out(records)
    _laws(folder)
    for name in ("sine", "earthquake"):
        for scale in (1.0, 2.0, 4.0):
            record = damper_record(folder, name, scale)
            law = Hysteresis(offset_arcsec=95.0, width_deg=16.0 * scale, exponent=2.2)
            print(f"damper, {name}, {scale:g} deg/mm")
            _print(diagnose(record, TransmissionModel(50.0, (law,))))


def joint_axis() -> AxisConfig:
    """Returns the axis that represents either joint."""
    return AxisConfig.from_text(JOINT, Path("joint.yaml"))


def joint_recordings(folder: Path, joint: int) -> list[Recording]:
    """Returns a joint's four recordings with their commands, and with torques in hdbridge's convention.

    The recorded motor torque is divided by the ratio. The robot reports the load torque as delivered by the
    gear: at rest against the weight, it has the sign of the motor torque. In hdbridge, it is the external
    torque that pushes the load forward, so its sign is reversed.

    The joint's zero is about thirty motor turns away. Whole turns are subtracted, because a replay begins at
    the zero of the simulated drive. The approach of the replay is then backwards, as in the recordings, so
    that friction acts in the same direction before them.
    """
    recordings = []
    for path in sorted(folder.glob(f"cobot-command/joint{joint}-*.csv")):
        record = Record.read_csv(path)
        torque = record.columns["motor_torque_nm"] / NOTHING.ratio
        turns_deg = 360.0 * math.ceil(record.motor_position_deg[0] / 360.0)
        outer = -record.columns["load_torque_nm"]
        columns = {**record.columns, "motor_torque_nm": torque, "load_torque_nm": outer}
        for name, way_deg in (
            ("motor_target_deg", turns_deg),
            ("motor_position_deg", turns_deg),
            ("load_position_deg", turns_deg / NOTHING.ratio),
        ):
            columns[name] = columns[name] - way_deg
        recordings.append(Recording(Record(columns, record.source), ratio=NOTHING.ratio))
    return recordings


def twin_of_others(recordings: Sequence[Recording], out: int) -> tuple[Twin, dict[str, Comparison]]:
    """Fits a twin to all recordings but one; compares usual values, model and twin with the one left out."""
    axis = joint_axis()
    others = [each for number, each in enumerate(recordings) if number != out]
    found = diagnose(others, NOTHING, independent_zeros=True)
    start = translate(axis, found.model).truth
    twin = fit_twin(others, axis, start, workers=1)
    truths = {"usual values": translate(axis).truth, "with the model": start, "twin": twin.truth}
    return twin, {name: held_against(recordings[out], truth) for name, truth in truths.items()}


def held_against(recording: Recording, truth: Truth) -> Comparison:
    """Compares a recording with its replay on the simulated axis."""
    simulated = replay(recording, joint_axis(), truth)
    return compare(recording.record, simulated, (), NOTHING.ratio)


def _twins(folder: Path) -> None:
    """Prints the errors, on each recording, of a twin that is fitted to the other three."""
    for joint in (4, 5):
        recordings = joint_recordings(folder, joint)
        left: dict[tuple[str, str], list[float]] = {}
        for out in range(len(recordings)):
            twin, compared = twin_of_others(recordings, out)
            print(f"twin of joint {joint} without recording {out + 1}")
            for name, each in compared.items():
                rows = [row for signal in SIGNALS if (row := each.row(signal)) is not None]
                told = ", ".join(f"{row.channel} {row.difference:.3g} of {row.measured:.3g}" for row in rows)
                print(f"  {name}: {told}", flush=True)
                for row in rows:
                    left.setdefault((row.channel, "measured"), []).append(row.measured)
                    left.setdefault((row.channel, name), []).append(row.difference)
            for finding in twin.findings:
                print(f"  {finding}")
            for rest in twin.unexplained:
                print(f"  unexplained: {rest.channel}, {rest.times_noise:.3g} times its noise")
            for each in twin.inseparable_sets:
                print(f"  not separable: {', '.join(each.names)}")
        for (signal, name), values in left.items():
            print(f"  {signal}, {name}: {np.sqrt(np.mean(np.square(values))):.4g}")


def _print(found: Diagnosis) -> None:
    print(f"  rms {found.baseline.rms_arcsec:.2f}, extended {found.extended.rms_arcsec:.2f} arcsec")
    for each in found.findings:
        values = ", ".join(
            f"{name} {value.value:.3g} ({value.low:.3g} to {value.high:.3g})"
            for name, value in each.parameters.items()
        )
        print(
            f"  {each.cause} {each.probability:.2f} or {each.aliases}, {each.peak_arcsec:.1f} arcsec: "
            f"{values}"
        )


def _leave_one_out(records: list[Record]) -> None:
    before = [float(np.std(record.transmission_error_arcsec(NOTHING.ratio))) for record in records]
    after, regression = left_out(records), regressed(records)
    for record, one, other in zip(records, before, after, strict=True):
        print(f"  left out {record.source}: {one:.2f} -> {other:.2f} arcsec rms")
    print(f"  together: {_rms(before):.2f} -> {_rms(after):.2f}, by regression {_rms(regression):.2f}")


def left_out(records: Sequence[Record]) -> list[float]:
    """Returns the rms error, about its mean, of each record with the model from the others; arcsec."""
    left = []
    for out in records:
        others = concatenate([each for each in records if each is not out])
        model = diagnose(others, NOTHING, independent_zeros=True).model
        error = out.transmission_error_arcsec(NOTHING.ratio) - model.predict(out.motion(), Start.VIRGIN)
        left.append(float(np.std(error)))
    return left


def regressed(records: Sequence[Record]) -> list[float]:
    """Returns the rms error of each record with a linear regression on the others, arcsec.

    The regressors are motor orders 1 and 2, motor speed and load torque.
    """
    columns, errors = [], []
    for record in records:
        motor = record.motor_position_deg
        waves = [part(np.radians(order * motor)) for order in (1, 2) for part in (np.cos, np.sin)]
        parts = np.column_stack([*waves, np.gradient(motor, record.time_s), record.columns["load_torque_nm"]])
        error = record.transmission_error_arcsec(NOTHING.ratio)
        columns.append(parts - np.mean(parts, axis=0))
        errors.append(error - np.mean(error))
    left = []
    for out in range(len(records)):
        others = [each for each in range(len(records)) if each != out]
        fitted = np.linalg.lstsq(
            np.vstack([columns[each] for each in others]), np.concatenate([errors[each] for each in others])
        )[0]
        left.append(float(np.std(errors[out] - columns[out] @ fitted)))
    return left


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(each**2 for each in values) / len(values))


def damper(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time, displacement, force = np.loadtxt(
        folder / "damper" / f"{name}.csv", delimiter=",", skiprows=1, unpack=True
    )
    return time, displacement, force


def damper_record(folder: Path, name: str, deg_per_mm: float) -> Record:
    """Returns the damper as an axis: its displacement for the motor's angle, its force for the error."""
    time, displacement, force = damper(folder, name)
    motor = deg_per_mm * displacement
    load = motor / 50.0 + ARCSEC_PER_N * force / 3600.0
    return Record({"time_s": time, "motor_position_deg": motor, "load_position_deg": load})


def laws(folder: Path) -> dict[str, tuple[float, float, float, float]]:
    """Fits both hysteresis laws to the damper's sine motion, and predicts the earthquake.

    Returns, by law, the rms error of either in N, the width in mm and the exponent.
    """
    _, angle, force = damper(folder, "sine")
    _, other, measured = damper(folder, "earthquake")
    bands = (CHATTER_COUNTS * reading_of(each).unaided_deg for each in (angle, other))
    angle, other = (steadied(each, each, band) for each, band in zip((angle, other), bands, strict=True))

    def left(law: type[Hysteresis | HysteresisMemory], width: float, n: float) -> tuple[float, ...]:
        effect = law(offset_arcsec=1.0, width_deg=width, exponent=n)

        def table(place: np.ndarray) -> np.ndarray:
            return np.column_stack([effect.predict(Motion(place), Start.VIRGIN), place, np.ones(len(place))])

        solution = np.linalg.lstsq(table(angle), force, rcond=None)[0]
        errors = force - table(angle) @ solution, measured - table(other) @ solution
        return (*(float(np.std(each)) for each in errors), width, n)

    shapes = list(product((8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0), (1.6, 1.8, 2.0, 2.2, 2.5)))
    return {law.name: min(left(law, *each) for each in shapes) for law in (Hysteresis, HysteresisMemory)}


def _laws(folder: Path) -> None:
    sine, earthquake = (damper(folder, name)[2] for name in ("sine", "earthquake"))
    print(f"damper: {np.std(sine):.0f} N rms in the sine, {np.std(earthquake):.0f} N in the earthquake")
    for name, row in laws(folder).items():
        print("  {}: {:.0f} N, earthquake as predicted {:.0f} N (width {:g} mm, n {:g})".format(name, *row))


if __name__ == "__main__":
    main()
