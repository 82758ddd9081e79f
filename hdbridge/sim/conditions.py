"""What the pieces of the gear may depend on."""

from __future__ import annotations


class Conditions:
    """The conditions as they are now; the plant keeps them up to date."""

    __slots__ = ("load_deg", "motor_deg", "temperature_c", "torque_nm")

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = 0.0
        self.load_deg = 0.0
        self.torque_nm = 0.0
        """Torque of the flexspline's spring on the load."""
        self.temperature_c = temperature_c
