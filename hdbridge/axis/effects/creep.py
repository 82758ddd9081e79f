"""Creep: slow relaxation of strain after a stop."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import (
    Cause,
    Coefficient,
    Compensable,
    Observations,
    Shape,
    Stretch,
    Tracker,
)
from hdbridge.axis.effects.kinematics import speed_of
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.path import longest_rest_s, standing_s
from hdbridge.axis.effects.recurrence import recurrence
from hdbridge.strictness import Strict

RESTS = 3.0
"""Maximum ratio of the shortest time constant to the longest rest. Above it, the decay is not visible."""


class Relaxation(Strict):
    """One exponential of a relaxation."""

    amplitude_arcsec: float = Field(
        ge=-3600, le=3600, description="strain after a long move forward, at the load"
    )
    tau_s: float = Field(gt=0, le=1e6, description="time constant at rest")


class Creep(Effect):
    """Sum of A_j y_j; y_j approaches the direction of motion (1 or -1) in motion, and zero at rest.

    The time constant is tau_j at rest and ``build_up`` tau_j in motion. If ``build_up`` is 1, each y_j is a
    linear viscoelastic element, which short moves strain only a little. If it is much less than 1, each move
    strains the element fully, and the error after each stop is A_j exp(-t / tau_j).
    """

    name = "creep"
    channels = frozenset({Channel.TIME, Channel.SPEED})
    about = Cause(
        title="relaxation after a stop",
        equation="sum of A_j y_j; tau_j dy_j/dt = -y_j at rest, build_up tau_j dy_j/dt = sgn(v) - y_j in "
        "motion",
        signature="after a stop the load moves on for seconds to minutes while the motor stands still",
        consequence="the position after a move differs from that a minute later",
        remedy="compensate it, or wait; less preload or friction torque",
        experiment="long rests after moves in either direction; servo settling shows at the motor, too",
        aliases=("zero_drift",),
        source="generalised Kelvin-Voigt element: a sum of exponentials",
        size="1-10 arcsec",
    )
    compensable = Compensable(True, "the load really has this error, and the command says when it stopped")
    shape = (
        Shape("tau_s", 0.05, 3600.0, logarithmic=True),
        Shape("build_up", 0.01, 1.0, logarithmic=True),
    )
    """``tau_s`` is the time constant of the first exponential; the others keep their ratio to it."""

    usual = 8
    """Maximum number of exponentials; more than one, because a real relaxation is a sum of several."""
    typical = {
        "parts": tuple(Relaxation(amplitude_arcsec=2.0, tau_s=tau_s) for tau_s in (2.0, 20.0)),
        "build_up": 0.1,
    }

    parts: tuple[Relaxation, ...] = Field(
        min_length=1, max_length=8, description="exponentials: amplitude_arcsec, tau_s each"
    )
    build_up: float = Field(
        1.0, gt=0, le=10, description="time constants in motion, relative to those at rest"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields single exponentials; those found are combined later."""
        for tau_s in (0.3, 1.0, 3.0, 10.0, 30.0, 100.0):
            for build_up in (0.03, 0.3, 1.0):
                yield cls(parts=(Relaxation(amplitude_arcsec=1.0, tau_s=tau_s),), build_up=build_up)

    def unidentifiable(self, observations: Observations) -> str:
        """Requires a time constant comparable to a rest; a slower relaxation is not separable from drift."""
        if min(each.tau_s for each in self.parts) <= RESTS * longest_rest_s(observations.motion):
            return ""
        return "no rest is long enough to see it bend"

    def shows(self, motion: Motion) -> Stretch:
        """Returns the samples at rest; in motion, creep may be part of a speed-dependent effect."""
        return Stretch(standing_s(motion) > 0.0, "not seen at rest")

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the time since the axis last stopped or started."""
        return over.since_change(motion)

    def pieces(self) -> tuple[Self, ...]:
        return tuple(self.model_copy(update={"parts": (each,)}) for each in self.parts)

    def joined(self, other: Effect) -> Self | None:
        if not isinstance(other, Creep):
            return None
        return self.model_copy(update={"parts": (*self.parts, *other.parts)})

    def largest_piece_arcsec(self) -> float:
        """Returns the largest amplitude, because exponentials may cancel each other."""
        return max(abs(each.amplitude_arcsec) for each in self.parts)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(
            Coefficient(f"part_{i + 1}_amplitude_arcsec", (i,), ("parts", i, "amplitude_arcsec"))
            for i in range(len(self.parts))
        )

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return _Tracker([(each.amplitude_arcsec, each.tau_s) for each in self.parts], self.build_up)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns y_j of each exponential, shape (n, parts)."""
        time_s = motion.channel(Channel.TIME, self.name)
        going = np.sign(speed_of(motion, self.name))
        step = np.maximum(np.diff(time_s, prepend=time_s[:1]), 0.0)
        step = np.where(going != 0.0, step / self.build_up, step)
        columns = np.empty((len(motion), len(self.parts)))
        for j, each in enumerate(self.parts):
            decay = np.exp(-step / each.tau_s)
            columns[:, j] = recurrence(decay, (1.0 - decay) * going, 0.0)
        return columns

    def coefficients(self) -> FloatArray:
        return np.array([each.amplitude_arcsec for each in self.parts])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with new amplitudes and, if given, new time constants and build-up.

        ``tau_s`` scales all time constants.
        """
        given = dict(shape or {})
        scale = given.pop("tau_s", self.parts[0].tau_s) / self.parts[0].tau_s
        parts = tuple(
            Relaxation.model_construct(amplitude_arcsec=float(amplitude), tau_s=scale * each.tau_s)
            for each, amplitude in zip(self.parts, coefficients, strict=True)
        )
        return self.model_copy(update={"parts": parts, **given})

    def bound_arcsec(self) -> float:
        return sum(abs(each.amplitude_arcsec) for each in self.parts)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0


class _Tracker(Tracker):
    """Tracker whose state contains all y_j and their time."""

    def __init__(self, parts: list[tuple[float, float]], build_up: float) -> None:
        self._amplitudes = [amplitude for amplitude, _ in parts]
        self._rates = [1.0 / tau_s for _, tau_s in parts]
        self._build_up = build_up
        self._strains = [0.0] * len(parts)
        self._time: float | None = None

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return sum(map(float.__mul__, self._amplitudes, self._at(moment)))

    def advance(self, motor_deg: float, moment: Moment) -> float:
        self._strains = self._at(moment)
        self._time = moment.time_s
        return sum(map(float.__mul__, self._amplitudes, self._strains))

    def _at(self, moment: Moment) -> list[float]:
        if self._time is None:
            return self._strains
        speed = moment.motor_speed_deg_s
        step = max(moment.time_s - self._time, 0.0)
        going = 0.0
        if speed:
            going = math.copysign(1.0, speed)
            step /= self._build_up
        strains = []
        for rate, strain in zip(self._rates, self._strains, strict=True):
            decay = math.exp(-step * rate)
            strains.append(decay * strain + (1.0 - decay) * going)
        return strains
