"""Truth file: the true values of all parameters of the simulated axis; one module per section."""

from hdbridge.sim.truth.gear import TrueGear
from hdbridge.sim.truth.hysteresis import (
    BoucWen,
    Dahl,
    Hysteresis,
    MaxwellSlip,
    RollingFriction,
    SlipElement,
    TrueOrder,
)
from hdbridge.sim.truth.load import TrueLoad
from hdbridge.sim.truth.motor import TrueMotor, TrueServo
from hdbridge.sim.truth.truth import TrueTemperature, Truth

__all__ = [
    "BoucWen", "Dahl", "Hysteresis", "MaxwellSlip", "RollingFriction", "SlipElement", "TrueGear", "TrueLoad",
    "TrueMotor", "TrueOrder", "TrueServo", "TrueTemperature", "Truth",
]  # fmt: skip
