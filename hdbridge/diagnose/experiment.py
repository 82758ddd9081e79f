"""The next experiment: the shortest that separates what the data leave open.

Two menus. `next_experiment` and `for_unexplained` say in words what would distinguish a cause from its
look-alikes, also what only a person can do (move a mass, re-clock an encoder). `machine_plans` are the
experiments that the axis can do by itself; which of them separates a pair is not written here but predicted
(`hdbridge.diagnose.planned`).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from hdbridge.effects import CATALOGUE
from hdbridge.procedures.plan import Plan


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


def _sweep(speed: float, **length: float) -> dict[str, Any]:
    return {"procedure": "sweep", "motor_turns_per_s": speed, **length}


def _stand(duration_s: float) -> dict[str, Any]:
    return {"procedure": "standstill", "duration_s": duration_s}


_MACHINE: Final[dict[str, tuple[str, tuple[dict[str, Any], ...]]]] = {
    "three-speeds": (
        "sweep three motor turns both ways at three speeds",
        tuple(_sweep(each, motor_turns=3) for each in (0.1, 0.4, 1.6)),
    ),
    "growing-reversals": (
        "reversals of 0.1 to 24 deg of the motor, each beyond where the last one turned",
        (
            {
                "procedure": "reversals",
                "depths_deg": [0.1, 0.2, 0.5, 1, 2, 4, 8, 12, 16, 24],
                "motor_deg_per_s": 4,
                "beyond": True,
            },
        ),
    ),
    "frequencies": (
        "sines of one amplitude at three frequencies",
        tuple(
            {"procedure": "sines", "amplitudes_deg": [45], "frequency_hz": hertz, "periods": periods}
            for hertz, periods in ((0.02, 2), (0.1, 2), (0.5, 10))
        ),
    ),
    "stand-and-two-speeds": (
        "stand still for a minute, then sweep eight motor turns at two speeds",
        (_stand(60), _sweep(0.3, motor_turns=8), _sweep(0.7, motor_turns=8)),
    ),
    "reference-pose": (
        "return to one reference pose every half minute",
        (_stand(20),) * 8,
    ),
    "load-turn-at-two-speeds": (
        "sweep a load turn both ways, then again at twice the speed",
        (_sweep(0.5, load_turns=1), _sweep(1.0, load_turns=1)),
    ),
    "two-load-turns": (
        "sweep two whole load turns both ways",
        (_sweep(0.5, load_turns=2),),
    ),
    "long-standstill": (
        "stand still for five minutes, move, and stand for five minutes again",
        (_stand(300), _sweep(0.3, motor_turns=3), _stand(300)),
    ),
}


def machine_plans() -> dict[str, Plan]:
    """What the axis can do by itself to learn more, by name; ``about`` says it in words."""
    return {
        name: Plan.model_validate(
            {"schema": "hdbridge.plan/1", "name": name, "about": words, "procedures": procedures}
        )
        for name, (words, procedures) in _MACHINE.items()
    }


def next_experiment(cause: str, aliases: tuple[str, ...]) -> str:
    """The shortest experiment that distinguishes the cause from its aliases; without aliases, the one that
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
    return _UNEXPLAINED[_coordinate(lives_in)][0]


def machine_for_unexplained(lives_in: str) -> str:
    """Name of the experiment of `machine_plans` that looks closer at something unexplained."""
    return _UNEXPLAINED[_coordinate(lives_in)][1]


_UNEXPLAINED: Final[dict[str, tuple[str, str]]] = {
    "load angle": (
        "two slow load turns both ways, then again with the load encoder re-clocked by 90 deg",
        "two-load-turns",
    ),
    "reversal": (
        "nested reversals from 0.1 deg up, each beyond where the last one turned, slowly",
        "growing-reversals",
    ),
    "motor angle": ("a slow sweep over ten motor turns both ways, at two places of the load", "three-speeds"),
    "speed": (
        "the same way at three speeds and two accelerations, with rests of a minute between",
        "three-speeds",
    ),
    "torque": ("the same sweep with the load's mass at two places", "load-turn-at-two-speeds"),
    "time": (
        "an hour of returns to one reference pose, with the temperature recorded",
        "reference-pose",
    ),
}
"""By the coordinate that it depends on: in words, and what the machine can do of it."""


def _coordinate(lives_in: str) -> str:
    if "load angle" in lives_in or lives_in == "position":
        return "load angle"
    if "reversal" in lives_in:
        return "reversal"
    if "motor angle" in lives_in:
        return "motor angle"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "speed"
    return "torque" if "torque" in lives_in else "time"
