"""Actual and demanded position of the simulated axis, in plant counts and as user positions.

Plant counts are unbounded and have no home. User positions are int32 with polarity and home offset. All
motion is computed in plant counts; int32 occurs only in objects that are read or written.
"""

from collections.abc import Callable
from typing import Final, Protocol

from hdbridge.cia301 import wrap_int32
from hdbridge.device.dictionary import Dictionary

_HALF: Final = 1 << 31
_MASK: Final = (1 << 32) - 1


class Machine(Protocol):
    """The plant as the firmware sees it: servo loops that follow a demand, and encoders."""

    dt_s: float
    torque_limit_permille: float

    @property
    def motor_counts(self) -> int: ...
    @property
    def load_counts(self) -> int: ...
    @property
    def velocity_counts_s(self) -> float: ...
    @property
    def torque_permille(self) -> int: ...
    @property
    def temperature_c(self) -> float: ...
    @property
    def load_torque_nm(self) -> float: ...
    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        """Runs ``substeps`` with the servo on; the demand moves linearly from start to end."""
        ...

    def coast(self, substeps: int, braked: bool) -> None:
        """Runs ``substeps`` with the power stage off and the holding brake open or closed."""
        ...


class Motion:
    """Demand and actual position of the axis, shared by the firmware and its operating modes.

    ``demand_counts`` and ``velocity_counts_s`` are position and velocity of the demand, in the plant's
    coordinates; ``motor_counts`` and ``load_counts`` are the latest encoder samples. ``limited`` becomes True
    when a limit reduces a target.
    """

    def __init__(self, dictionary: Dictionary, machine: Machine) -> None:
        self.dictionary = dictionary
        self.machine = machine
        self.home_counts = 0
        self.limited = False
        self.demand_counts = float(machine.motor_counts)
        self.velocity_counts_s = 0.0
        self.motor_counts = machine.motor_counts
        self.load_counts = machine.load_counts
        self.load_velocity_counts_s = 0.0
        self.motor_jump_counts = 0
        self.load_jump_counts = 0
        self.load_reading: Callable[[int], int] | None = None
        self._owed_s = 0.0
        self._targets = dictionary[0x607A, 0], dictionary[0x60C1, 1]
        for index, sub in ((0x607D, 1), (0x607D, 2), (0x607E, 0), (0x6080, 0)):
            dictionary[index, sub].follower = lambda _: self.take_parameters()
        self.take_parameters()

    def take_parameters(self) -> None:
        """Caches values derived from objects that only SDO writes, to keep them out of the cycle."""
        value = self.dictionary.value
        self.sign = -1 if value(0x607E) & 0x80 else 1
        """-1 if object 607Eh reverses positions, else 1."""
        self.max_speed_counts_s: float = value(0x6080) * value(0x608F, 1) / 60.0
        """Object 6080h in counts/s."""
        low, high = value(0x607D, 1), value(0x607D, 2)
        self._has_limits = low < high and (low > -_HALF or high < _HALF - 1)
        self._low, self._high = low, high

    def user(self, counts: float) -> int:
        """Converts a plant position to an (unbounded) user position."""
        return self.sign * round(counts) + self.home_counts

    def goal(self, target: int) -> float:
        """Converts a user's int32 target to a plant position within the limits.

        Without limits, positions wrap around, and the target is the one nearest to the demand. An axis that
        is already beyond a software limit may stay there and return; it is not forced inside.
        """
        sign = self.sign
        here = sign * round(self.demand_counts) + self.home_counts
        if self._has_limits:  # then positions do not wrap around
            here32 = ((here + _HALF) & _MASK) - _HALF
            low, high = self._low, self._high
            if not low <= target <= high:
                allowed = min(max(target, min(low, here32)), max(high, here32))
                self.limited |= allowed != target
                target = allowed
            distance = target - here32
        else:
            distance = ((target - here + _HALF) & _MASK) - _HALF
        return sign * (here + distance - self.home_counts)

    def unlimited(self, target: int) -> float:
        """Converts a user's int32 target to the plant position nearest to the demand, ignoring the limits."""
        distance = target - self.demand_position()
        return self.demand_counts + self.sign * (distance if self._has_limits else wrap_int32(distance))

    def actual_position(self) -> int:
        """Returns object 6064h."""
        return ((self.sign * self.motor_counts + self.home_counts + _HALF) & _MASK) - _HALF

    def demand_position(self) -> int:
        """Returns object 6062h."""
        return ((self.sign * round(self.demand_counts) + self.home_counts + _HALF) & _MASK) - _HALF

    def load_position(self) -> int:
        """Returns object 60E4h:01, to which neither homing nor polarity applies."""
        return ((self.load_counts + _HALF) & _MASK) - _HALF

    def preload_target(self) -> None:
        """Sets the target to the demand, so that the axis does not move when a mode begins."""
        for target in self._targets:
            target.value = wrap_int32(self.user(self.demand_counts))

    def take_actual_as_demand(self) -> None:
        """Sets the demand to the actual position, at rest."""
        self.demand_counts = float(self.motor_counts)
        self.velocity_counts_s = 0.0

    def follow(self, demand_counts: float, velocity_counts_s: float, period_s: float) -> None:
        """Moves the demand, and the plant with it, for one period."""
        substeps = self._substeps(period_s)
        if substeps:
            jump = self.motor_jump_counts  # the servo loops act on the encoder's reading
            self.machine.follow(self.demand_counts - jump, demand_counts - jump, substeps)
        self.demand_counts = demand_counts
        self.velocity_counts_s = velocity_counts_s
        self._sample(period_s)

    def coast(self, period_s: float) -> None:
        """Runs the plant without power for one period; the holding brake closes at rest."""
        substeps = self._substeps(period_s)
        at_rest = abs(self.machine.velocity_counts_s) * period_s < 1.0
        if substeps:
            self.machine.coast(substeps, at_rest)
        self._sample(period_s)
        self.take_actual_as_demand()

    def _substeps(self, period_s: float) -> int:
        """Returns the whole substeps of the plant in this period; the remainder is added to the next."""
        dt_s = self.machine.dt_s
        self._owed_s += period_s
        substeps = int(self._owed_s / dt_s + 1e-6)
        self._owed_s -= substeps * dt_s
        return substeps

    def _sample(self, period_s: float) -> None:
        machine = self.machine
        self.motor_counts = machine.motor_counts + self.motor_jump_counts
        counts = machine.load_counts + self.load_jump_counts
        if self.load_reading is not None:
            counts = self.load_reading(counts)
        before, self.load_counts = self.load_counts, counts
        self.load_velocity_counts_s = (self.load_counts - before) / period_s
