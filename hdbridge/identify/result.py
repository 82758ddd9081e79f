"""What an identification says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.estimation.gain import Gain
from hdbridge.estimation.intervals import Interval
from hdbridge.estimation.noise import NoiseModel
from hdbridge.identify.orders import Line
from hdbridge.model import TransmissionModel

WORTH = 0.01
"""Share of its rms by which what a model leaves on held-out data must fall at least.

A model that is better by less changes no stepping test, and noise alone offers it: a second calibration of
the unchanged demo axis leaves 0.8 % less.
"""


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """How noisy the record is, and how far the model's residual is above that."""

    standing_arcsec: float | None
    """Rms about the mean of each rest; None where the axis never stood for long enough."""
    laps_arcsec: float | None
    """What two passes over the same angles in one direction differ by, over the root of two."""
    model: NoiseModel
    """White noise and wanders as the intervals use them, from the residual."""
    residual_arcsec: float
    """Rms that the model, as it is written, leaves of a sample, about its zero."""
    fitted_arcsec: float
    """The same with all that was fitted in addition and is not written: delay, rounding, other orders."""
    samples: int
    """Used by the fit."""
    effective_samples: float
    """Independent samples of the residual's size that would fix the zero as well as these do."""


@dataclass(frozen=True, slots=True)
class Outliers:
    """Samples that stand out alone and were given no weight."""

    samples: int
    longest_run: int


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """One question to the residual."""

    name: str
    """motor_angle, load_angle, direction, time, whiteness, noise_level."""
    passed: bool
    size_arcsec: float
    """How large what was found is."""
    text: str


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How well a model fitted to the rest of a record tells the part that was left out."""

    gain: Gain | None
    """Of the model alone against the active one, or none, each about its zero; None where nothing was held
    out.
    """
    in_addition: Gain | None
    """The same with all that is fitted in addition to the model (delay, load orders) taken off of both."""
    fitted_arcsec: float
    """Rms that the fit leaves of the same data, with all that is fitted in addition to the model."""
    text: str

    @property
    def improves(self) -> bool:
        """Whether the model is worth having.

        With the nuisances taken off, what it leaves falls by more than chance and by at least `WORTH` of its
        rms; alone it is not worse.
        """
        gain = self.in_addition
        return (
            gain is not None
            and gain.sure
            and gain.after_arcsec <= (1.0 - WORTH) * gain.before_arcsec
            and not self.worse
        )

    @property
    def worse(self) -> bool:
        """Whether the model leaves more of what was left out than the active one, or none, does."""
        return self.gain is not None and self.gain.recovered < 0.0


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Something that was fitted in addition to the model so that it does not bend it."""

    name: str
    text: str
    value: float
    half_width: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Block means for plots, all shape (b,)."""

    time_s: FloatArray
    motor_deg: FloatArray
    load_deg: FloatArray
    direction: FloatArray
    """1, -1, or 0 at rest."""
    kind: tuple[str, ...]
    """Names that ``kind_index`` points into."""
    kind_index: np.ndarray[Any, np.dtype[np.intp]]
    error_arcsec: FloatArray
    """Observed, zero taken off."""
    predicted_arcsec: FloatArray
    """The model's effects."""
    residual_arcsec: FloatArray
    """Observed minus model, about the zeros that suit it."""
    orders_arcsec: FloatArray
    """Observed without hysteresis, zero and nuisances."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """The model that a record shows, and how far it can be trusted."""

    model: TransmissionModel
    """With ``uncertainty``: 95 % half widths, nested like the parameters."""
    intervals: tuple[Interval, ...]
    zeros_arcsec: tuple[float, ...]
    """Offset of each absolute zero against the median of its record's error."""
    nuisances: tuple[Nuisance, ...]
    noise: NoiseFigures
    outliers: Outliers
    orders: tuple[Line, ...]
    """Of the motor, in the model."""
    spectrum: tuple[Line, ...]
    """All orders that were looked for."""
    residual_tests: tuple[ResidualTest, ...]
    held_out: HeldOut
    traces: Traces
    warnings: tuple[str, ...]
    """What the data cannot say, in words."""

    def interval(self, effect: str, parameter: str) -> Interval:
        """The interval of one parameter; KeyError where it was not fitted."""
        for each in self.intervals:
            if (each.effect, each.parameter) == (effect, parameter):
                return each
        raise KeyError(f"{effect}: {parameter}")
