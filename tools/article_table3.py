"""Computes all figures of docs/method.md: why the article's Tables 1 and 2 cannot give its Table 3.

    python tools/article_table3.py [--as-data]

The axis is ideal except for the article's own error model and the resolution of its two encoders: no
dynamics, no noise. The hysteresis law is that of the project's effects; the inverse and the statistics are
computed here independently, so that they also check the compensation. `hdbridge demo` runs the same test on
the simulated drive.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import brentq
from table3_budget import budget

from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Moment, Motion, Start, Tracker
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.stepping import quantisation_floor_arcsec
from hdbridge.enums import Scheme
from hdbridge.files.profile import bundled_profile

RATIO, MOTOR_COUNTS, LOAD_COUNTS = 50.0, 8000, 2_880_000
STEP_COUNTS, COUNT = 968, 240
COUNT_DEG = 360.0 / MOTOR_COUNTS
STEP_DEG = STEP_COUNTS * COUNT_DEG
SCHEMES = (Scheme.NONE, Scheme.SYNCHRONOUS, Scheme.HYSTERESIS, Scheme.BOTH)
TABLE_3 = {
    "none": (75.0, 34.2),
    "synchronous": (50.2, 29.0),
    "hysteresis": (55.7, -23.2),
    "both": (30.2, -29.15),
}
NOW = Moment()
BRACKET_DEG = 5.0
"""Half-width of the bracket for the compensated angle, motor degrees: 360 arcsec at the load."""

Target = Callable[[Tracker, float], float]
Parts = dict[str, tuple[float, float]]


def exact(model: Tracker, load_deg: float) -> float:
    """Returns the motor angle that solves theta_M / N + TE(theta_M) = load target, by a bracketed root."""

    def off(motor_deg: float) -> float:
        return motor_deg / RATIO + model.peek(motor_deg, NOW) / 3600.0 - load_deg

    motor_deg = float(brentq(off, load_deg * RATIO - BRACKET_DEG, load_deg * RATIO + BRACKET_DEG, xtol=1e-11))
    model.advance(motor_deg, NOW)
    return motor_deg


def as_printed(model: Tracker, load_deg: float) -> float:
    """Returns the motor angle by the article's own formula, with the error at the uncompensated angle."""
    return load_deg * RATIO - RATIO * model.advance(load_deg * RATIO, NOW) / 3600.0


def step_errors(
    gear: TransmissionModel,
    compensated: TransmissionModel,
    motor_counts: int = MOTOR_COUNTS,
    target: Target = exact,
) -> tuple[list[float], list[float]]:
    """Returns the load errors at rest, arcsec, outward (240) and back (240), with quantised encoders."""
    told, real = compensated.tracker(Start.FORWARD), gear.tracker(Start.FORWARD)
    told.advance(0.0, NOW)
    real.advance(0.0, NOW)
    ways = []
    for order in (range(1, COUNT + 1), range(COUNT - 1, -1, -1)):
        errors = []
        for index in order:
            load_deg = index * STEP_DEG / RATIO
            motor_deg = quantised(target(told, load_deg), motor_counts)
            reached_deg = motor_deg / RATIO + real.advance(motor_deg, NOW) / 3600.0
            errors.append((quantised(reached_deg, LOAD_COUNTS) - load_deg) * 3600.0)
        ways.append(errors)
    return ways[0], ways[1]


def quantised(angle_deg: float, counts_per_turn: int) -> float:
    """Rounds an angle to whole counts; degrees."""
    return round(angle_deg / 360.0 * counts_per_turn) * 360.0 / counts_per_turn


def statistics(there: Sequence[float], back: Sequence[float]) -> Parts:
    """Returns 3 sigma and mean, arcsec, per direction and pooled."""
    parts = {"cw": there, "ccw": back, "pooled": [*there, *back]}
    return {name: (3.0 * float(np.std(errors)), float(np.mean(errors))) for name, errors in parts.items()}


def figures() -> dict[str, Any]:
    """Returns all figures by name."""
    model = TransmissionModel.load(bundled_profile("article") / "model.yaml")
    law = next(effect for effect in model.effects if isinstance(effect, Hysteresis))
    errors = {scheme.value: step_errors(model, scheme.of(model)) for scheme in SCHEMES}
    computed = {name: statistics(*each) for name, each in errors.items()}
    printed = step_errors(model, model, target=as_printed)
    return {
        "computed": computed,
        "both_by_the_formula_as_printed": statistics(*printed),
        "table_3": TABLE_3,
        **_about_the_test(law),
        **_about_the_law(law),
        "floor_arcsec": quantisation_floor_arcsec(MOTOR_COUNTS, RATIO),
    }


def _about_the_test(law: Hysteresis) -> dict[str, Any]:
    """Returns the load turns that the stepping test spans, and how many of its steps end saturated."""
    stops = np.concatenate([np.arange(COUNT + 1), np.arange(COUNT - 1, -1, -1)]) * STEP_DEG
    reached = law.predict(Motion(stops), Start.FORWARD)[1:]
    return {
        "load_turns_spanned": COUNT * STEP_DEG / RATIO / 360.0,
        "steps_that_end_saturated": int(np.sum(np.abs(np.abs(reached) - law.offset_arcsec) < 1e-9)),
        "steps": len(reached),
    }


def _about_the_law(law: Hysteresis) -> dict[str, Any]:
    first_count = law.offset_arcsec - law.predict(Motion(np.array([0.0, -COUNT_DEG])), Start.FORWARD)[-1]
    return {
        "first_count_after_reversal_arcsec": float(first_count),
        "without_return_point_memory_after_a_2_deg_back_step_arcsec": memory_gap(law),
    }


def memory_gap(law: Hysteresis) -> float:
    """Returns the maximum difference from the same law with return-point memory (Masing's rules), arcsec.

    The path rises after a saturated start, with a single 2 deg step back at the worst position.
    """
    memory = HysteresisMemory.model_validate(law.parameters())

    def gap(turns: list[float]) -> float:
        legs = [np.arange(a, b, math.copysign(0.02, b - a)) for a, b in pairwise(turns)]
        motion = Motion(np.concatenate([*legs, [turns[-1]]]))
        difference = memory.predict(motion, Start.BACKWARD) - law.predict(motion, Start.BACKWARD)
        return float(np.max(np.abs(difference)))

    return max(gap([-50.0, at, at - 2.0, 40.0]) for at in np.arange(-47.5, -30.0, 0.25))


def as_data(result: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the error budget of Table 3, which is treated as a measurement."""
    computed = result["computed"]
    return budget(
        TABLE_3, computed["none"]["cw"][0], computed["synchronous"]["cw"][1], result["floor_arcsec"]
    )


def _print(result: Mapping[str, Any]) -> None:
    rows = {**result["computed"], "(as printed)": result["both_by_the_formula_as_printed"]}
    print("3 sigma / mean, arcsec, computed from Tables 1 and 2 with both encoders quantised\n")
    print(f"{'scheme':>12} {'CW':>15} {'CCW':>15} {'pooled':>15} {'Table 3':>15}")
    for name, parts in rows.items():
        print(_row(name, parts, TABLE_3.get(name)))
    for name, lines in result.get("as_data", {}).items():
        print(f"\nTable 3 as data: {name}; arcsec\n")
        print("\n".join(f"{line:>75}  {_words(value)}" for line, value in lines.items()))
    print()
    for name, value in result.items():
        if name in {"computed", "both_by_the_formula_as_printed", "table_3", "as_data"}:
            continue
        print(f"{name.replace('_', ' ')}: {_words(value)}")


def _row(name: str, parts: Parts, table: tuple[float, float] | None) -> str:
    cells = [parts["cw"], parts["ccw"], parts["pooled"], *([table] if table else [])]
    return f"{name:>12} " + " ".join(f"{a:7.1f} /{b:7.2f}" for a, b in cells)


def _words(value: object) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{key} {_words(each)}" for key, each in value.items())
    if isinstance(value, list):
        return " to ".join(_words(each) for each in value)
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description="Why Tables 1 and 2 cannot give Table 3.")
    parser.add_argument("--as-data", action="store_true", help="take Table 3 as a measurement: what it lacks")
    options = parser.parse_args()
    result = figures()
    if options.as_data:
        result["as_data"] = as_data(result)
    _print(result)


if __name__ == "__main__":
    main()
