"""The next experiment: the shortest that separates what the data leave open.

Two menus. `next_experiment` and `for_unexplained` say in words what would distinguish a cause from its
look-alikes, as the causes have it, also what only a person can do (move a mass, re-clock an encoder).
`machine_plans` are the experiments that the axis can do by itself; which of them separates a pair is not
written here but predicted (`hdbridge.diagnose.planned`).
"""

from __future__ import annotations

from typing import Any, Final

from hdbridge.effects import CATALOGUE, Experiment
from hdbridge.procedures.plan import Plan


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
    known = [
        found
        for each in aliases
        for one, other in ((cause, each), (each, cause))
        if (found := _apart(one, other)) is not None
    ]
    if known:
        return min(known).words
    if cause in CATALOGUE:
        return CATALOGUE[cause].about.experiment
    return ""


def _apart(cause: str, other: str) -> Experiment | None:
    return CATALOGUE[cause].about.apart.get(other) if cause in CATALOGUE else None


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
    if "load angle" in lives_in or "position" in lives_in:
        return "load angle"
    if "reversal" in lives_in or lives_in == "direction":
        return "reversal"
    if "motor angle" in lives_in or "wave generator" in lives_in:
        return "motor angle"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "speed"
    return "torque" if "torque" in lives_in else "time"
