"""How sure a name is: from the block-robust evidence, the held-out gain and the margin over the next
rival.
"""

from __future__ import annotations

import math


def probability(robust: float, needed: float, recovered: float, margin: float, gain: float) -> float:
    """Probability that a named cause (or one of its aliases) is there.

    ``margin`` is the chi square by which the best rival outside the aliases is worse, ``gain`` the cause's
    own. The
    form is a logistic one; its coefficients are set on records of known causes (tools/diagnose_trials.py).
    """
    strength = math.log(max(robust, 1e-9) / needed)
    ahead = margin / max(gain, 1e-9)
    score = 1.2 + 1.6 * strength + 3.0 * min(ahead, 0.6) + (0.0 if recovered > 0.0 else -2.5)
    return min(max(1.0 / (1.0 + math.exp(-score)), 0.02), 0.995)
