"""Classes for the state of the simulation, with typed declarations of all attributes; conditions of the
gear.

Declared attributes can be laid out in memory, so that the methods can be compiled (`hdbridge.sim.compiled`).
They are numbers, tuples and lists of numbers, and further objects of such classes.
"""

from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

STATES: Final[list[type]] = []


def state(cls: type[T]) -> type[T]:
    """Adds a slot for each declared attribute to a class, which writes its own ``__init__``."""
    made = dataclass(init=False, repr=False, eq=False, slots=True)(cls)
    STATES.append(made)
    return made


@state
class Conditions:
    """Present conditions, updated by the plant."""

    motor_deg: float
    load_deg: float
    torque_nm: float
    """Torque of the flexspline's spring on the load."""
    temperature_c: float
    slope_arcsec: float
    """Derivative of the tooth error by the motor angle, arcsec per radian; summed up by the pieces."""

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = self.load_deg = self.torque_nm = self.slope_arcsec = 0.0
        self.temperature_c = temperature_c
