"""Change of the elastic loop: offset, width or exponent differ from those in the model."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Loop, loop_of
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Part, Sum, Tracker
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.motion import FloatArray, Motion, Start


class HysteresisParameters(Effect):
    """Loop with new parameters minus the loop with the model's parameters (`base`).

    If a model is extended by this cause, the new parameters are written into the model's loop
    (`combine.extended`), and no effect is added. A separate effect would predict the same error, but a
    difference of loops falls infinitely steeply where the old loop rises, so the compensation could not
    invert it.
    """

    name = "hysteresis_parameters"
    about = Cause(
        title="changed hysteresis loop",
        subject="hysteresis",
        equation="H(offset, width, exponent) - H(the model's offset, width, exponent)",
        signature="part of a loop remains after each reversal, or a constant distance between the two "
        "directions",
        consequence="the compensation still uses the old loop",
        remedy="calibrate again; a smaller offset suggests lost preload, a larger one more friction (cold, "
        "dry, misaligned)",
        experiment="slow sines of several amplitudes, some smaller than the width",
        aliases=("backlash", "hysteresis_memory", "direction_phase"),
        source="the difference of two loops of one law",
        size="5-30 % of the offset",
    )
    compensable = Compensable(True, "by new parameters of the model's loop")
    changes = Part.LOOP
    shape = Hysteresis.shape

    base: Loop = Field(description="the model's loop")
    offset_arcsec: float = Field(ge=-3600, le=3600, description="new offset; negative if the load lags")
    width_deg: float = Field(gt=0, le=3600, description="new width")
    exponent: float = Field(gt=1, le=6, description="new exponent")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields the model's loop with a larger width."""
        if any(each.part is Part.LOOP for each in base):
            loop = loop_of(base)
            now = loop.model_dump(exclude={"memory"}) | {"width_deg": 1.6 * loop.width_deg}
            yield cls(base=loop, **now)

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:
        if before.part is not Part.LOOP or not isinstance(now, type(before)):
            return None
        return cls(base=loop_of([before]), **loop_of([now]).model_dump(exclude={"memory"}))

    def found_in(self, effects: Sequence[Effect]) -> Effect:
        """Returns the change from this effect's ``base`` to the loop among ``effects``."""
        return self.model_copy(update=loop_of(effects).model_dump(exclude={"memory"}))

    def changed(self) -> Loop:
        """Returns the loop with the new parameters."""
        return self.base.model_copy(
            update={each: getattr(self, each) for each in ("offset_arcsec", "width_deg", "exponent")}
        )

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        return self.changed().law().predict(motion, start) - self.base.law().predict(motion, start)

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        negative = self.base.model_copy(update={"offset_arcsec": -self.base.offset_arcsec})
        return Sum([each.law().tracker(start) for each in (self.changed(), negative)])

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the new and the old loop for an offset of 1 arcsec, shape (n, 2)."""
        new, old = self.changed().law(), self.base.law()
        return np.hstack([new.columns(motion, start), old.columns(motion, start)])

    def coefficients(self) -> FloatArray:
        """Returns the new offset and the negative old offset, arcsec."""
        return np.array([self.offset_arcsec, -self.base.offset_arcsec])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with new offsets and, if given, a new width and exponent of the changed loop."""
        base = self.base.model_copy(update={"offset_arcsec": -float(coefficients[1])})
        update = {"offset_arcsec": float(coefficients[0]), "base": base, **dict(shape or {})}
        return self.model_copy(update=update)

    def bound_arcsec(self) -> float:
        return abs(self.offset_arcsec) + abs(self.base.offset_arcsec)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns infinity if a loop that falls contributes to the difference, else 0.

        A subtracted leading loop falls infinitely steeply after a reversal, and so does an added lagging
        loop.
        """
        return math.inf if self.base.offset_arcsec > 0.0 or self.offset_arcsec < 0.0 else 0.0

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        loop = loop_of(base)
        changed = {**loop.model_dump(exclude={"memory"}), "offset_arcsec": 1.2 * loop.offset_arcsec}
        return {"base": loop, **changed}
