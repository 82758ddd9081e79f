"""The catalogue: one cause of transmission error per file, found by its name."""

from hdbridge.effects.base import (
    Cause,
    Channel,
    Effect,
    FloatArray,
    Moment,
    Motion,
    Shape,
    Start,
    Tracker,
)
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.synchronous import MotorOrder, Synchronous

CATALOGUE: dict[str, type[Effect]] = {each.name: each for each in (Synchronous, Hysteresis)}
"""Every effect by its canonical name."""

__all__ = [
    "CATALOGUE",
    "Cause",
    "Channel",
    "Effect",
    "FloatArray",
    "Hysteresis",
    "Moment",
    "Motion",
    "MotorOrder",
    "Shape",
    "Start",
    "Synchronous",
    "Tracker",
]
