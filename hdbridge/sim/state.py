"""Decorator for the state classes of the simulation, and the conditions that the gear depends on.

A state class declares all its attributes with their types, so that they can be laid out in memory and the
methods can be compiled (`hdbridge.sim.compiled`). Attributes are numbers, tuples and lists of numbers, and
objects of other state classes.
"""

from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

STATES: Final[list[type]] = []


def state(cls: type[T]) -> type[T]:
    """Adds a slot for each declared attribute to a class; the class defines its own ``__init__``."""
    made = dataclass(init=False, repr=False, eq=False, slots=True)(cls)
    STATES.append(made)
    return made


@state
class Conditions:
    """Current conditions of the gear, updated by the plant."""

    motor_deg: float
    load_deg: float
    torque_nm: float
    """Torque of the flexspline's spring on the load."""
    temperature_c: float
    slope_arcsec: float
    """Derivative of the tooth error with respect to the motor angle, arcsec per radian; sum of all pieces."""

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = self.load_deg = self.torque_nm = self.slope_arcsec = 0.0
        self.temperature_c = temperature_c
