"""Ideal axis behind a gateway's slave: the load is exactly at the demand. For tests of outer masters."""

from __future__ import annotations


class IdealAxis:
    """Plant (`hdbridge.device.motion.Machine`) without error, delay or friction."""

    dt_s = 1e-6
    torque_permille = 0
    temperature_c = load_torque_nm = 0.0

    def __init__(self, motor_counts_per_load_count: float) -> None:
        self.torque_limit_permille = 0.0
        self.motor_counts = 0
        """Load position in counts, which the drive reports as its motor position."""
        self.velocity_counts_s = 0.0
        self._scale = motor_counts_per_load_count

    @property
    def load_counts(self) -> int:
        """Position of the axis's motor in counts, which the drive reports as its second encoder."""
        return round(self.motor_counts * self._scale)

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        """Moves linearly to the end of the demand during ``substeps``."""
        self.motor_counts = round(end_counts)
        self.velocity_counts_s = (end_counts - start_counts) / (substeps * self.dt_s)

    def coast(self, substeps: int, braked: bool) -> None:
        """Stays at rest without power."""
        self.velocity_counts_s = 0.0
