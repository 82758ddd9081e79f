"""`hdbridge fit` on short foreign records: refused, or fitted with its limits reported once."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hdbridge.axis.model import TransmissionModel
from hdbridge.cli import app
from hdbridge.errors import InputError
from hdbridge.records.record import Record


def write(path: Path, motor: np.ndarray, rate_hz: float = 100.0) -> Path:
    ripple = 5.0 * np.sin(np.radians(2.0 * motor)) + 0.3 * np.random.default_rng(1).standard_normal(
        len(motor)
    )
    columns = {
        "time_s": np.arange(len(motor)) / rate_hz,
        "motor_position_deg": np.round(motor, 3),
        "load_position_deg": motor / 100.0 + ripple / 3600.0,
    }
    Record(columns).write_csv(path)
    return path


def test_a_rest_and_the_beginning_of_a_fast_move_are_refused(tmp_path: Path) -> None:
    gone = np.maximum(np.arange(200) / 100.0 - 0.8, 0.0)
    path = write(tmp_path / "bench.csv", 3000.0 * gone**2)  # 60 deg/s^2 at the load
    command = ["fit", str(path), "--ratio", "100", "--out", str(tmp_path / "model.yaml")]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, InputError)
    assert "slow sweeps" in str(result.exception)
    assert not (tmp_path / "model.yaml").exists()


@pytest.mark.parametrize("turns", [0.3, 3.0])
def test_inseparable_causes_are_reported_briefly(tmp_path: Path, turns: float) -> None:
    path = write(tmp_path / "bench.csv", np.linspace(0.0, 360.0 * turns, 600))
    result = CliRunner().invoke(app, ["fit", str(path), "--ratio", "100"], catch_exceptions=False)
    assert result.exit_code == 0
    said = [line for line in result.output.splitlines() if line.startswith("note: ")]
    assert 0 < len(said) < 12
    assert any("record both directions" in line for line in said)
    assert any("load turns" in line for line in said)


def moves(folder: Path, turns: float, phases_deg: tuple[float, ...], drag: float = 0.0) -> list[str]:
    """Repeated moves of one second, each with a zero and a phase of its own."""
    rng = np.random.default_rng(2)
    part = np.arange(100) / 100.0
    paths = []
    for number, phase_deg in enumerate(phases_deg):
        motor = 100.0 + 360.0 * turns * part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        error = 20.0 * np.cos(np.radians(2.0 * motor + phase_deg)) - drag * np.gradient(motor, 0.01)
        load = motor / 100.0 + (error + 40.0 * number + rng.standard_normal(100)) / 3600.0
        columns = {"time_s": part, "motor_position_deg": motor, "load_position_deg": load}
        Record(columns).write_csv(folder / f"move{number}.csv")
        paths.append(str(folder / f"move{number}.csv"))
    return paths


def fitted(folder: Path, paths: list[str], *more: str) -> tuple[Any, dict[str, Any], str]:
    options = ["--ratio", "100", "--independent-zeros", "--json", str(folder / "fit.json")]
    result = CliRunner().invoke(app, ["fit", *paths, *options, *more])
    data = json.loads((folder / "fit.json").read_text())
    return result, data, " ".join(result.output.split())


def test_less_than_a_turn_resolves_no_order(tmp_path: Path) -> None:
    result, data, said = fitted(tmp_path, moves(tmp_path, 0.4, (30.0,) * 3))
    assert result.exit_code == 0
    assert not [each for each in data["parameters"] if each["effect"] == "synchronous"]
    assert "orders are not fitted" in said


def test_the_residual_is_that_of_the_written_model(tmp_path: Path) -> None:
    """A drag looks like a delay of one encoder, which is fitted but not part of the model."""
    paths = moves(tmp_path, 2.0, (30.0,) * 3, drag=0.02)
    out = tmp_path / "model.yaml"
    _, data, said = fitted(tmp_path, paths, "--out", str(out))
    model = TransmissionModel.load(out)
    left = []
    for path in paths:
        record = Record.read_csv(Path(path))
        error = record.transmission_error_arcsec(100.0) - model.predict(record.motion())
        left.append(error - np.mean(error))
    rms = float(np.sqrt(np.mean(np.square(left))))
    noise, held_out = data["noise"], data["held_out"]
    assert noise["residual_arcsec"] == pytest.approx(rms, rel=0.2)
    assert noise["fitted_arcsec"] < 0.5 * rms
    assert held_out["after_arcsec"] == pytest.approx(rms, rel=0.2)
    assert held_out["over"] == "recordings"
    assert f"residual of the model, rms of a sample: {noise['residual_arcsec']:.2f} arcsec" in said
    assert f"with the terms fitted in addition: {noise['fitted_arcsec']:.2f} arcsec" in said


def test_a_model_worse_on_held_out_data_is_not_written(tmp_path: Path) -> None:
    """The ripple has a different phase in each recording, so any two predict the third badly."""
    paths = moves(tmp_path, 2.0, (0.0, 60.0, 120.0))
    out = tmp_path / "model.yaml"
    result, data, _ = fitted(tmp_path, paths, "--out", str(out))
    assert data["held_out"]["after_arcsec"] > data["held_out"]["before_arcsec"]
    assert isinstance(result.exception, InputError)
    assert "--force" in str(result.exception)
    assert not out.exists()
    result, *_ = fitted(tmp_path, paths, "--out", str(out), "--force")
    assert result.exit_code == 0
    assert out.exists()


def test_a_vibrating_move_whose_orders_come_in_last_is_fitted(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    part = np.arange(100) / 100.0
    motor = 720.0 * part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
    shaken = 5.0 * np.cos(2.0 * np.pi * 20.0 * part + 2.0) + rng.standard_normal(100)
    load = motor / 100.0 + (2.0 * np.cos(np.radians(2.0 * motor)) + shaken) / 3600.0
    columns = {"time_s": part, "motor_position_deg": motor, "load_position_deg": load}
    Record(columns).write_csv(tmp_path / "move.csv")
    result = CliRunner().invoke(app, ["fit", str(tmp_path / "move.csv"), "--ratio", "100"])
    assert result.exit_code == 0, result.exception
