"""A slow loop over the load encoder: takes away what the model leaves of the mean error at rest.

The compensation is feed-forward: a model that has aged leaves an error that no one sees. Where the load
encoder can be believed, this integrates the error (load target less load encoder) and adds to the load
target. It is slow and bounded so that it can do little harm, and gives up what it has where it does harm:

* It integrates at rest only; in motion the error is mostly delay, and the value is held.
* Where the encoder is not believed it fades out. Whether it can be is for others to say (`None`), but what
  it sees at rest it judges itself. An error beyond the loop's own bound is none that it is there for. A load
  does not jump while the axis stands, and a load that does not follow what the loop has added since the axis
  came to rest is not what the encoder shows: in both cases it stays out until somebody has looked (`reset`).

Pure: no clock, no bus.
"""

from __future__ import annotations

import math

from hdbridge.errors import InputError

_SETTLED_S = 0.3
"""At rest it looks on for so long before it acts: the load settles."""
_AVERAGED_S = 0.05
"""What is measured at rest is averaged over so long."""
_FOLLOWS = 0.5
"""Share of what was added by which the error must have changed at least."""


class LoadLoop:
    """One axis's; one call of `step` per control period."""

    __slots__ = (
        "_average", "_begin_arcsec", "_begin_value", "_doubted", "_gain_step", "_jump", "_maximum",
        "_settled", "_share", "_slew_step", "_standing", "_value",
    )  # fmt: skip

    def __init__(self, gain_1_s: float, maximum_arcsec: float, slew_arcsec_s: float, period_s: float) -> None:
        """``gain_1_s``: share of the error that is taken away per second; ``maximum_arcsec``: bound of the
        value, to be well above four times the load encoder's noise.

        InputError for numbers that are not finite and above 0, and a gain so high that it would swing.
        """
        for name, number in (
            ("gain_1_s", gain_1_s),
            ("maximum_arcsec", maximum_arcsec),
            ("slew_arcsec_s", slew_arcsec_s),
            ("period_s", period_s),
        ):
            if not (math.isfinite(number) and number > 0.0):
                raise InputError(f"load loop: {name} is {number!r}; expected a finite number above 0")
        if gain_1_s * _AVERAGED_S > 0.25:
            raise InputError(
                f"load loop: gain_1_s is {gain_1_s:g}; expected at most {0.25 / _AVERAGED_S:g}: it is "
                "meant to be slower than the drive and the gear settle"
            )
        self._gain_step = gain_1_s * period_s
        self._maximum = maximum_arcsec
        self._slew_step = slew_arcsec_s * period_s
        self._jump = 0.25 * maximum_arcsec
        """How far the error may be from its average at rest, and how far the loop goes without an answer."""
        self._share = min(period_s / _AVERAGED_S, 1.0)
        self._settled = max(math.ceil(_SETTLED_S / period_s), 1)
        self._value = self._average = self._begin_arcsec = self._begin_value = 0.0
        self._standing = 0
        """Periods that it has stood still."""
        self._doubted = False

    @property
    def value_arcsec(self) -> float:
        """What it adds to the load target."""
        return self._value

    @property
    def doubted(self) -> bool:
        """Whether it has stopped believing what the encoder shows, until `reset`."""
        return self._doubted

    def reset(self, value_arcsec: float = 0.0) -> None:
        """Begin again, at this value (what the load target has in it already, so that nothing jumps)."""
        if not math.isfinite(value_arcsec):
            raise InputError(f"load loop: a value of {value_arcsec!r} arcsec; expected a finite number")
        self._value = min(max(value_arcsec, -self._maximum), self._maximum)
        self._doubted = False
        self._restart()

    def step(self, error_arcsec: float | None, moving: bool) -> float:
        """One period: arcsec to add to the load target.

        ``error_arcsec`` is the load target (without what this has added) less the load encoder; None where
        the encoder is not believed. It changes by at most the slew limit.
        """
        if error_arcsec is None or math.isnan(error_arcsec):
            self._restart()
            return self._fade()
        if moving:
            self._restart()
            return self._fade() if self._doubted else self._value
        if self._doubted:
            return self._fade()
        self._standing += 1
        if self._standing <= self._settled:
            # An average of what came last; what came first was still settling.
            self._average += max(self._share, 1.0 / self._standing) * (error_arcsec - self._average)
            self._begin_arcsec = self._average
            return self._value
        jumped = abs(error_arcsec - self._average) > self._jump
        self._average += self._share * (error_arcsec - self._average)
        added = self._value - self._begin_value
        answered = self._begin_arcsec - self._average
        unanswered = abs(added) > self._jump and answered * added < _FOLLOWS * added * added
        if jumped or unanswered:
            self._doubted = True
        if self._doubted or abs(error_arcsec) > self._maximum:
            return self._fade()
        step = min(max(self._gain_step * error_arcsec, -self._slew_step), self._slew_step)
        self._value = min(max(self._value + step, -self._maximum), self._maximum)
        return self._value

    def _fade(self) -> float:
        value, step = self._value, self._slew_step
        self._value = 0.0 if abs(value) <= step else value - math.copysign(step, value)
        return self._value

    def _restart(self) -> None:
        """What was seen at rest does not count any more."""
        self._standing = 0
        self._average = self._begin_arcsec = 0.0
        self._begin_value = self._value
