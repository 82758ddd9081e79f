"""Decision thresholds of the diagnosis in one table, each with its unit and source.

They are passed to a diagnosis and included in its JSON, so a result documents its criteria.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

FITTED = "tools/fit_probabilities.py"


def _scale(value: float, unit: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "source": source})


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Decision thresholds of a diagnosis; `described` returns their units and sources."""

    # Required gain of a cause.
    penalty: float = _scale(11.5, "chi square per parameter", "Schwarz 1978: the logarithm of 100,000 points")
    enter: float = _scale(
        30.0, "chi square per cause", "2 log of the 3e6 places, shapes and kinds that are searched"
    )
    floor_arcsec: float = _scale(0.5, "arcsec at its peak", "smaller ones do not matter to an axis")
    rare: float = _scale(
        20.0,
        "samples of 10,000 or more in which an effect exceeds its stated size",
        "a tooth is passed in hundreds, jumps and peaks of a channel are fewer",
    )
    robust: float = _scale(
        25.0, "chi square of block sums", "five standard deviations in independent stretches"
    )
    robust_more: float = _scale(
        6.0, "chi square of block sums per further parameter", "95 % of chi square of two"
    )

    # Termination and revision of the search.
    few: float = _scale(3.0, "causes", "more mean a cause that is not in the catalogue")
    large: float = _scale(4.0, "chi square per point", "twice the noise")
    slow: float = _scale(
        0.8,
        "fraction of a large residual that one cause more than `few` may leave",
        "the fourth partial of a sawtooth leaves 0.78 of what the first three leave",
    )
    leftover: float = _scale(2e-5, "fraction of the largest one's chi square", "error of a linearisation")
    extrapolated: float = _scale(
        2.0,
        "largest piece over the observed peak",
        "beyond it pieces cancel, as of an order seen on a short arc",
    )
    wave_share_left: float = _scale(
        0.03,
        "fraction of a wave's squares",
        "a wave that other causes explain to 97 % is not a cause of its own",
    )
    bend: float = _scale(
        0.6,
        "share by which a slope may differ along the path",
        "a slope that bends is another effect",
    )
    alias: float = _scale(
        0.01, "fraction of the chi square of a cause", "a real law differs from its formula by some 7 %"
    )

    # Loops of a different shape, and changes of the model's parts.
    calibrated: float = _scale(0.04, "fraction of a coefficient", "typical change by temperature and age")
    calibrated_shape: float = _scale(
        0.06,
        "fraction of a width, of an exponent above one",
        "typical change, and a shape is harder to see",
    )
    calibrated_arcsec: float = _scale(0.1, "arcsec at a coefficient's peak", "reading of an encoder")
    calibrations: float = _scale(4.0, "standard deviations of calibration and fit", "6 in 100,000 by chance")

    # Aliases.
    in_step: float = _scale(
        0.85,
        "fraction of a wave's squares",
        "waves a fifth of a period apart explain 0.87 of each other",
    )
    noisy: float = _scale(1.5, "times what a channel's noise costs", "that cost is itself estimated")
    # Unexplained residual.
    plain_arcsec: float = _scale(1.0, "arcsec", "twice the floor, for a residual without a name")
    near: float = _scale(
        0.4,
        "fraction of the largest piece",
        "sidebands of a full modulation are a half each, the third partial of a sawtooth is a third",
    )

    # Probability of a finding (`hdbridge.analysis.probability`): fitted to 533 findings of bench plans and
    # everyday records, 391 of them right.
    odds: float = _scale(0.33, "log odds", FITTED)
    odds_strength: float = _scale(0.40, "log odds per log of robust evidence over the needed", FITTED)
    odds_rank: float = _scale(0.71, "log odds per decade of the largest one's chi square", FITTED)
    odds_unexplained: float = _scale(-1.17, "log odds", FITTED)
    right: float = _scale(391 / 533, "fraction of the names that the formula is fitted to", FITTED)
    surest: float = _scale(0.97, "probability", "the rules were made on records that it is fitted to")
    named_from: float = _scale(0.2, "probability", "of 29 names below it 7 were right")
    one_way: float = _scale(0.6, "probability", "without reversals place, speed, torque and time are aliases")
    one_way_repeated: float = _scale(
        0.8, "probability", "of the names in 60 records of four equal moves one way 27 of 33 were right"
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
