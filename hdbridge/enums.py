"""Enumerations that files, messages to clients and the rest of the product share."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hdbridge.axis.model import TransmissionModel


class PowerState(StrEnum):
    """CiA 402 state, from the drive's statusword."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"
    """No statusword yet, or one that matches no state."""


class Scheme(StrEnum):
    """Parts of the model that compensate."""

    NONE = "none"
    SYNCHRONOUS = "synchronous"
    HYSTERESIS = "hysteresis"
    BOTH = "both"
    EXTENDED = "extended"
    """Whole model, including effects added by a diagnosis."""

    def of(self, model: TransmissionModel) -> TransmissionModel:
        """Returns the model with only this scheme's effects."""
        match self:
            case Scheme.NONE:
                return model.only(())
            case Scheme.SYNCHRONOUS | Scheme.HYSTERESIS:
                return model.only((self.value,))
            case Scheme.BOTH:
                return model.only(("synchronous", "hysteresis"))
            case Scheme.EXTENDED:
                return model

    @staticmethod
    def offered_by(model: TransmissionModel) -> tuple[Scheme, ...]:
        """Returns the article's four schemes, and `EXTENDED` if the model has more than their two parts."""
        four = (Scheme.NONE, Scheme.SYNCHRONOUS, Scheme.HYSTERESIS, Scheme.BOTH)
        more = any(each.name not in {"synchronous", "hysteresis"} for each in model.effects)
        return (*four, Scheme.EXTENDED) if more else four


class AdaptationMode(StrEnum):
    """Mode in which the model's parameters follow the load encoder."""

    OFF = "off"
    OBSERVE = "observe"
    """Estimates and reports changes without applying them."""
    ON = "on"
