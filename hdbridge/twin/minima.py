"""Places where a fit may have a minimum of its own, beside the one that it has come to.

A resonance that is off by more than its width makes things worse before it makes them better. Filter and
dead time share a lag, the feed-forwards of motor and load share a torque, a lighter motor answers a shorter
lag, and while the axis moves two gains stand in for each other: along each of these a fit comes to rest at
several places.
"""

from __future__ import annotations

import math

from hdbridge.sim.truth import Truth
from hdbridge.twin.parameters import with_values

FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Where a resonance of the load is looked for: a fit finds only the nearest of its minima."""
FILTER_SHARES = (0.25, 0.5, 0.75, 0.9)
"""Shares of the lag that may be the command filter's, as long as nothing else is known."""
INERTIA_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Factors of the motor's inertia, which shows only in the first milliseconds of each new demand."""


def elsewhere(truth: Truth, usual: Truth) -> tuple[list[Truth], ...]:
    """The truth at other places, by what is other there; ``usual`` is where the fit began."""
    return springs(truth), delays(truth), feedforwards(truth, usual), inertias(truth)


def springs(truth: Truth) -> list[Truth]:
    """The truth with springs at which the load resonates elsewhere, as far as its time step resolves them."""
    inertia, now = truth.load_.whole_inertia_kg_m2, truth.gear.stiffness_nm_per_rad
    found = []
    for hz in FREQUENCIES_HZ:
        stiffness = inertia * (math.tau * hz) ** 2
        damping = truth.gear.damping_nm_s_per_rad * math.sqrt(stiffness / now)
        if stiffness < 0.9 * truth.highest_stiffness_nm_per_rad:
            found.append(with_values(truth, {"gear stiffness": stiffness, "gear damping": damping}))
    return found


def lags(truth: Truth) -> list[Truth]:
    """The truth with other shares of command filter and dead time in the same lag."""
    return [_with_dead_time(truth, (1.0 - share) * _lag_ms(truth)) for share in FILTER_SHARES]


def delays(truth: Truth) -> list[Truth]:
    """The truth with a dead time in each other one of the substeps that the lag has room for.

    The demand turns where a cycle begins, and a torque lasts a substep. A turn that comes within one is seen
    in two halves, which is how a filter shows it too: between two whole numbers of substeps the dead time
    has a minimum of its own.
    """
    step_ms = truth.substep_ms
    now, most = int(truth.servo.dead_time_ms / step_ms), int(_lag_ms(truth) / step_ms - 0.5)
    return [_with_dead_time(truth, (each + 0.5) * step_ms) for each in range(most + 1) if each != now]


def neighbours(truth: Truth) -> list[Truth]:
    """Those of `delays` whose dead time is a substep shorter or longer."""
    near_ms = 1.5 * truth.substep_ms + 1e-9
    now_ms = (int(truth.servo.dead_time_ms / truth.substep_ms) + 0.5) * truth.substep_ms
    return [each for each in delays(truth) if abs(each.servo.dead_time_ms - now_ms) < near_ms]


def inertias(truth: Truth) -> list[Truth]:
    """The truth with other inertias of the motor, and all else as it is."""
    now = truth.motor.inertia_kg_m2
    return [with_values(truth, {"motor inertia": factor * now}) for factor in INERTIA_FACTORS]


def _lag_ms(truth: Truth) -> float:
    """What filter and dead time are late by together, at a constant speed."""
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def _with_dead_time(truth: Truth, dead_time_ms: float) -> Truth:
    """The truth with another share of the dead time in its lag."""
    filter_ms = 0.5 * (_lag_ms(truth) - dead_time_ms)
    return with_values(truth, {"command filter": filter_ms, "servo dead time": dead_time_ms})


def feedforwards(truth: Truth, usual: Truth) -> list[Truth]:
    """The truth with the load's feed-forward at other frequencies, and its usual share of both inertias'."""
    servo, load, there = truth.servo, truth.servo.load_feedforward, usual.servo.load_feedforward
    if load is None or there is None:
        return []
    both = servo.inertia_feedforward_kg_m2 + load.inertia_kg_m2
    share = there.inertia_kg_m2 / (usual.servo.inertia_feedforward_kg_m2 + there.inertia_kg_m2)
    inertias = {"inertia feed-forward": (1.0 - share) * both, "load feed-forward": share * both}
    return [with_values(truth, {**inertias, "load feed-forward frequency": hz}) for hz in FREQUENCIES_HZ]


def exchanged(truth: Truth) -> Truth:
    """The truth with position gain and the inverse of the integral time exchanged.

    While the axis moves that is the same loop, for only their sum and their product are in its answer: each
    of the two has a minimum of its own.
    """
    servo = truth.servo
    return with_values(
        truth,
        {"position gain": 1e3 / servo.integral_time_ms, "integral time": 1e3 / servo.position_gain_per_s},
    )
