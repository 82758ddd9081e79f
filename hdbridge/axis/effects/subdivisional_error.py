"""Interpolation error of the load encoder, whose sine signals are not perfect sines."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, field_validator

from hdbridge.axis.effects.base import (
    Angleless,
    Cause,
    Channel,
    Coefficient,
    Compensable,
    Coordinate,
    Effect,
    FloatArray,
    Memoryless,
    Moment,
    Motion,
    Observations,
    Sought,
    Start,
    Stretch,
    Tracker,
)
from hdbridge.axis.effects.orders import (
    RAD_PER_DEG,
    MotorOrder,
    Orders,
    coefficients_of,
    cosines_and_sines,
    horner,
    named_orders,
    orders_fitted,
    orders_from,
    phasors,
    turn_of,
)
from hdbridge.axis.effects.path import away_from_reversals
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

_HARMONICS = (1, 2, 4)
LEAST_LINES = 256
"""Minimum line count of an encoder that interpolates."""

RESOLVED = 0.05
"""Share of the moving samples that suffices to see a line, if they are denser than half a line."""
IN_STEP = 0.85
"""Mean resultant length of the steps within a line, above which a slow wave has the same values: it
explains its square, 0.72, of the line's."""


class SubdivisionalError(Angleless):
    """Sum over k = 1, 2, 4 of A_k cos(k lines theta_L + phi_k).

    The load angle must be the predicted one, error included. A line is often only a few hundred arcsec wide,
    so motor angle / N is not accurate enough, and the noise of the measured angle would imitate the effect.
    """

    name: ClassVar[str] = "subdivisional_error"
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.LOAD_ANGLE})
    about: ClassVar[Cause] = Cause(
        title="interpolation error of the load encoder",
        subject="interpolation errors",
        equation="sum over k of A_k cos(k lines theta_L + phi_k), k = 1 (offset), 2 (gain, phase), 4 "
        "(distortion)",
        signature="one, two or four periods per encoder line",
        consequence="the axis is right; the measurement is wrong within each line",
        remedy="align and clean the reading head; correct offset, gain and phase of its signals",
        experiment="a very slow sweep over some lines, again with the reading head moved by a fraction of a "
        "line",
        aliases=("motor_order", "vibration"),
        source="Lissajous errors of sine encoders (Heydemann)",
        size="0.1-2 arcsec",
    )
    compensable: ClassVar[Compensable] = Compensable(
        False,
        "it is an error of the measurement",
    )
    usual: ClassVar[int] = 2
    sought: ClassVar[Sought | None] = Sought.LINE
    typical: ClassVar[Mapping[str, Any]] = {"lines_per_turn": 9000, "orders": orders_from(_HARMONICS, 0.5)}
    """9000 lines, as an example; the real line count comes from a search or the data sheet."""

    lines_per_turn: Annotated[int, Field(ge=16, le=10_000_000, description="signal periods per load turn")]
    orders: Orders

    @field_validator("orders")
    @classmethod
    def _few(cls, orders: tuple[MotorOrder, ...]) -> tuple[MotorOrder, ...]:
        numbers = [each.order for each in orders]
        if len(set(numbers)) != len(numbers) or not set(numbers) <= set(_HARMONICS):
            raise ValueError("orders of the line count are 1, 2 and 4, each once at most")
        return orders

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields one whose line spans a few samples of the record, as an example."""
        step_deg = float(np.median(np.abs(np.diff(observations.motion.motor_deg)))) / observations.ratio
        lines = round(DEG_PER_TURN / max(2.7 * step_deg, 0.02))
        yield cls(lines_per_turn=max(lines, 1800), orders=orders_from([1]))

    @classmethod
    def at_lines(cls, lines_per_turn: int) -> Iterator[Self]:
        """Yields the effects that have a spectral line at this number of periods per load turn."""
        for numbers in ((1,), _HARMONICS):
            yield cls(lines_per_turn=lines_per_turn, orders=orders_from(numbers))
        for part in (2, 4):
            if lines_per_turn % part == 0 and lines_per_turn // part >= LEAST_LINES:
                few = (1, 2) if part == 2 else _HARMONICS
                yield cls(lines_per_turn=lines_per_turn // part, orders=orders_from(few))

    def unidentifiable(self, observations: Observations) -> str:
        """Requires samples denser than the lines or at varied speeds, because equal steps over many lines
        cannot be distinguished from equal steps over the rest of a line, a slow wave.
        """
        speed = observations.motion.motor_speed_deg_s
        if speed is None or not np.any(speed):
            return ""
        moved = np.abs(speed[speed != 0.0]) * observations.period_s / observations.ratio
        lines = moved * (self.lines_per_turn / DEG_PER_TURN)  # between two samples
        if np.quantile(lines, RESOLVED) < 0.5 or abs(np.mean(np.exp(2j * np.pi * lines))) < IN_STEP:
            return ""
        return "sampled in equal steps over many lines, which a slow wave explains as well"

    def largest_piece_arcsec(self) -> float:
        """Returns the largest amplitude, because in a coarsely sampled record an order shows only in part."""
        return max((each.amplitude_arcsec for each in self.orders), default=0.0)

    def shows(self, motion: Motion) -> Stretch | None:
        """Returns the samples away from reversals, where a loop of another shape leaves no bumps."""
        return away_from_reversals(motion)

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the load angle within a line."""
        line_deg = DEG_PER_TURN / self.lines_per_turn
        load = motion.load_deg if motion.load_deg is not None else motion.motor_deg / ratio
        name = f"load angle within a division of {line_deg * ARCSEC_PER_DEG:.4g} arcsec"
        return Coordinate(name, "arcsec", np.mod(load, line_deg) * ARCSEC_PER_DEG, bins=48)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return named_orders(self.orders)

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        error: FloatArray = horner(phasors(self.orders), turn_of(self._angle(motion))).real
        return error

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return _Tracker(phasors(self.orders), RAD_PER_DEG * self.lines_per_turn)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns cosine and sine of each order, shape (n, 2 * orders)."""
        return cosines_and_sines(self._angle(motion), [each.order for each in self.orders])

    def coefficients(self) -> FloatArray:
        """Returns A cos(phi) and -A sin(phi) of each order, arcsec."""
        return coefficients_of(self.orders)

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns other amplitudes and phases and, if given in ``shape``, another line count."""
        update = {"orders": orders_fitted(self.orders, coefficients), **dict(shape or {})}
        return self.model_copy(update=update)

    def bound_arcsec(self) -> float:
        return sum(each.amplitude_arcsec for each in self.orders)

    def _angle(self, motion: Motion) -> FloatArray:
        return (RAD_PER_DEG * self.lines_per_turn) * motion.channel(Channel.LOAD_ANGLE, self.name)


class _Tracker(Memoryless):
    def __init__(self, amplitudes: tuple[complex, ...], scale: float) -> None:
        self._phasors = amplitudes
        self._scale = scale

    def peek(self, motor_deg: float, moment: Moment) -> float:
        angle = self._scale * moment.load_deg
        return horner(self._phasors, complex(math.cos(angle), math.sin(angle))).real
