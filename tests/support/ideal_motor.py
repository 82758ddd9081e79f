"""Motor without physics, for tests of the drive that controls it."""


class IdealMotor:
    """Motor that follows the demand at once, unless it is ``stuck``, and coasts with constant friction."""

    friction_counts_s2 = 50_000.0

    def __init__(self, counts: int = 0) -> None:
        self.dt_s = 0.0005
        self.torque_limit_permille = 1000.0
        self.position = float(counts)
        self.velocity_counts_s = 0.0
        self.torque_permille = 0
        self.temperature_c = 23.4
        self.load_torque_nm = -1.25
        self.stuck = False
        self.elapsed_s = 0.0
        self.powered = False
        self.braked = False

    @property
    def motor_counts(self) -> int:
        return round(self.position)

    @property
    def load_counts(self) -> int:
        return round(self.position * 7.2)

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        self.elapsed_s += substeps * self.dt_s
        self.powered = True
        if not self.stuck:
            self.position = end_counts
            self.velocity_counts_s = (end_counts - start_counts) / (substeps * self.dt_s)

    def coast(self, substeps: int, braked: bool) -> None:
        self.elapsed_s += substeps * self.dt_s
        self.powered = False
        self.braked = braked
        for _ in range(substeps):
            slower = max(0.0, abs(self.velocity_counts_s) - self.friction_counts_s2 * self.dt_s)
            self.velocity_counts_s = slower if self.velocity_counts_s > 0.0 else -slower
            self.position += self.velocity_counts_s * self.dt_s
