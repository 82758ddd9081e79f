"""Axis file: drive, bus, encoders, measured channels, gear, and motion limits."""

from hdbridge.axis.channels import LoadTorque, Temperature
from hdbridge.axis.config import (
    AxisConfig,
    BusConfig,
    CompensationConfig,
    DriveConfig,
    Gear,
    Identity,
    Limits,
    RealtimeConfig,
    Teeth,
)
from hdbridge.axis.encoders import Encoder, LoadEncoder, MotorEncoder, Source

__all__ = [
    "AxisConfig", "BusConfig", "CompensationConfig", "DriveConfig", "Encoder", "Gear", "Identity", "Limits",
    "LoadEncoder", "LoadTorque", "MotorEncoder", "RealtimeConfig", "Source", "Teeth", "Temperature",
]  # fmt: skip
