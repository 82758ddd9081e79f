"""Vibration at a fixed frequency, from a fan, a pump, a neighbouring machine or a resonance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Angleless, Effect
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import (
    Cause,
    Coefficient,
    Compensable,
    Experiment,
    Observations,
    Shape,
    Sought,
)
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.orders import cosines_and_sines


class Vibration(Angleless):
    """amplitude cos(2 pi f t + phase): a sinusoid in time."""

    name = "vibration"
    channels = frozenset({Channel.TIME})
    about = Cause(
        title="vibration at a fixed frequency",
        equation="A cos(2 pi f t + phase)",
        signature="the same frequency in hertz at every speed, and at rest",
        consequence="the load, or only the reading head, vibrates",
        remedy="find the source by its frequency; decouple it; lower the loop gain if the axis resonates",
        experiment="a standstill and sweeps at two speeds: an order changes its frequency, a vibration does "
        "not",
        aliases=("motor_order", "load_order", "flexspline_order", "subdivisional_error"),
        source="a sinusoid in time",
        size="0.1-5 arcsec",
        apart={
            "motor_order": Experiment(
                2, "stand still for a minute, then sweep at two speeds: a vibration keeps its frequency"
            )
        },
    )
    compensable = Compensable(False, "its phase drifts unpredictably, and it is mostly faster than the axis")
    shape = (Shape("frequency_hz", 0.05, 5000.0, logarithmic=True, is_frequency=True),)
    usual = 2
    sought = Sought.TONE
    inexact = 0.03
    """A vibration can appear as further, smaller ones, because its frequency and amplitude are not exactly
    constant and the gear's loop responds at other frequencies."""
    typical = {"frequency_hz": 50.0, "amplitude_arcsec": 1.0, "phase_deg": 0.0}
    """The frequency is an example; that of a real vibration is found by a search."""

    frequency_hz: float = Field(gt=0, le=1e5, description="frequency")
    amplitude_arcsec: float = Field(ge=0, le=3600, description="amplitude at the load")
    phase_deg: float = Field(ge=-360, le=360, description="phase of the cosine at the record's time zero")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields one vibration at a high frequency that the record resolves, as an example."""
        fast_hz = 0.137 / max(observations.period_s, 1e-6)
        yield cls(frequency_hz=min(max(fast_hz, 0.3), 40.0), amplitude_arcsec=1.0, phase_deg=0.0)

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        period_s = 1.0 / self.frequency_hz
        within = 1e3 * np.mod(motion.channel(Channel.TIME, self.name), period_s)
        return Coordinate(f"time within a period of {1e3 * period_s:.4g} ms", "ms", within, bins=48)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("", (0, 1), ()),)

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        error: FloatArray = self.amplitude_arcsec * np.cos(self._angle(motion) + math.radians(self.phase_deg))
        return error

    def at(self, motor_deg: float, moment: Moment) -> float:
        angle = 2.0 * math.pi * self.frequency_hz * moment.time_s + math.radians(self.phase_deg)
        return self.amplitude_arcsec * math.cos(angle)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the cosine and sine at the vibration's frequency, shape (n, 2)."""
        return cosines_and_sines(self._angle(motion), (1,))

    def coefficients(self) -> FloatArray:
        """Returns A cos(phase) and -A sin(phase), arcsec."""
        phase = math.radians(self.phase_deg)
        return self.amplitude_arcsec * np.array([math.cos(phase), -math.sin(phase)])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the vibration with a new amplitude and phase and, if given, a new frequency."""
        cosine, sine = (float(each) for each in coefficients)
        update = {
            "amplitude_arcsec": math.hypot(cosine, sine),
            "phase_deg": math.degrees(math.atan2(-sine, cosine)),
            **dict(shape or {}),
        }
        return self.model_copy(update=update)

    def bound_arcsec(self) -> float:
        return self.amplitude_arcsec

    def _angle(self, motion: Motion) -> FloatArray:
        return (2.0 * math.pi * self.frequency_hz) * motion.channel(Channel.TIME, self.name)
