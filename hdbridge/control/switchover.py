"""Changes the model in motion without a jump of the target; used in place of a single `Compensation`.

During a change both models follow the issued angle. The correction is blended from the old model to the new
one with a weight that rises over the ramp time, within the slew limit and the caps. The new model begins on
the last issued path, which also determines the state of its hysteresis.

A scheme (none, synchronous, hysteresis, both) is a model with a different set of effects, so schemes are
switched in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from hdbridge.axis.effects import Channel, Moment
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.compensation import Compensation
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG

_NOWHERE = Moment()


class Correction:
    """Compensation that can be exchanged for another; it has the same interface.

    Without a change, ``command`` and ``hold`` are those of the compensation itself, at no additional cost.
    During a change these attributes hold different functions, so they must be looked up in each cycle.
    """

    command: Callable[[float, Moment], float]
    """Returns the motor target in degrees for this cycle's load target (`Compensation.command`)."""
    hold: Callable[[float, Moment], float]
    """Returns the motor target with the correction frozen (`Compensation.hold`); a change of model pauses."""

    def __init__(self, first: Compensation) -> None:
        self._now = first
        self._new: Compensation | None = None
        self._weight = 0.0
        """Weight of the new compensation during a change."""
        self._limited = 0
        self.command, self.hold = first.command, first.hold

    @property
    def model(self) -> TransmissionModel:
        """Model in force, or in force after the change."""
        return (self._new or self._now).model

    @property
    def changing(self) -> bool:
        return self._new is not None

    @property
    def needs(self) -> frozenset[Channel]:
        """Channels required in a `Moment`; those of both models during a change."""
        return self._now.needs if self._new is None else self._now.needs | self._new.needs

    @property
    def correction_arcsec(self) -> float:
        """Correction in force, arcsec at the load."""
        return self._now.correction_arcsec

    @property
    def predicted_arcsec(self) -> float:
        """Model's error at the last motor target, arcsec, regardless of the weight.

        During a change it passes from the error of the old model to that of the new model.
        """
        now = self._now.predicted_arcsec
        return now if self._new is None else now + self._weight * (self._new.predicted_arcsec - now)

    @property
    def memory_known(self) -> bool:
        return self._now.memory_known and (self._new is None or self._new.memory_known)

    @property
    def weight(self) -> float:
        return self._now.weight

    @property
    def limited(self) -> int:
        return self._limited + self._now.limited

    def change(self, new: Compensation) -> None:
        """Changes to a new compensation from the next command on; `changing` is True until that is complete.

        Raises InputError, without any effect, for a different gear ratio and while a change is under way.
        """
        if self._new is not None:
            raise InputError("a change of the model is under way: wait until it is done")
        if not math.isclose(new.model.ratio, self._now.model.ratio, rel_tol=1e-9):
            raise InputError(
                f"{new.model.path or 'the new model'}: a model of a gear with ratio {new.model.ratio:g}; "
                f"this axis runs with {self._now.model.ratio:g}: use a model of this gear"
            )
        self._new = new
        self._weight = 0.0
        self.command = self._first_blended

    def set_known_channels(self, channels: frozenset[Channel]) -> None:
        for each in self._all():
            each.set_known_channels(channels)

    def engage(self) -> None:
        for each in self._all():
            each.engage()

    def disengage(self) -> None:
        for each in self._all():
            each.disengage()

    def reset(self, motor_deg: float, moment: Moment = _NOWHERE) -> None:
        """Restarts at ``motor_deg``, at standstill and without a correction; completes a change at once."""
        if self._new is not None:
            self._new.take_over(self._now, moment)
            self._done(self._new)
        self._now.reset(motor_deg, moment)

    def _all(self) -> tuple[Compensation, ...]:
        return (self._now,) if self._new is None else (self._now, self._new)

    def _first_blended(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        """Runs the first command of a change, which provides the moment for `Compensation.take_over`."""
        assert self._new is not None
        self._new.take_over(self._now, moment)
        self.command, self.hold = self._blended, self._held
        return self._blended(load_deg, moment)

    def _blended(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        old, new = self._now, self._new
        assert new is not None
        weight = self._weight = min(self._weight + new.ramp_step, 1.0)
        last, slew = old.correction_arcsec, min(old.step_arcsec, new.step_arcsec)
        before, after = old.wanted(load_deg, moment), new.wanted(load_deg, moment)
        wanted = before + weight * (after - before)
        correction = min(max(wanted, last - slew), last + slew)
        if correction != wanted:
            self._limited += 1
        motor_deg = old.model.ratio * (load_deg - correction / ARCSEC_PER_DEG)
        self._issue(motor_deg, correction, moment)
        if weight == 1.0 and abs(correction) <= new.maximum_arcsec:
            self._done(new)
        return motor_deg

    def _held(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        correction = self._now.correction_arcsec
        motor_deg = self._now.model.ratio * (load_deg - correction / ARCSEC_PER_DEG)
        self._issue(motor_deg, correction, moment)
        return motor_deg

    def _issue(self, motor_deg: float, correction_arcsec: float, moment: Moment) -> None:
        for each in self._all():
            each.issued(motor_deg, correction_arcsec, moment)

    def _done(self, new: Compensation) -> None:
        self._limited += self._now.limited
        self._now, self._new = new, None
        self._weight = 0.0
        self.command, self.hold = new.command, new.hold
