"""The next experiment: the shortest that separates what the data leave open."""

from __future__ import annotations

from typing import Final, NamedTuple

from hdbridge.effects import CATALOGUE


class Experiment(NamedTuple):
    """One entry of the menu."""

    minutes: float
    words: str


_PAIRS: Final[dict[frozenset[str], Experiment]] = {
    frozenset({"load_order", "compliance"}): Experiment(
        5,
        "take the mass off or turn it by 90 deg, sweep one load turn both ways: a wind-up goes with it",
    ),
    frozenset({"motor_order", "motor_encoder_eccentricity"}): Experiment(
        15,
        "re-clock the motor encoder by 90 deg on its shaft and sweep ten motor turns: its part turns with it",
    ),
    frozenset({"ratio_error", "load_order"}): Experiment(
        6, "sweep two whole load turns both ways: a ramp goes on, a load order comes back"
    ),
    frozenset({"zero_drift", "count_loss"}): Experiment(
        4, "return to one reference pose every half minute: a step has happened, a drift goes on"
    ),
    frozenset({"channel_skew", "velocity_windup"}): Experiment(
        2, "sweep three motor turns both ways at three speeds: skew is a straight line, drag bends"
    ),
    frozenset({"channel_skew", "inertial_windup"}): Experiment(
        2, "sweep at constant speed both ways: a skew stays, inertia is silent"
    ),
    frozenset({"backlash", "hysteresis_parameters"}): Experiment(
        3, "repeat the small reversals with a load torque to one side: it holds a gap closed"
    ),
    frozenset({"backlash", "hysteresis_memory"}): Experiment(
        3, "reversals of 0.1 to 2 deg of the motor, each beyond where the last one turned"
    ),
    frozenset({"zero_drift", "creep"}): Experiment(
        10, "stand still for ten minutes after a move in each direction: creep takes the direction's sign"
    ),
    frozenset({"zero_drift", "ratio_error"}): Experiment(
        3,
        "sweep a load turn forth and back at twice the speed: a ramp goes with the angle, a drift with time",
    ),
    frozenset({"vibration", "motor_order"}): Experiment(
        2, "stand still for a minute, then sweep at two speeds: a vibration keeps its frequency"
    ),
    frozenset({"torque_modulation", "amplitude_drift"}): Experiment(
        10, "the same motor turns under two torques at one temperature"
    ),
}


def next_experiment(cause: str, aliases: tuple[str, ...]) -> str:
    """The shortest experiment that tells the cause from its aliases; without aliases, the one that
    confirms it.
    """
    known = [_PAIRS[frozenset({cause, each})] for each in aliases if frozenset({cause, each}) in _PAIRS]
    if known:
        return min(known).words
    if cause in CATALOGUE:
        return CATALOGUE[cause].about.experiment
    return ""


def for_unexplained(lives_in: str) -> str:
    """How to look closer at something unexplained."""
    if "load angle" in lives_in or lives_in == "position":
        return "two slow load turns both ways, then again with the load encoder re-clocked by 90 deg"
    if "reversal" in lives_in:
        return "nested reversals from 0.1 deg up, each beyond where the last one turned, slowly"
    if "motor angle" in lives_in:
        return "a slow sweep over ten motor turns both ways, at two places of the load"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "the same way at three speeds and two accelerations, with rests of a minute between"
    if "torque" in lives_in:
        return "the same sweep with the load's mass at two places"
    return "an hour of returns to one reference pose, with the temperature recorded"
