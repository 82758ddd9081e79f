"""The figures of docs/real-records.md, from the measured records (which are not part of the project).

    HDBRIDGE_REAL_RECORDS=FOLDER python tools/real_records.py      # a minute of CPU

The folder holds `cobot/jointJ-R.csv`, the same with the command in `cobot-command`, `damper/sine.csv` and
`damper/earthquake.csv`.
"""

from __future__ import annotations

import os
import sys
from itertools import product
from pathlib import Path

import numpy as np

from hdbridge.diagnose import Diagnosis, diagnose
from hdbridge.effects import Hysteresis, HysteresisMemory, Motion, Start
from hdbridge.model import TransmissionModel
from hdbridge.observations.driving import driving_angle
from hdbridge.records.record import Record, concatenate

NOTHING = TransmissionModel(100.0, ())
ARCSEC_PER_N = 0.01


def main() -> None:
    """Print them."""
    named = os.environ.get("HDBRIDGE_REAL_RECORDS")
    if named is None:
        sys.exit("HDBRIDGE_REAL_RECORDS is not set; expected the folder of the measured records")
    folder = Path(named)
    for name, joint in product(("cobot", "cobot-command"), (4, 5)):
        records = [Record.read_csv(each) for each in sorted(folder.glob(f"{name}/joint{joint}-*.csv"))]
        print(f"{name}, joint {joint}, all recordings")
        _print(diagnose(concatenate(records), NOTHING, independent_zeros=True))
        _leave_one_out(records)
    _laws(folder)
    for name in ("sine", "earthquake"):
        time, displacement, force = _damper(folder, name)
        for scale in (1.0, 2.0, 4.0):
            motor = scale * displacement
            load = motor / 50.0 + ARCSEC_PER_N * force / 3600.0
            record = Record({"time_s": time, "motor_position_deg": motor, "load_position_deg": load})
            law = Hysteresis(offset_arcsec=95.0, width_deg=16.0 * scale, exponent=2.2)
            print(f"damper, {name}, {scale:g} deg/mm")
            _print(diagnose(record, TransmissionModel(50.0, (law,))))


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
    before, after = [], []
    for out in records:
        found = diagnose(
            concatenate([each for each in records if each is not out]), NOTHING, independent_zeros=True
        )
        before.append(diagnose(out, NOTHING).baseline.rms_arcsec)
        after.append(diagnose(out, found.model).baseline.rms_arcsec)
        causes = ", ".join(each.cause for each in found.findings)
        print(f"  left out {out.source}: {before[-1]:.2f} -> {after[-1]:.2f} arcsec rms, named {causes}")
    print(
        f"  together: {np.sqrt(np.mean(np.square(before))):.2f} -> {np.sqrt(np.mean(np.square(after))):.2f}"
    )


def _damper(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time, displacement, force = np.loadtxt(
        folder / "damper" / f"{name}.csv", delimiter=",", skiprows=1, unpack=True
    )
    return time, displacement, force


def _laws(folder: Path) -> None:
    """Both laws fitted to the sine, and what they say of the earthquake; widths in mm."""
    _, angle, force = _damper(folder, "sine")
    _, other, measured = _damper(folder, "earthquake")
    angle, other = (driving_angle(each, None, commanded=False) for each in (angle, other))
    print(f"damper: {np.std(force):.0f} N rms in the sine, {np.std(measured):.0f} N in the earthquake")
    for law in (Hysteresis, HysteresisMemory):
        best = None
        for width in (8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0):
            for exponent in (1.6, 1.8, 2.0, 2.2, 2.5):
                effect = law(offset_arcsec=1.0, width_deg=width, exponent=exponent)

                def table(place: np.ndarray, effect: Hysteresis | HysteresisMemory = effect) -> np.ndarray:
                    loop = effect.predict(Motion(place), Start.VIRGIN)
                    return np.column_stack([loop, place, np.ones(len(place))])

                solution = np.linalg.lstsq(table(angle), force, rcond=None)[0]
                left = float(np.std(force - table(angle) @ solution))
                if best is None or left < best[0]:
                    best = (left, float(np.std(measured - table(other) @ solution)), width, exponent)
        assert best is not None
        print(
            "  {}: {:.0f} N, earthquake as predicted {:.0f} N (width {:g} mm, n {:g})".format(law.name, *best)
        )


if __name__ == "__main__":
    main()
