"""Elastic hysteresis of the gear: lead of its output as a function of the motor's travel.

Each law is rate-independent and advances from one motor angle to the next. The output leads in the direction
of motion, so a closed loop of the motor angle has a positive area, the integral of error over angle.
"""

import math
from typing import Final, Protocol

from hdbridge.sim.state import state
from hdbridge.sim.truth.hysteresis import BoucWen, Dahl, Hysteresis, MaxwellSlip, RollingFriction

PIECE: Final = 0.05
"""Longest step of the Bouc-Wen integration, in units of the yield travel."""


class Law(Protocol):
    """Hysteresis law with its state."""

    def advance(self, motor_deg: float) -> float:
        """Returns the error in arcsec after monotonic motion of the motor to this angle."""
        ...


def law_of(truth: Hysteresis | None, motor_deg: float) -> Law | None:
    """Returns the law of a truth file in its initial state at a motor angle; None without hysteresis."""
    if isinstance(truth, RollingFriction):
        return RollingFrictionLaw(truth, motor_deg)
    if isinstance(truth, MaxwellSlip):
        return MaxwellSlipLaw(truth, motor_deg)
    if isinstance(truth, Dahl):
        return DahlLaw(truth, motor_deg)
    return None if truth is None else BoucWenLaw(truth, motor_deg)


@state
class RollingFrictionLaw:
    """Rolling-friction law of the article, continuous at reversals.

    After a reversal at angle a with error e the error is ``e + s 2 offset g(x)``, limited to ``s offset``; s
    is the direction and ``x = |motor - a| / width``, at most 1. ``g(x) = (x^(n-1) - (n-1) x) / (2-n)``, and
    ``x (1 - ln x)`` for n = 2. Only the last reversal counts, so there is no return-point memory.
    """

    def __init__(self, truth: RollingFriction, motor_deg: float) -> None:
        self._offset = truth.offset_arcsec
        self._width = truth.width_deg
        self._exponent = truth.exponent
        self._motor_deg = motor_deg
        self._error = truth.start_arcsec
        self._direction = 0.0
        self._branch_deg = motor_deg
        self._branch_arcsec = truth.start_arcsec
        self._saturated = False

    def advance(self, motor_deg: float) -> float:
        before_deg = self._motor_deg
        if motor_deg == before_deg:
            return self._error
        direction = 1.0 if motor_deg > before_deg else -1.0
        self._motor_deg = motor_deg
        if direction != self._direction:
            self._direction = direction
            self._branch_deg = before_deg
            self._branch_arcsec = self._error
            self._saturated = False
        elif self._saturated:
            return self._error
        travel = direction * (motor_deg - self._branch_deg) / self._width
        size = self._offset
        if travel < 1.0:
            n = self._exponent
            if n == 2.0:
                crossed = travel * (1.0 - math.log(travel))
            else:
                crossed = (travel ** (n - 1.0) - (n - 1.0) * travel) / (2.0 - n)
            size = direction * self._branch_arcsec + 2.0 * self._offset * crossed
        if size >= self._offset:
            size = self._offset
            self._saturated = True
        self._error = direction * size
        return self._error


@state
class MaxwellSlipLaw:
    """Maxwell slip: parallel springs with sliders (Prandtl-Ishlinskii), with return-point memory."""

    def __init__(self, truth: MaxwellSlip, motor_deg: float) -> None:
        self._stiffnesses: tuple[float, ...] = tuple(
            each.limit_arcsec / each.yield_deg for each in truth.elements
        )
        self._limits: tuple[float, ...] = tuple(each.limit_arcsec for each in truth.elements)
        self._states: list[float] = [0.0] * len(self._limits)
        self._motor_deg = motor_deg
        self._error = 0.0

    def advance(self, motor_deg: float) -> float:
        travel = motor_deg - self._motor_deg
        if travel == 0.0:
            return self._error
        self._motor_deg = motor_deg
        states, stiffnesses, limits = self._states, self._stiffnesses, self._limits
        total = 0.0
        for element in range(len(states)):
            error, limit = states[element] + stiffnesses[element] * travel, limits[element]
            if error > limit:
                error = limit
            elif error < -limit:
                error = -limit
            states[element] = error
            total += error
        self._error = total
        return total


@state
class BoucWenLaw:
    """Bouc-Wen law: ``dz/dx = (1 - |z|^n (beta sgn(dx z) + gamma)) / yield``; the error is offset * z.

    beta + gamma = 1. It is integrated over the motor's travel x by the midpoint rule, in short steps.
    """

    def __init__(self, truth: BoucWen, motor_deg: float) -> None:
        self._offset = truth.offset_arcsec
        self._yield = truth.yield_deg
        self._exponent = truth.exponent
        self._beta = truth.beta
        self._gamma = 1.0 - truth.beta
        self._motor_deg = motor_deg
        self._z = 0.0

    def advance(self, motor_deg: float) -> float:
        travel = (motor_deg - self._motor_deg) / self._yield
        z = self._z
        if travel != 0.0:
            self._motor_deg = motor_deg
            pieces = math.ceil(abs(travel) / PIECE)
            step = travel / pieces
            direction = 1.0 if travel > 0.0 else -1.0
            for _ in range(pieces):
                middle = z + 0.5 * step * self._slope(z, direction)
                z += step * self._slope(middle, direction)
            self._z = z
        return self._offset * z

    def _slope(self, z: float, direction: float) -> float:
        turned = self._beta if z * direction > 0.0 else -self._beta
        return float(1.0 - abs(z) ** self._exponent * (turned + self._gamma))


@state
class DahlLaw:
    """Dahl's law: ``dz/dx = (1 - z sgn dx)^i / yield``, solved exactly; the error is offset * z."""

    def __init__(self, truth: Dahl, motor_deg: float) -> None:
        self._offset = truth.offset_arcsec
        self._yield = truth.yield_deg
        self._exponent = truth.exponent
        self._motor_deg = motor_deg
        self._z = 0.0

    def advance(self, motor_deg: float) -> float:
        travel = (motor_deg - self._motor_deg) / self._yield
        if travel != 0.0:
            self._motor_deg = motor_deg
            direction = 1.0 if travel > 0.0 else -1.0
            left = self._left(1.0 - direction * self._z, abs(travel))
            self._z = direction * (1.0 - left)
        return self._offset * self._z

    def _left(self, left: float, travel: float) -> float:
        """Returns the remaining distance to the offset ahead (0 to 2) after a travel, in yield units."""
        if left <= 0.0:
            return 0.0
        rest = 1.0 - self._exponent
        if rest == 0.0:
            return left * math.exp(-travel)
        power = left**rest - rest * travel
        return power ** (1.0 / rest) if power > 0.0 else 0.0
