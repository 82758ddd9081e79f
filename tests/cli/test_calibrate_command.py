"""`hdbridge calibrate` and `fit` at their edges: bad input, and records from elsewhere."""

import json
from itertools import pairwise

import numpy as np
import pytest

from hdbridge.axis.effects import Hysteresis, Motion, MotorOrder, Start, Synchronous
from hdbridge.axis.model import TransmissionModel

RATIO = 50.0
GEAR = TransmissionModel(
    RATIO,
    (
        Synchronous(
            orders=(
                MotorOrder(order=1, amplitude_arcsec=5.0, phase_deg=30.0),
                MotorOrder(order=2, amplitude_arcsec=11.0, phase_deg=-70.0),
            )
        ),
        Hysteresis(offset_arcsec=33.0, width_deg=18.0, exponent=1.7),
    ),
)


def motor_path(*turning_deg: float, speed_deg_s: float = 90.0, period_s: float = 0.01) -> np.ndarray:
    """A motor that goes from one turning point to the next at constant speed."""
    parts = [np.arange(a, b, np.sign(b - a) * speed_deg_s * period_s) for a, b in pairwise(turning_deg)]
    return np.concatenate(parts)


def write(path, motor_deg, columns=("time_s", "motor_position_deg", "load_position_deg"), ratio=RATIO):
    """Writes a recording of `GEAR` as another program might have made it; returns its path."""
    noise = np.random.default_rng(5).normal(0.0, 0.8, len(motor_deg))
    error = GEAR.predict(Motion(motor_deg=motor_deg), Start.FORWARD) + noise
    data = {
        "time_s": 0.01 * np.arange(len(motor_deg)),
        "motor_position_deg": motor_deg,
        "load_position_deg": motor_deg / ratio + error / 3600.0,
    }
    rows = [
        ",".join(columns),
        *(",".join(f"{data[each][i]:.9f}" for each in columns) for i in range(len(motor_deg))),
    ]
    path.write_text("\n".join(rows) + "\n")
    return path.name


BOTH_WAYS = (0, 1800, 0, 60, 50, 60, 0, 30, 0)


def test_a_model_from_a_foreign_csv_file(hdbridge, tmp_path):
    name = write(tmp_path / "theirs.csv", motor_path(*BOTH_WAYS))
    done = hdbridge("fit", name, "--ratio", 50, "--out", "model.yaml", "--json", "fit.json")
    found = {each.name: each.parameters() for each in TransmissionModel.load(tmp_path / "model.yaml").effects}
    assert found["hysteresis"]["offset_arcsec"] == pytest.approx(33.0, rel=0.05)
    assert found["hysteresis"]["width_deg"] == pytest.approx(18.0, rel=0.1)
    orders = {each["order"]: each["amplitude_arcsec"] for each in found["synchronous"]["orders"]}
    assert orders == pytest.approx({1: 5.0, 2: 11.0}, abs=0.2)
    result = json.loads((tmp_path / "fit.json").read_text())
    sure = {each["parameter"]: each["ci95"] for each in result["parameters"]}
    for key, value in (("offset_arcsec", 33.0), ("width_deg", 18.0), ("exponent", 1.7)):
        assert sure[key][0] < value < sure[key][1]
    assert "one speed" in done.stdout
    assert result["schema"] == "hdbridge.calibration/1"
    assert result["offered"] is None
    assert result["held_out"]["improves"] is True
    assert result["recordings"] == [name]


def test_an_axis_with_too_little_travel_cannot_be_calibrated(hdbridge, profile):
    profile("position_min_deg: -400", "position_min_deg: -1")
    folder = profile("position_max_deg: 400", "position_max_deg: 1")
    done = hdbridge("calibrate", folder, "--simulate", status=2)
    assert "at least" in done.stderr
