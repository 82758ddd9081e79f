"""Design-matrix columns of effects, evaluated at all samples and averaged like the observations."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence

import numpy as np

from hdbridge.analysis.linear import side_by_side
from hdbridge.analysis.separable import unit
from hdbridge.axis.effects import Channel, Effect, FloatArray, Motion, Start

KEPT = 64
"""Maximum number of effects whose columns are cached; columns are large."""

Starts = tuple[Start, ...]
"""Elastic states at the start of each motion."""


class Regressors:
    """Computes and caches the columns of effects along consecutive motions; rows are means over samples."""

    def __init__(
        self, motions: Sequence[Motion], mean: Callable[[FloatArray], FloatArray], rows: int
    ) -> None:
        """``mean`` averages a per-sample quantity, (n,) or (n, p), over each of the ``rows``."""
        self.motions = tuple(motions)
        self._mean, self._rows = mean, rows
        self._constant: dict[object, FloatArray] = {}
        self._recent: OrderedDict[tuple[Effect, Starts], FloatArray] = OrderedDict()

    def columns(self, effect: Effect, starts: Starts) -> FloatArray:
        """Returns the columns of an effect, arcsec, shape (rows, p); read-only."""
        if not (effect.shape or effect.carries or effect.curved) and not _counts(effect):
            # These columns are the same in every fit.
            pieces = [self._of_piece(unit(each), starts) for each in effect.pieces()]
            return pieces[0] if len(pieces) == 1 else side_by_side(pieces, self._rows)
        # Columns do not depend on an effect's own coefficients. They do depend on the loop and orders that
        # an effect contains as fields.
        key = (unit(effect), starts)
        if key in self._recent:
            self._recent.move_to_end(key)
            return self._recent[key]
        self._recent[key] = columns = self._made(effect, starts)
        if len(self._recent) > KEPT:
            self._recent.popitem(last=False)
        return columns

    def predict(self, effects: Sequence[Effect], starts: Starts) -> FloatArray:
        """Returns the transmission error due to all effects, arcsec, shape (rows,)."""
        parts = (self.columns(each, starts) @ each.coefficients() for each in effects)
        return np.asarray(sum(parts, start=np.zeros(self._rows)))

    def predicted(self, effects: Sequence[Effect], starts: Starts) -> FloatArray:
        """Returns the transmission error due to all effects at each sample, arcsec, shape (n,)."""
        along = zip(self.motions, starts, strict=True)
        return np.concatenate(
            [sum((each.predict(*one) for each in effects), start=np.zeros(len(one[0]))) for one in along]
        )

    def along(self, motions: Sequence[Motion]) -> None:
        """Replaces the motions by others that differ only in the predicted load angle."""
        self.motions = tuple(motions)
        for each in [each for each in self._recent if _counts(each[0])]:
            del self._recent[each]

    def _of_piece(self, piece: Effect, starts: Starts) -> FloatArray:
        key = (piece, starts if piece.tracker().memory_deg else None)
        if key not in self._constant:
            self._constant[key] = self._made(piece, starts)
        return self._constant[key]

    def _made(self, effect: Effect, starts: Starts) -> FloatArray:
        parts = [effect.columns(*one) for one in zip(self.motions, starts, strict=True)]
        return self._mean(parts[0] if len(parts) == 1 else np.concatenate(parts))


def _counts(effect: Effect) -> bool:
    """Returns True if the effect depends on the predicted load angle, which a fit updates."""
    return Channel.LOAD_ANGLE in effect.channels
