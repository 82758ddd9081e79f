"""Decision thresholds of the diagnosis in one table, each with its unit and source.

They are passed to a diagnosis and included in its JSON, so a result documents its criteria. A threshold has
no effect at its ``neutral`` value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

FITTED = "tools/fit_probabilities.py"


def _scale(value: float, unit: str, neutral: float, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "neutral": neutral, "source": source})


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Decision thresholds of a diagnosis; `described` returns their units and sources."""

    # Required gain of a cause.
    penalty: float = _scale(
        11.5, "chi square per parameter", 0.0, "Schwarz 1978: the logarithm of 100,000 points"
    )
    enter: float = _scale(
        30.0, "chi square per cause", 0.0, "2 log of the 3e6 places, shapes and kinds that are searched"
    )
    floor_arcsec: float = _scale(0.5, "arcsec at its peak", 0.0, "smaller ones do not matter to an axis")
    rare: float = _scale(
        20.0,
        "samples of 10,000 or more in which an effect exceeds its stated size",
        0.0,
        "a tooth is passed in hundreds, jumps and peaks of a channel are fewer",
    )
    robust: float = _scale(
        25.0, "chi square of block sums", 0.0, "five standard deviations in independent stretches"
    )
    robust_more: float = _scale(
        6.0, "chi square of block sums per further parameter", 0.0, "95 % of chi square of two"
    )

    # Termination and revision of the search.
    few: float = _scale(3.0, "causes", math.inf, "more mean a cause that is not in the catalogue")
    large: float = _scale(4.0, "chi square per point", 1.0, "twice the noise")
    slow: float = _scale(
        0.8,
        "fraction of a large residual that one cause more than `few` may leave",
        math.inf,
        "the fourth partial of a sawtooth leaves 0.78 of what the first three leave",
    )
    leftover: float = _scale(
        2e-5, "fraction of the largest one's chi square", 0.0, "error of a linearisation"
    )
    extrapolated: float = _scale(
        2.0,
        "largest piece over the observed peak",
        math.inf,
        "beyond it pieces cancel, as of an order seen on a short arc",
    )
    wave_share_left: float = _scale(
        0.03,
        "fraction of a wave's squares",
        0.0,
        "a wave that other causes explain to 97 % is not a cause of its own",
    )
    bend: float = _scale(
        0.6,
        "share by which a slope may differ along the path",
        math.inf,
        "a slope that bends is another effect",
    )
    alias: float = _scale(
        0.01, "fraction of the chi square of a cause", 0.0, "a real law differs from its formula by some 7 %"
    )

    # Loops of a different shape, and changes of the model's parts.
    calibrated: float = _scale(
        0.04, "fraction of a coefficient", 0.04, "typical change by temperature and age"
    )
    calibrated_shape: float = _scale(
        0.06,
        "fraction of a width, of an exponent above one",
        0.06,
        "typical change, and a shape is harder to see",
    )
    calibrated_arcsec: float = _scale(0.1, "arcsec at a coefficient's peak", 0.1, "reading of an encoder")
    calibrations: float = _scale(
        4.0, "standard deviations of calibration and fit", 0.0, "6 in 100,000 by chance"
    )

    # Aliases.
    in_step: float = _scale(
        0.85,
        "fraction of a wave's squares",
        2.0,
        "waves a fifth of a period apart explain 0.87 of each other",
    )
    noisy: float = _scale(1.5, "times what a channel's noise costs", 0.0, "that cost is itself estimated")
    # Unexplained residual.
    plain_arcsec: float = _scale(1.0, "arcsec", math.inf, "twice the floor, for a residual without a name")
    near: float = _scale(
        0.4,
        "fraction of the largest piece",
        math.inf,
        "sidebands of a full modulation are a half each, the third partial of a sawtooth is a third",
    )

    # Probability of a finding (`hdbridge.analysis.probability`): fitted to 533 findings of bench plans and
    # everyday records, 391 of them right.
    odds: float = _scale(0.33, "log odds", 0.0, FITTED)
    odds_strength: float = _scale(0.40, "log odds per log of robust evidence over the needed", 0.0, FITTED)
    odds_rank: float = _scale(0.71, "log odds per decade of the largest one's chi square", 0.0, FITTED)
    odds_unexplained: float = _scale(-1.17, "log odds", 0.0, FITTED)
    right: float = _scale(391 / 533, "fraction of the names that the formula is fitted to", 0.5, FITTED)
    surest: float = _scale(0.97, "probability", 1.0, "the rules were made on records that it is fitted to")
    named_from: float = _scale(0.2, "probability", 0.0, "of 29 names below it 7 were right")
    one_way: float = _scale(
        0.6, "probability", 1.0, "without reversals place, speed, torque and time are aliases"
    )
    one_way_repeated: float = _scale(
        0.8, "probability", 1.0, "of the names in 60 records of four equal moves one way 27 of 33 were right"
    )

    def described(self) -> dict[str, dict[str, float | str]]:
        """Returns value, unit and source of each threshold by name, for JSON."""
        return {
            each.name: {
                "value": getattr(self, each.name),
                "unit": each.metadata["unit"],
                "source": each.metadata["source"],
            }
            for each in fields(self)
        }
