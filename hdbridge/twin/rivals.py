"""Whether a recording distinguishes a twin from a rival: what the rival leaves more, against its scatter.

Both leave something of a recording. By chance what the twin leaves has a share of the change that the
rival makes, and within a leg it goes together: so much the rival's sum of squares scatters. All sets of what
cannot be told apart are made by this one number: a loss that is within that scatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.covariance import information_of, over_legs
from hdbridge.twin.least_squares import Fitted, fitted_rows, legs_of_rows, solve, told
from hdbridge.twin.minima import as_late
from hdbridge.twin.misfit import counted
from hdbridge.twin.parameters import Parameter, at_coordinates, coordinates
from hdbridge.twin.replays import Replays

FALSE_ALARM = 0.02
"""Probability with which a simulation that is right has any cause named."""
STEPS = 6
"""Most steps of a rival's fit, which begins where the slopes of the twin's own fit lead. A rival that has not
reached its minimum loses to the twin by that alone, and a cause is named that is none."""


def told_apart(left: FloatArray, change: FloatArray, legs: FloatArray) -> bool:
    """Whether a rival leaves more than chance would have it.

    ``left`` is what the twin leaves, by row, in units of the noise; ``change`` what the rival leaves more;
    ``legs`` the number of each row's leg.
    """
    loss = float(change @ (change + 2.0 * left))
    within = over_legs((left * change)[:, None], legs)
    white = max(1.0, float(left @ left) / max(len(left), 1)) * float(change @ change)
    scatter = 2.0 * math.sqrt(max(float(np.sum(np.square(within))), white))
    return loss > -float(ndtri(FALSE_ALARM)) * scatter


def put_back(start: Truth, truth: Truth, own: Sequence[Parameter]) -> Truth:
    """A truth with these parameters where they were."""
    return at_coordinates(truth, own, coordinates(start, own))


def without(
    replays: Replays, start: Truth, fitted: Fitted, own: Sequence[Parameter], moved: Sequence[Parameter]
) -> Truth:
    """The best rival in which these parameters are where they were: all others may make up for it.

    It is fitted from where the slopes of the twin's fit lead, from where only the ``moved`` ones are as in
    the twin, or from where filter or dead time makes up for the other, whichever is nearest: what makes up
    for each other may be far from the twin, and slopes do not lead from one substep into another.
    """
    free = [number for number, each in enumerate(fitted.parameters) if each not in own]
    back = [number for number, each in enumerate(fitted.parameters) if each in own]
    others = tuple(fitted.parameters[number] for number in free)
    before = put_back(start, fitted.truth, own)
    if not others:
        return before
    off = np.array(coordinates(before, own)) - fitted.place[back]
    slopes, spread = fitted.jacobian[:, free], np.array([each.spread for each in others])
    along = np.linalg.solve(information_of(slopes, spread), slopes.T @ (fitted.jacobian[:, back] @ off))
    low, high = np.array([each.bounds for each in others]).T
    led = at_coordinates(before, others, np.clip(fitted.place[free] - along, low, high).tolist())
    kept = [coordinates(fitted.truth if each in moved else start, [each])[0] for each in others]
    begun = [led, at_coordinates(before, others, kept), as_late(before, fitted.truth, others)]
    rows = fitted_rows(replays.data)
    costs = [float(np.sum(np.square(told(each, fitted.scales, rows)))) for each in replays(begun)]
    near = replace(fitted, parameters=others, jacobian=slopes)
    prior, nearest = np.array(coordinates(start, others)), begun[int(np.argmin(costs))]
    return solve(replays, nearest, others, prior, STEPS, known=fitted.scales, near=near).truth


def held_out(replays: Replays, found: dict[str, FloatArray], fitted: Fitted) -> tuple[FloatArray, FloatArray]:
    """The scaled residuals on legs that the fit has not seen, softened, with the number of each one's leg.

    On all legs where none was held out.
    """
    data = replays.data
    out = data.out if data.out.any() else np.ones(len(data.out))
    rows = np.concatenate([each * out > 0.0 for each in counted(data).values()])
    return told(found, fitted.scales, rows), legs_of_rows(data, rows)
