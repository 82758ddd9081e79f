"""A recording of the simulated axis, shared by all tests of the library's public names."""

from pathlib import Path

import pytest

from hdbridge import AxisConfig, Bench, TransmissionModel, simulated
from hdbridge.motion.procedures.chain import Chain
from hdbridge.motion.procedures.sine import Sines
from hdbridge.motion.procedures.sweep import Sweep

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


@pytest.fixture(scope="session")
def axis():
    return AxisConfig.load(PROFILE)


@pytest.fixture(scope="session")
def model():
    return TransmissionModel.load(PROFILE / "model.yaml")


@pytest.fixture(scope="session")
def run(axis):
    """Sweeps and sines without compensation."""
    with simulated(axis) as drive:
        drive.boot()
        plan = Chain((Sweep(0.0, 15.0, velocity_deg_s=5.0), Sines(centre_deg=8.0)), acceleration_deg_s2=20.0)
        return Bench(drive).run(plan)
