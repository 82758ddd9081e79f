"""`hdbridge fit` on short records of other benches: refused, or fitted with what is not known said once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

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
def test_what_cannot_be_told_apart_is_said_in_few_lines(tmp_path: Path, turns: float) -> None:
    path = write(tmp_path / "bench.csv", np.linspace(0.0, 360.0 * turns, 600))
    result = CliRunner().invoke(app, ["fit", str(path), "--ratio", "100"], catch_exceptions=False)
    assert result.exit_code == 0
    said = [line for line in result.output.splitlines() if line.startswith("note: ")]
    assert 0 < len(said) < 12
    assert any("record both directions" in line for line in said)
    assert any("load turns" in line for line in said)
