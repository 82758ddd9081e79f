"""An axis whose load encoder was removed after calibration: the motor encoder measures the response."""

import json
from pathlib import Path

import pytest
from support.raised import raised_profile, without_load_encoder

from hdbridge import AxisConfig, Bench, TransmissionModel
from hdbridge.analysis.response import harmonics
from hdbridge.motion.procedures.even_speed import EvenSpeed
from hdbridge.simulated import simulated


@pytest.fixture
def blind(tmp_path: Path) -> Path:
    return without_load_encoder(raised_profile(tmp_path / "blind"))


def ripples(profile: Path, *models: TransmissionModel) -> list[float]:
    """Ripple of the load at 76 deg/s as measured by the load encoder, arcsec rms."""
    with simulated(AxisConfig.load(profile)) as drive:
        drive.boot()
        runs = [Bench(drive, each).run(EvenSpeed((76.0,))).outcome for each in models]
    return [max(harmonics(each, (1, 2, 4), 50.0).ripple_arcsec for each in both) for both in runs]


def test_the_motor_encoder_measures_the_response(hdbridge, blind: Path, tmp_path: Path) -> None:
    static = TransmissionModel.load(blind / "model.yaml")
    done = hdbridge("motion", blind, "--simulate", "--propose", "--json", "out.json")
    assert "path errors are not measured" in " ".join(done.stdout.split())
    assert json.loads((tmp_path / "out.json").read_text())["paths"] == []
    hdbridge("model", "commit", blind)
    model = TransmissionModel.load(blind / "model.yaml")
    none, at_rest, filtered = ripples(raised_profile(tmp_path / "seen"), static.only(()), static, model)
    assert at_rest > 0.5 * none
    assert filtered < 0.1 * none


@pytest.mark.parametrize("command", ["step", "calibrate", "improve"])
def test_commands_needing_a_load_encoder_are_refused(hdbridge, blind: Path, command: str) -> None:
    done = hdbridge(command, blind, "--simulate", status=2)
    assert "axis.yaml:" in done.stderr
    assert "expected an encoder at the load" in done.stderr
