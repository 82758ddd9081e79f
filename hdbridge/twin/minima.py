"""Places where a fit may have a minimum of its own, beside the one that it has come to.

A resonance that is off by more than its width makes things worse before it makes them better. Filter and
dead time share a lag, the feed-forwards of motor and load share a torque, the motor's inertia shows only in
the first milliseconds of a demand, as these do, and while the axis moves two gains stand in for each other:
along each of these a fit comes to rest at several places.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from hdbridge.sim.truth import Truth
from hdbridge.twin.parameters import BY_NAME, Parameter, at_coordinates, coordinates, with_values

FILTER, DEAD_TIME = BY_NAME["command filter"], BY_NAME["servo dead time"]
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
    step_ms, now = truth.substep_ms, _substep(truth)
    most_ms = min(_lag_ms(truth) - 2.0 * FILTER.least, DEAD_TIME.most)
    places = range(int(most_ms / step_ms + 0.5))
    return [_with_dead_time(truth, (each + 0.5) * step_ms) for each in places if each != now]


def neighbours(truth: Truth) -> list[Truth]:
    """Those of `delays` whose dead time is a substep shorter or longer."""
    return [each for each in delays(truth) if abs(_substep(each) - _substep(truth)) == 1]


def as_late(truth: Truth, other: Truth, free: Collection[Parameter]) -> Truth:
    """The truth with the whole lag of another one, by whichever of filter and dead time is free."""
    lag_ms, own = _lag_ms(other), truth.servo
    if FILTER in free:
        return with_values(truth, {FILTER.name: max(0.5 * (lag_ms - own.dead_time_ms), FILTER.least)})
    if DEAD_TIME in free:
        dead_time_ms = max(lag_ms - 2.0 * own.command_filter_ms, DEAD_TIME.least)
        return with_values(truth, {DEAD_TIME.name: dead_time_ms})
    return truth


def inertias(truth: Truth) -> list[Truth]:
    """The truth with other inertias of the motor; a spring too stiff for the time step becomes softer."""
    motor = [BY_NAME["motor inertia"]]
    (now,) = coordinates(truth, motor)
    return [at_coordinates(truth, motor, [now + math.log(factor)]) for factor in INERTIA_FACTORS]


def _substep(truth: Truth) -> int:
    """The number of the substep in which a delayed demand comes."""
    return int(truth.servo.dead_time_ms / truth.substep_ms)


def _lag_ms(truth: Truth) -> float:
    """What filter and dead time are late by together, at a constant speed."""
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def _with_dead_time(truth: Truth, dead_time_ms: float) -> Truth:
    """The truth with another share of the dead time in its lag."""
    filter_ms = 0.5 * (_lag_ms(truth) - dead_time_ms)
    return with_values(truth, {FILTER.name: filter_ms, DEAD_TIME.name: dead_time_ms})


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
