"""Computes all figures of docs/method.md: why the article's Tables 1 and 2 cannot give its Table 3.

    python tools/article_table3.py [--json FILE] [--simulate] [--as-data]

The axis is ideal except for the article's own error model and the resolution of its two encoders: no
dynamics, no noise. The hysteresis law is that of the project's effects; the inverse and the statistics are
computed here independently, so that they also check the compensation. ``--simulate`` runs the same test on
the simulated drive (half a minute) and compares the errors step by step.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Moment, Motion, Start, Tracker
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.comparison import compare_schemes
from hdbridge.commissioning.evaluation.stepping import Scheme, quantisation_floor_arcsec
from hdbridge.drive.drive import Drive
from hdbridge.files.profile import bundled_profile
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.sim.lockstep import simulated_bench

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


def rms(three_sigma: float, mean: float) -> float:
    """Returns the root mean square about zero."""
    return math.hypot(three_sigma / 3.0, mean)


def figures() -> dict[str, Any]:
    """Returns all figures by name."""
    model = TransmissionModel.load(bundled_profile("article") / "model.yaml")
    law = next(effect for effect in model.effects if isinstance(effect, Hysteresis))
    errors = {scheme.value: step_errors(model, scheme.of(model)) for scheme in SCHEMES}
    computed = {name: statistics(*each) for name, each in errors.items()}
    printed, fine = partial(step_errors, model, model, target=as_printed), 4 * MOTOR_COUNTS
    return {
        "computed": computed,
        "both_by_the_formula_as_printed": statistics(*printed(MOTOR_COUNTS)),
        "table_3": TABLE_3,
        "rms_about_zero_arcsec": {
            name: {"computed": rms(*parts["pooled"]), "table 3": rms(*TABLE_3[name])}
            for name, parts in computed.items()
        },
        **_about_table_3(computed),
        **_about_the_test(model, law),
        **_about_the_law(law),
        "floor_arcsec": quantisation_floor_arcsec(MOTOR_COUNTS, RATIO),
        "with_4_x_counts_arcsec": {
            "floor": quantisation_floor_arcsec(fine, RATIO),
            "both": statistics(*step_errors(model, model, fine))["pooled"][0],
            "both by the formula as printed": statistics(*printed(fine))["pooled"][0],
        },
    }


def _about_table_3(computed: Mapping[str, Parts]) -> dict[str, Any]:
    """Returns figures derived from Table 3, and compared with the possible means and scatters."""
    three_sigma = {name: each[0] for name, each in TABLE_3.items()}
    mean = {name: each[1] for name, each in TABLE_3.items()}
    wave = computed["none"]["cw"][0]
    offset = computed["synchronous"]["cw"][1]
    # A fraction p of forward steps adds (2 offset)^2 p (1 - p) to the variance; solved for that of "none".
    both_ways = (three_sigma["none"] ** 2 - wave**2) / (3.0 * 2.0 * offset) ** 2
    forward = 0.5 + math.sqrt(0.25 - both_ways)
    return {
        "remaining_share": three_sigma["both"] / three_sigma["none"],
        "root_sum_square_of_the_single_schemes_arcsec": math.hypot(
            three_sigma["synchronous"], three_sigma["hysteresis"]
        ),
        "shift_of_the_mean_arcsec": {
            "by hysteresis compensation, without synchronous": mean["hysteresis"] - mean["none"],
            "by hysteresis compensation, with synchronous": mean["both"] - mean["synchronous"],
            "by synchronous compensation, without hysteresis": mean["synchronous"] - mean["none"],
            "by synchronous compensation, with hysteresis": mean["both"] - mean["hysteresis"],
            "the most that an offset of 40 could": computed["hysteresis"]["cw"][1]
            - computed["none"]["cw"][1],
        },
        "none_as_a_mixture_of_directions": {
            "share forward": forward,
            "mean": offset * (2.0 * forward - 1.0),
        },
        "without_the_synchronous_part_of_table_1_arcsec": math.sqrt(three_sigma["none"] ** 2 - wave**2),
        "beyond_one_motor_count_in_both_arcsec": math.sqrt(
            three_sigma["both"] ** 2 - computed["both"]["pooled"][0] ** 2
        ),
    }


def _about_the_test(model: TransmissionModel, law: Hysteresis) -> dict[str, Any]:
    """Returns figures on the angles that the stepping test samples and on those that it misses."""
    turn = np.linspace(0.0, 360.0, 100_001)
    stops = np.concatenate([np.arange(COUNT + 1), np.arange(COUNT - 1, -1, -1)]) * STEP_DEG
    reached = law.predict(Motion(stops), Start.FORWARD)[1:]
    other = [
        law.model_copy(update={"width_deg": width, "exponent": exponent}).predict(
            Motion(stops), Start.FORWARD
        )[1:]
        for width in (5.0, 40.0)
        for exponent in (1.2, 2.5)
    ]
    per_turn = 360.0 / STEP_DEG
    return {
        "ratio_of_80_and_82_teeth": {"flexspline output": 80 / 2, "circular-spline output": 82 / 2},
        "ramp_per_step_between_ratios_40_and_50_arcsec": STEP_DEG * (1 / 40 - 1 / 50) * 3600.0,
        "synchronous_peak_to_peak_arcsec": float(np.ptp(model.only(["synchronous"]).predict(Motion(turn)))),
        "samples_per_motor_turn": per_turn,
        "aliases": {str(order): alias(order, per_turn) for order in (1, 2, 3, 4, 6, 8)},
        "load_turns_spanned": COUNT * STEP_DEG / RATIO / 360.0,
        "steps_that_end_saturated": int(np.sum(np.abs(np.abs(reached) - law.offset_arcsec) < 1e-9)),
        "steps": len(reached),
        "largest_change_with_widths_5_to_40_and_n_1.2_to_2.5_arcsec": float(
            max(np.max(np.abs(each - reached)) for each in other)
        ),
    }


def alias(order: int, samples_per_turn: float) -> float:
    """Returns the aliased frequency of a motor order in a stepping test, orders per motor turn."""
    folded = order % samples_per_turn
    return min(folded, samples_per_turn - folded)


def _about_the_law(law: Hysteresis) -> dict[str, Any]:
    n, offset = law.exponent, law.offset_arcsec
    first_count = float(offset - law.predict(Motion(np.array([0.0, -COUNT_DEG])), Start.FORWARD)[-1])
    rest = np.linspace(0.0, 20.0, 200_001)
    xi = rest / law.width_deg
    literal = 2.0 * offset * (xi ** (n - 1.0) - (n - 1.0) * xi) / (2.0 - n)
    virgin = law.predict(Motion(rest), Start.VIRGIN)
    back_step, staircase = memory_gaps(law)
    return {
        "relay_jump_arcsec": 2.0 * offset,
        "first_count_after_reversal_arcsec": first_count,
        "same_in_counts_after_the_ratio": first_count * RATIO / 3600.0 / COUNT_DEG,
        "saturation_from_rest_deg": {
            "the formula as printed": float(rest[np.argmax(literal >= offset)]),
            "a virgin curve": float(rest[np.argmax(virgin >= offset - 1e-9)]),
        },
        "without_return_point_memory_arcsec": {
            "one 2 deg back-step": back_step,
            "1 / 0.5 deg staircase": staircase,
        },
    }


def memory_gaps(law: Hysteresis) -> tuple[float, float]:
    """Returns the maximum differences from the same law with return-point memory (Masing's rules), arcsec.

    There are two rising paths after a saturated start: one with a single 2 deg step back, at the worst
    position, and a staircase of 1 deg up and 0.5 deg down.
    """
    memory = HysteresisMemory.model_validate(law.parameters())

    def gap(turns: list[float]) -> float:
        legs = [np.arange(a, b, math.copysign(0.02, b - a)) for a, b in pairwise(turns)]
        motion = Motion(np.concatenate([*legs, [turns[-1]]]))
        difference = memory.predict(motion, Start.BACKWARD) - law.predict(motion, Start.BACKWARD)
        return float(np.max(np.abs(difference)))

    back_step = max(gap([-50.0, at, at - 2.0, 40.0]) for at in np.arange(-47.5, -30.0, 0.25))
    staircase = [-50.0]
    for _ in range(60):
        staircase += [staircase[-1] + 1.0, staircase[-1] + 0.5]
    return back_step, gap(staircase)


def as_data(result: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the error budget of Table 3, which is treated as a measurement."""
    from table3_budget import budget  # noqa: PLC0415 - found only where this file is run as a script

    computed = result["computed"]
    return budget(
        TABLE_3, computed["none"]["cw"][0], computed["synchronous"]["cw"][1], result["floor_arcsec"]
    )


def simulated() -> dict[str, Any]:
    """Runs the test on the simulated drive; returns its figures and deviations from the computed steps."""
    profile = bundled_profile("article")
    axis = AxisConfig.load(profile / "axis.yaml")
    model = TransmissionModel.load(profile / "model.yaml")
    stepping = Stepping(count=COUNT, step_deg=STEP_DEG)
    with (
        simulated_bench(profile / "truth.yaml", axis.eds_path, axis.drive.node_id) as (bus, clock, _),
        Drive(bus, axis, clock) as drive,
    ):
        drive.boot()
        comparison = compare_schemes(drive, model, SCHEMES, stepping)
    result = {}
    for scheme, measured in comparison.results.items():
        there, back = step_errors(model, scheme.of(model))
        apart = np.concatenate(measured.errors_arcsec) - np.array([*there, *back])
        result[scheme.value] = {
            **{
                name: (part.three_sigma_arcsec, part.mean_arcsec)
                for name, part in (("cw", measured.cw), ("ccw", measured.ccw), ("pooled", measured.pooled))
            },
            "off the computed steps, arcsec": {
                "rms": float(np.sqrt(np.mean(np.square(apart)))),
                "largest": float(np.max(np.abs(apart))),
            },
        }
    return result


def _print(result: Mapping[str, Any]) -> None:
    rows = {**result["computed"], "(as printed)": result["both_by_the_formula_as_printed"]}
    print("3 sigma / mean, arcsec, computed from Tables 1 and 2 with both encoders quantised\n")
    print(f"{'scheme':>12} {'CW':>15} {'CCW':>15} {'pooled':>15} {'Table 3':>15}")
    for name, parts in rows.items():
        print(_row(name, parts, TABLE_3.get(name)))
    if "simulated" in result:
        print("\nthe same on the simulated drive\n")
        for name, parts in result["simulated"].items():
            off = "off the computed steps, arcsec"
            print(_row(name, parts, None), f" {off}: {_words(parts[off])}")
    for name, lines in result.get("as_data", {}).items():
        print(f"\nTable 3 as data: {name}; arcsec\n")
        print("\n".join(f"{line:>75}  {_words(value)}" for line, value in lines.items()))
    print()
    for name, value in result.items():
        if name in {"computed", "both_by_the_formula_as_printed", "table_3", "simulated", "as_data"}:
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
    """Prints the figures, and writes them to a file on request."""
    parser = argparse.ArgumentParser(description="Why Tables 1 and 2 cannot give Table 3.")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures for machines")
    parser.add_argument("--simulate", action="store_true", help="run the test on the simulated drive too")
    parser.add_argument("--as-data", action="store_true", help="take Table 3 as a measurement: what it lacks")
    options = parser.parse_args()
    result = figures()
    if options.as_data:
        result["as_data"] = as_data(result)
    if options.simulate:
        result["simulated"] = simulated()
    _print(result)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
