"""Encoder errors: geometry of the disc, signals, cable, warming, lost counts.

Each error is a reading error in degrees of the encoder's shaft; the shaft itself does not move.
"""

import math
from collections.abc import Iterable
from typing import Final, Protocol

from hdbridge.sim.state import state
from hdbridge.sim.truth.encoder import (
    TrueCable,
    TrueDisc,
    TrueEncoder,
    TrueLoadEncoder,
    TrueLoss,
    TrueSensorWarming,
    TrueSignals,
)
from hdbridge.units import ARCSEC_PER_DEG

BACK_DEG: Final = 0.05
"""Load travel after a reversal over which the drag of a cable changes sign."""


class ReadingError(Protocol):
    """One cause of a reading error, with its state."""

    def error_deg(self, shaft_deg: float) -> float:
        """Returns the reading minus the shaft's angle, degrees."""
        ...


@state
class Disc:
    """Disc with eccentricity and with a distortion twice per turn.

    The head is fixed. The graduation's centre is at a distance e from the axis of a disc of radius R. The
    angle of the head about that centre differs from its angle about the axis by ``atan2(e sin a, R + e cos
    a)``, about e/R sin a.
    """

    def __init__(self, truth: TrueDisc) -> None:
        self._relative = truth.eccentricity_um / 1000.0 / truth.radius_mm
        self._eccentric_rad = math.radians(truth.eccentric_at_deg)
        self._oval = truth.ovality_um / 1000.0 / truth.radius_mm
        self._oval_rad = math.radians(truth.oval_at_deg)

    def error_deg(self, shaft_deg: float) -> float:
        angle = math.radians(shaft_deg)
        turned, e = angle - self._eccentric_rad, self._relative
        off = math.atan2(e * math.sin(turned), 1.0 + e * math.cos(turned))
        return math.degrees(off + self._oval * math.sin(2.0 * (angle - self._oval_rad)))


@state
class Signals:
    """Interpolation within a line from imperfect sine and cosine signals.

    Offsets cause an error once per line, unequal amplitudes or phases twice, third harmonics four times.
    """

    def __init__(self, truth: TrueSignals) -> None:
        self._lines = float(truth.lines_per_turn)
        self._sine_offset = truth.sine_offset
        self._cosine_offset = truth.cosine_offset
        self._gain = 1.0 + truth.gain_mismatch
        self._phase_rad = math.radians(truth.phase_mismatch_deg)
        self._third = truth.third_harmonic

    def error_deg(self, shaft_deg: float) -> float:
        phase = math.fmod(shaft_deg * self._lines, 360.0) * (math.pi / 180.0)
        sine = self._gain * math.sin(phase) - self._third * math.sin(3.0 * phase) + self._sine_offset
        cosine = math.cos(phase + self._phase_rad) + self._third * math.cos(3.0 * phase) + self._cosine_offset
        return math.degrees(math.remainder(math.atan2(sine, cosine) - phase, math.tau)) / self._lines


@state
class Cable:
    """Cable that is taut beyond an angle; it then twists the encoder's body, which reduces the reading."""

    def __init__(self, truth: TrueCable) -> None:
        self._from_deg = truth.taut_from_deg
        self._per_deg = truth.arcsec_per_deg / ARCSEC_PER_DEG
        self._drag = truth.drag
        self._led = False
        self._last_deg = 0.0
        self._way = 0.0

    def error_deg(self, shaft_deg: float) -> float:
        if self._led:
            travel = (shaft_deg - self._last_deg) / BACK_DEG
            self._way = min(1.0, max(-1.0, self._way + travel))
        self._led = True
        self._last_deg = shaft_deg
        beyond = shaft_deg - self._from_deg
        return -self._per_deg * beyond * (1.0 + self._drag * self._way) if beyond > 0.0 else 0.0


@state
class SensorWarming:
    """Shift of the reading with the encoder's warming, which lags the square of the speed."""

    def __init__(self, truth: TrueSensorWarming, interval_s: float) -> None:
        self._goal = truth.arcsec_at_10_deg_s / 100.0 / ARCSEC_PER_DEG
        self._interval_s = interval_s
        self._nearer = -math.expm1(-interval_s / truth.time_constant_s)
        self._exponent = 2.0
        self._led = False
        self._last_deg = 0.0
        self._shift_deg = 0.0

    def error_deg(self, shaft_deg: float) -> float:
        if self._led:
            speed_deg_s = abs(shaft_deg - self._last_deg) / self._interval_s
            goal_deg = self._goal * speed_deg_s**self._exponent
            self._shift_deg += (goal_deg - self._shift_deg) * self._nearer
        self._led = True
        self._last_deg = shaft_deg
        return self._shift_deg


@state
class Losses:
    """Lost counts of an encoder."""

    _past: int
    """Number of losses so far."""

    def __init__(self, losses: Iterable[TrueLoss]) -> None:
        in_order = sorted(losses, key=lambda each: each.time_s)
        self._times_s: tuple[float, ...] = tuple(each.time_s for each in in_order)
        self._counts: tuple[float, ...] = tuple(float(each.counts) for each in in_order)
        self._count: int = len(in_order)
        self._past, self._lost = 0, 0.0

    def counts(self, now_s: float) -> float:
        """Returns the reading error in counts at a time; successive times must not decrease."""
        while self._past < self._count and self._times_s[self._past] <= now_s:
            self._lost += self._counts[self._past]
            self._past += 1
        return self._lost


@state
class Late:
    """Delayed angle of a shaft; updated once per substep."""

    deg: float
    """Delayed angle."""
    _angles: list[float]
    """Angles since the delayed one, in a ring buffer that starts at ``_oldest``."""

    def __init__(self, late_s: float, dt_s: float, start_deg: float) -> None:
        whole, self._part = divmod(late_s / dt_s, 1.0)
        self._kept: int = int(whole) + 2
        self._angles = [0.0] * self._kept
        self.begin(start_deg)

    def begin(self, shaft_deg: float) -> None:
        """Resets the delay to a shaft that has always been at this angle."""
        self._oldest = 0
        self.deg = shaft_deg
        for place in range(self._kept):
            self._angles[place] = shaft_deg

    def feed(self, shaft_deg: float) -> None:
        """Stores the shaft's angle after one more substep, and updates the delayed angle."""
        angles, oldest = self._angles, self._oldest
        angles[oldest] = shaft_deg
        first = oldest + 1 if oldest + 1 < self._kept else 0
        second = first + 1 if first + 1 < self._kept else 0
        self._oldest = first
        self.deg = angles[second] + (angles[first] - angles[second]) * self._part


@state
class FixedErrors:
    """Reading errors that depend on the shaft's angle alone."""

    def __init__(self, truth: TrueEncoder) -> None:
        signals = truth.signals if isinstance(truth, TrueLoadEncoder) else None
        self._with_disc = bool(truth.disc)
        self._with_signals = bool(signals)
        self._disc = Disc(truth.disc or TrueDisc(radius_mm=1.0))
        self._signals = Signals(signals or TrueSignals(lines_per_turn=1))

    def at_deg(self, shaft_deg: float) -> float:
        """Returns the reading minus the shaft's angle, degrees."""
        error_deg = 0.0
        if self._with_disc:
            error_deg += self._disc.error_deg(shaft_deg)
        if self._with_signals:
            error_deg += self._signals.error_deg(shaft_deg)
        return error_deg


@state
class Body:
    """Shift of the load encoder's reading by its cable and its warming.

    The shift has a state, so it must be updated once per substep; it may be read at any time.
    """

    deg: float
    """Current shift of the reading."""

    def __init__(self, truth: TrueLoadEncoder, dt_s: float) -> None:
        errors: list[ReadingError] = []
        if truth.cable is not None:
            errors.append(Cable(truth.cable))
        if truth.sensor_warming is not None:
            errors.append(SensorWarming(truth.sensor_warming, dt_s))
        self._errors: tuple[ReadingError, ...] = tuple(errors)
        self.moves = bool(errors)
        self.deg = 0.0

    def feed(self, shaft_deg: float) -> None:
        """Updates the sum of the reading errors from the shaft's angle after the latest substep."""
        shift_deg = 0.0
        for each in self._errors:
            shift_deg += each.error_deg(shaft_deg)
        self.deg = shift_deg
