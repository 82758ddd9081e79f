"""Interpolation error of the load encoder, because its sine signals are not perfect."""

import cmath
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Level, Observations, Sought, Tracker
from hdbridge.axis.effects.motion import Channel, FloatArray, Motion, Start
from hdbridge.axis.effects.orders import RAD_PER_DEG, HarmonicSum, horner, orders_from, phasors
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

_HARMONICS = (1, 2, 4)
LEAST_LINES = 256
"""Minimum line count of an encoder that interpolates."""

RESOLVED = 0.05
"""Minimum fraction of the moving samples that must be less than half a line apart to show a line."""
IN_STEP = 0.85
"""Mean resultant length of the sampling steps, as phases within a line, above which a slow wave has nearly
the same values. The wave then explains the square of this length, 0.72, of the line's power."""


class SubdivisionalError(HarmonicSum):
    """Sum over k = 1, 2, 4 of A_k cos(k lines theta_L + phi_k).

    theta_L must be the predicted load angle, including the transmission error. A line is often only a few
    hundred arcsec wide, so motor angle / N is too inaccurate. Noise of a measured angle would imitate the
    effect.
    """

    name = "subdivisional_error"
    channels = frozenset({Channel.LOAD_ANGLE})
    about = Cause(
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
    compensable = Compensable(False, "it is an error of the measurement")
    few = frozenset(_HARMONICS)
    usual = 2
    sought = Sought.LINE
    typical = {"lines_per_turn": 9000, "orders": orders_from(_HARMONICS, 0.5)}
    """The line count is an example; that of an encoder is found by a search or in its data sheet."""

    lines_per_turn: int = Field(ge=16, le=10_000_000, description="signal periods per load turn")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields one effect with a line width of a few samples, as an example."""
        step_deg = float(np.median(np.abs(np.diff(observations.motion.motor_deg)))) / observations.ratio
        lines = round(DEG_PER_TURN / max(2.7 * step_deg, 0.02))
        yield cls(lines_per_turn=max(lines, 1800), orders=orders_from([1]))

    @classmethod
    def at_lines(cls, lines_per_turn: int) -> Iterator[Self]:
        """Yields the effects that have a spectral line at this number of periods per load turn.

        The number is the line count, or two or four times the line count.
        """
        for numbers in ((1,), _HARMONICS):
            yield cls(lines_per_turn=lines_per_turn, orders=orders_from(numbers))
        for part in (2, 4):
            if lines_per_turn % part == 0 and lines_per_turn // part >= LEAST_LINES:
                few = (1, 2) if part == 2 else _HARMONICS
                yield cls(lines_per_turn=lines_per_turn // part, orders=orders_from(few))

    def unidentifiable(self, observations: Observations) -> str:
        """Requires samples denser than the lines, or different speeds.

        Otherwise the samples are evenly spaced over many lines, and a slow wave has the same values there.
        """
        speed = observations.motion.motor_speed_deg_s
        if speed is None or not np.any(speed):
            return ""
        moved = np.abs(speed[speed != 0.0]) * observations.period_s / observations.ratio
        lines = moved * (self.lines_per_turn / DEG_PER_TURN)  # between two samples
        if np.quantile(lines, RESOLVED) < 0.5 or abs(np.mean(np.exp(2j * np.pi * lines))) < IN_STEP:
            return ""
        return "sampled in equal steps over many lines, which a slow wave explains as well"

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the load angle modulo one line."""
        line_deg = DEG_PER_TURN / self.lines_per_turn
        load = motion.load_deg if motion.load_deg is not None else motion.motor_deg / ratio
        name = f"load angle within a division of {line_deg * ARCSEC_PER_DEG:.4g} arcsec"
        return Coordinate(name, "arcsec", np.mod(load, line_deg) * ARCSEC_PER_DEG, bins=48)

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        amplitudes, scale = phasors(self.orders), RAD_PER_DEG * self.lines_per_turn
        return Level(lambda _, now: horner(amplitudes, cmath.rect(1.0, scale * now.load_deg)).real)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0

    def _angle(self, motion: Motion) -> FloatArray:
        return (RAD_PER_DEG * self.lines_per_turn) * motion.channel(Channel.LOAD_ANGLE, self.name)
