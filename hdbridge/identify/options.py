"""What an identification may be told."""

from __future__ import annotations

from dataclasses import dataclass

from hdbridge.effects import USUAL_LOOP, Effect, Start
from hdbridge.model import TransmissionModel


@dataclass(frozen=True, slots=True)
class FitOptions:
    """All have defaults that suit the bench's own recordings."""

    effects: tuple[Effect, ...] = (USUAL_LOOP,)
    """Fitted in addition to the ripple. Where data cannot say, their shapes stay as given here."""
    highest_order: int = 24
    """Motor orders up to this are looked for."""
    load_orders: int = 4
    """Orders of the load turn and of the flexspline that are fitted in addition to the model if they show."""
    family_wise: float = 0.01
    """Chance that noise alone puts any order in."""
    smallest_arcsec: float = 0.1
    """Orders below this are left out however certain they are."""
    start: Start | None = None
    """Elastic state at the first sample: `Start.FORWARD` after the bench's pre-conditioning; None: by fit."""
    active: TransmissionModel | None = None
    """The model that the new one has to beat, and whose shapes it falls back on."""

    def prototype(self, effect: Effect) -> Effect:
        """The active model's effect of the same name, else the effect."""
        active = self.active.effects if self.active else ()
        return next((each for each in active if each.name == effect.name), effect)
