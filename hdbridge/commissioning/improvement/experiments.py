"""Experiments that the axis can run on its own to learn more; `choose` selects from them.

The causes that an experiment separates are not listed here but predicted (`analysis.identifiability`).
"""

from typing import Any, Final

from hdbridge.analysis.findings import depends_on
from hdbridge.motion.procedures.plan import Plan

_CLOSER: Final = {
    "load angle": "two-load-turns",
    "reversal": "growing-reversals",
    "motor angle": "three-speeds",
    "speed": "three-speeds",
    "torque": "load-turn-at-two-speeds",
    "time": "reference-pose",
}
"""Experiment for something unexplained, by the coordinate that it depends on."""


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
    "reference-pose": ("return to one reference pose every half minute", (_stand(20),) * 8),
    "load-turn-at-two-speeds": (
        "sweep a load turn both ways, then again at twice the speed",
        (_sweep(0.5, load_turns=1), _sweep(1.0, load_turns=1)),
    ),
    "two-load-turns": ("sweep two whole load turns both ways", (_sweep(0.5, load_turns=2),)),
    "long-standstill": (
        "stand still for five minutes, move, and stand for five minutes again",
        (_stand(300), _sweep(0.3, motor_turns=3), _stand(300)),
    ),
}


def machine_plans() -> dict[str, Plan]:
    """Returns the experiments that the axis can run on its own, by name; ``about`` describes each."""
    return {
        name: Plan.model_validate(
            {"schema": "hdbridge.plan/1", "name": name, "about": words, "procedures": procedures}
        )
        for name, (words, procedures) in _MACHINE.items()
    }


def machine_for_unexplained(lives_in: str) -> str:
    """Returns the name of the experiment in `machine_plans` that investigates something unexplained."""
    return _CLOSER[depends_on(lives_in)]
