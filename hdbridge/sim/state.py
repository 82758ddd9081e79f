"""Decorator for the state classes of the simulation, and the conditions that the gear depends on.

The attributes of a state class are laid out in memory, and its methods compiled (`hdbridge.sim.compiled`).
They are numbers, tuples and lists of numbers, and objects of other state classes. An annotation states the
type if the assignment does not show it.
"""

from typing import Final, TypeVar

T = TypeVar("T")

STATES: Final[list[type]] = []


def state(cls: type[T]) -> type[T]:
    """Adds a class to `STATES`."""
    STATES.append(cls)
    return cls


@state
class Conditions:
    """Current conditions of the gear, updated by the plant."""

    torque_nm: float
    """Torque of the flexspline's spring on the load."""
    slope_arcsec: float
    """Derivative of the tooth error with respect to the motor angle, arcsec per radian; sum of all pieces."""

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = self.load_deg = self.torque_nm = self.slope_arcsec = 0.0
        self.temperature_c = temperature_c
