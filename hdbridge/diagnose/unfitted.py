"""Is this a model of the axis at all? One without a loop, for an axis that has one, was never fitted."""

from __future__ import annotations

from dataclasses import replace

from hdbridge.effects import Effect, Part
from hdbridge.estimation.hypothesis import Estimator, Hypothesis

MOST = 0.5
"""Share of the squares that the model leaves; a loop that makes up more is most of what is wrong. It decides
a remark, no name."""


def unfitted(estimator: Estimator, effects: tuple[Effect, ...]) -> str:
    """In words, where the model lacks a loop and one makes up most of what it leaves; else empty.

    What else is wrong shows only with the loop in the fit, so nothing that is named without it means much.
    """
    if estimator.data.reversals < 2 or any(each.part is Part.LOOP for each in effects):
        return ""
    plain = estimator.fit(Hypothesis(effects))
    free = estimator.free_loop(plain.hypothesis.start)
    loose = estimator.fit(replace(plain.hypothesis, nuisances=free))
    share = 1.0 - loose.chi_square / max(plain.chi_square, 1e-300)
    if share < MOST:
        return ""
    does = (plain.residual - loose.residual) / estimator.weight
    return (
        f"the model has no elastic loop, and one of {estimator.half_span(does):.3g} arcsec to either side "
        f"makes up {100.0 * share:.0f} % of the squares that it leaves: fit a model first (hdbridge fit), "
        "then diagnose"
    )
