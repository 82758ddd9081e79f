"""Trials of the diagnosis: random causes in records computed from formulas, and a verdict on the result.

The plant (plant.py) shares no code with the effects.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record
from support import plant

SHORT = plant.Plan(rate_hz=16.0, scale=0.2, load_turns=1.05, steps=16)
"""Plan of about 15,000 samples."""
SYNONYMS = {"motor_encoder_eccentricity": {"motor_order"}, "motor_order": {"motor_encoder_eccentricity"}}
FORMS = frozenset({"at", "width", "tau", "hz", "lines", "reference", "shear", "t1", "build"})
"""Parameters of an effect that do not scale with its size."""


def _options(rng: np.random.Generator) -> dict[str, tuple[dict[str, object], dict[str, object]]]:
    """Draws an effect of about three arcsec or more per cause, with the axis properties that it needs."""
    size = float(3.0 * (1 + rng.random()) * rng.choice([-1, 1]))
    phase = float(rng.uniform(0, 360))
    big = abs(size)
    return {
        "motor_order": ({"orders": [(int(rng.choice([5, 7, 10, 12])), big, phase)]}, {}),
        "motor_encoder_eccentricity": ({"orders": [(1, big, phase)]}, {}),
        "load_order": ({"orders": [(1, 2 * big, phase), (2, big, phase + 50)]}, {}),
        "flexspline_order": ({"orders": [(2, big, phase)]}, {}),
        "direction_phase": ({"shift": float(rng.uniform(2.5, 5))}, {}),
        "torque_modulation": ({"growth": float(rng.uniform(0.03, 0.05))}, {"torque_nm": 9.0}),
        "compliance": ({"c1": 0.3 * big, "c2": 0.2 * big, "t1": 4.0}, {"torque_nm": 9.0}),
        "inertial_windup": ({"s2": 2e-5 * big}, {}),
        "velocity_windup": ({"coulomb": 0.4 * big, "viscous": 0.008 * big, "shear": 400.0}, {}),
        "channel_skew": ({"ms": 0.04 * size}, {}),
        "backlash": ({"gap": 2 * big}, {}),
        "rate_dependence": ({"growth": 0.02 * big, "reference": 25.0}, {}),
        "subdivisional_error": (
            {"lines": int(rng.integers(3000, 20000)), "orders": [(1, big, phase), (2, 0.4 * big, 10.0)]},
            {},
        ),
        "zero_drift": ({"size": 2 * size, "tau": float(rng.uniform(0.2, 0.8))}, {}),
        "amplitude_drift": (
            {"ripple": 0.004 * size, "friction": -0.003 * size},
            {"temperature_rise_k": 14.0},
        ),
        "wear": ({"growth": 4 * big}, {}),
        "creep": ({"size": size, "tau": float(rng.uniform(1, 12))}, {}),
        "ratio_error": ({"ramp": 0.2 * size}, {}),
        "count_loss": ({"size": size, "at": float(rng.uniform(0.15, 0.85))}, {}),
        "vibration": ({"size": big, "hz": float(rng.uniform(0.8, 11))}, {}),
        "local_defect": (
            {"size": 1.5 * size, "at": float(rng.uniform(30, 330)), "width": float(rng.uniform(1, 3))},
            {},
        ),
    }


def drawn(cause: str, rng: np.random.Generator) -> tuple[dict[str, dict[str, object]], dict[str, object]]:
    """Draws an effect of one cause; returns it and the axis properties that it needs."""
    effect, axis = _options(rng)[cause]
    return {cause: effect}, axis


def times(effects: Mapping[str, Mapping[str, Any]], factor: float) -> dict[str, dict[str, Any]]:
    """Scales the sizes of effects by a factor."""

    def scaled(name: str, value: Any) -> Any:
        if name == "orders":
            return [(order, factor * amplitude, phase) for order, amplitude, phase in value]
        return value if name in FORMS else factor * value

    return {
        cause: {name: scaled(name, value) for name, value in each.items()} for cause, each in effects.items()
    }


CAUSES = list(_options(np.random.default_rng(0)))
SPECIAL = ("hysteresis_memory", "hysteresis_parameters")
NONE = ("none", "none:memory", "none:bouc_wen", "none:dahl")
UNKNOWN = tuple(f"unknown:{kind}" for kind in ("saw", "square", "chirp", "one_way", "beat", "bursts"))
PAIRS = (
    "load_order+backlash", "motor_order+zero_drift", "compliance+load_order", "count_loss+ratio_error",
    "direction_phase+creep", "local_defect+velocity_windup",
    "channel_skew+vibration", "flexspline_order+wear",
)  # fmt: skip
LOOPS = {"hysteresis_memory", "hysteresis_parameters"}


def planted(name: str, seed: int) -> tuple[set[str], Record, TransmissionModel]:
    """Returns the causes present, the record, and the model to be tested."""
    rng = np.random.default_rng(1000 * seed + 17)
    effects: dict[str, dict[str, object]] = {}
    axis: dict[str, object] = {}
    there: set[str] = set()
    nominal = plant.Truth()
    if name.startswith("none"):
        axis["law"] = name.partition(":")[2] or "plain"
    elif name.startswith("unknown"):
        effects["unknown"] = {"kind": name.partition(":")[2], "size": float(rng.uniform(3, 6))}
        there = {"unexplained"}
    elif name == "hysteresis_memory":
        axis["law"], there = "memory", {name}
    elif name == "hysteresis_parameters":
        axis |= {"offset": 40 * float(rng.choice([0.82, 1.2])), "width": 20 * float(rng.uniform(0.9, 1.2))}
        there = {name}
    else:
        for each in name.split("+"):
            effect, needs = drawn(each, rng)
            effects |= effect
            axis |= needs
            there.add(each)
    truth = plant.Truth(effects=effects, **axis)  # type: ignore[arg-type]
    columns = plant.record(truth, SHORT, seed)
    return there, Record(columns), TransmissionModel.from_text(plant.model_text(seed, truth=nominal))


@dataclass(frozen=True)
class Verdict:
    """Agreement of the reported causes with the causes present."""

    all_right: bool
    """True if each cause present is reported, or is an alias of a reported cause."""
    first_right: bool
    wrong: tuple[str, ...]
    """Reported causes that are not present."""
    unexplained: bool


def verdict(name: str, there: Set[str], found: Mapping[str, Set[str]]) -> Verdict:
    """Judges the reported causes (most important first, with their aliases) for the record ``name``."""
    right = [
        any(
            each == cause or each in aliases or cause in SYNONYMS.get(each, ())
            for cause, aliases in found.items()
        )
        for each in there
    ]
    allowed = there | {other for each in there for other in SYNONYMS.get(each, ())}
    loop = name.startswith("none:") or bool(LOOPS & there)
    wrong = (
        cause
        for cause, aliases in found.items()
        if cause not in allowed | {"unexplained"} and not aliases & there and not (loop and cause in LOOPS)
    )
    first = next(iter(found), None)
    return Verdict(all(right), first in allowed, tuple(wrong), "unexplained" in found)
