"""Conditions that the pieces of the gear depend on."""

from hdbridge.sim.state import state


@state
class Conditions:
    """Present conditions, updated by the plant."""

    motor_deg: float
    load_deg: float
    torque_nm: float
    """Torque of the flexspline's spring on the load."""
    temperature_c: float

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = self.load_deg = self.torque_nm = 0.0
        self.temperature_c = temperature_c
