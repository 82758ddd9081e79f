"""The branch of an elastic loop as parallel sliders: how a curve becomes springs that slip.

A loop whose branches are one curve scaled by two (Masing) is the sum of elements that each yield along a
spring and then slip. Elements at the nodes of the curve make it exact there and straight between.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hdbridge.effects.base import FloatArray
from hdbridge.effects.elastic_loop import rise


def branch(exponent: float, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Points of the branch g(xi), dense where it bends: xi from 0 to 1 and g, shape (nodes + 1,) each."""
    xi = np.linspace(0.0, 1.0, nodes + 1) ** (2.0 / min(max(exponent - 1.0, 0.2), 1.0))
    return xi, rise(xi, exponent)


def elements(travel: FloatArray, height: FloatArray) -> list[tuple[float, float]]:
    """Limit and travel to slipping of each element of a concave curve through the origin.

    The curve is what the elements give together from a state of rest; its points are in order, the first is
    (0, 0), beyond the last it is flat.
    """
    slopes = [(h1 - h0) / (t1 - t0) for (t0, h0), (t1, h1) in pairwise(zip(travel, height, strict=True))]
    return [
        (float((slope - after) * end), float(end))
        for slope, after, end in zip(slopes, [*slopes[1:], 0.0], travel[1:], strict=True)
        if slope > after and end > 0.0
    ]
