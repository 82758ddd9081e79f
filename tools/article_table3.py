"""Why the article's Tables 1 and 2 cannot give its Table 3: every figure of docs/article-table-3.md.

    python tools/article_table3.py [--json FILE]

The axis is taken as ideal but for the article's own error model and its two encoders: no dynamics, no noise.
The law and its inverse are the project's own; the rest is computed here.
"""

from __future__ import annotations

import argparse
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hdbridge.bundled import bundled_profile
from hdbridge.compensation import Inverse
from hdbridge.effects import Hysteresis, HysteresisMemory, Moment, Motion, Start
from hdbridge.model import TransmissionModel
from hdbridge.stepping import Scheme, quantisation_floor_arcsec

RATIO, MOTOR_COUNTS, LOAD_COUNTS = 50.0, 8000, 2_880_000
STEP_COUNTS, COUNT = 968, 240
TABLE_3 = {
    "none": (75.0, 34.2),
    "synchronous": (50.2, 29.0),
    "hysteresis": (55.7, -23.2),
    "both": (30.2, -29.15),
}
NOW = Moment()


def stepping(
    model: TransmissionModel, scheme: Scheme, motor_counts: int = MOTOR_COUNTS
) -> dict[str, tuple[float, float]]:
    """3 sigma and mean, arcsec, of the stepping test on the ideal axis, per direction and pooled."""
    inverse = Inverse(scheme.of(model), Start.FORWARD)
    gear = model.tracker(Start.FORWARD)
    inverse.advance(0.0)
    gear.advance(0.0, NOW)
    step_deg = 360.0 * STEP_COUNTS / MOTOR_COUNTS / RATIO
    passes: list[list[float]] = []
    for order in (range(1, COUNT + 1), range(COUNT - 1, -1, -1)):
        errors = []
        for index in order:
            load_deg = index * step_deg
            motor_deg = inverse.solve(load_deg)
            inverse.advance(motor_deg)
            motor_deg = round(motor_deg / 360.0 * motor_counts) * 360.0 / motor_counts
            reached_deg = motor_deg / RATIO + gear.advance(motor_deg, NOW) / 3600.0
            read_deg = round(reached_deg / 360.0 * LOAD_COUNTS) * 360.0 / LOAD_COUNTS
            errors.append((read_deg - load_deg) * 3600.0)
        passes.append(errors)
    parts = {"cw": passes[0], "ccw": passes[1], "pooled": passes[0] + passes[1]}
    return {name: (3.0 * float(np.std(errors)), float(np.mean(errors))) for name, errors in parts.items()}


def alias(order: int, samples_per_turn: float) -> float:
    """Where a motor order appears in the spectrum of a stepping test, orders per motor turn."""
    folded = order % samples_per_turn
    return min(folded, samples_per_turn - folded)


def figures() -> dict[str, Any]:
    """Every figure, by name."""
    model = TransmissionModel.load(bundled_profile("article") / "model.yaml")
    law = next(effect for effect in model.effects if isinstance(effect, Hysteresis))
    synchronous = model.only(["synchronous"]).predict(Motion(np.linspace(0.0, 360.0, 100_001)))
    count_deg = 360.0 / MOTOR_COUNTS
    n, width, offset = law.exponent, law.width_deg, law.offset_arcsec
    first_count = float(offset - law.predict(Motion(np.array([0.0, -count_deg])), Start.FORWARD)[-1])
    rest = np.linspace(0.0, 20.0, 200_001)
    xi = rest / width
    literal = 2.0 * offset * (xi ** (n - 1.0) - (n - 1.0) * xi) / (2.0 - n)
    virgin = law.predict(Motion(rest), Start.VIRGIN)
    back_step, staircase = memory_gaps(law)
    per_turn = 360.0 / (STEP_COUNTS * count_deg)
    return {
        "computed": {
            scheme.value: stepping(model, scheme)
            for scheme in (Scheme.NONE, Scheme.SYNCHRONOUS, Scheme.HYSTERESIS, Scheme.BOTH)
        },
        "table_3": TABLE_3,
        "ratio_of_80_and_82_teeth": {"flexspline output": 80 / 2, "circular-spline output": 82 / 2},
        "ramp_per_step_between_ratios_40_and_50_arcsec": STEP_COUNTS * count_deg * (1 / 40 - 1 / 50) * 3600.0,
        "table_3_remaining_share": 30.2 / 75.0,
        "table_3_rms_about_zero_arcsec": {
            name: math.hypot(three_sigma / 3.0, mean) for name, (three_sigma, mean) in TABLE_3.items()
        },
        "table_3_root_sum_square_arcsec": math.hypot(50.2, 55.7),
        "synchronous_peak_to_peak_arcsec": float(np.ptp(synchronous)),
        "samples_per_motor_turn": per_turn,
        "aliases": {order: alias(order, per_turn) for order in (1, 2, 3, 4, 6, 8)},
        "load_turns_spanned": COUNT * STEP_COUNTS / MOTOR_COUNTS / RATIO,
        "relay_jump_arcsec": 2.0 * offset,
        "first_count_after_reversal_arcsec": first_count,
        "same_in_counts_after_the_ratio": first_count * RATIO / 3600.0 / count_deg,
        "saturation_from_rest_deg": {
            "the formula as printed": float(rest[np.argmax(literal >= offset)]),
            "a virgin curve": float(rest[np.argmax(virgin >= offset - 1e-9)]),
        },
        "without_return_point_memory_arcsec": {
            "one 2 deg back-step": back_step,
            "1 / 0.5 deg staircase": staircase,
        },
        "floor_arcsec": quantisation_floor_arcsec(MOTOR_COUNTS, RATIO),
        "floor_with_4_x_counts_arcsec": quantisation_floor_arcsec(4 * MOTOR_COUNTS, RATIO),
        "both_with_4_x_counts_arcsec": stepping(model, Scheme.BOTH, 4 * MOTOR_COUNTS)["pooled"][0],
    }


def memory_gaps(law: Hysteresis) -> tuple[float, float]:
    """The largest difference to the same branch with return-point memory (Masing's rules), arcsec.

    On two rising paths after a saturated start: a rise with one 2 deg step back, over all places of the step,
    and a staircase of 1 deg up and 0.5 deg down.
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


def main() -> None:
    """Print the figures, and write them where asked."""
    parser = argparse.ArgumentParser(description="Why Tables 1 and 2 cannot give Table 3.")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures for machines")
    options = parser.parse_args()
    result = figures()
    print("3 sigma / mean, arcsec, computed from Tables 1 and 2 with both encoders quantised\n")
    print(f"{'scheme':>12} {'CW':>15} {'CCW':>15} {'pooled':>15} {'Table 3':>15}")
    for scheme, parts in result["computed"].items():
        cells = [parts["cw"], parts["ccw"], parts["pooled"], TABLE_3[scheme]]
        print(f"{scheme:>12} " + " ".join(f"{a:7.1f} /{b:6.1f}" for a, b in cells))
    print()
    for name, value in result.items():
        if name in {"computed", "table_3"}:
            continue
        if isinstance(value, dict):
            print(f"{name}: " + ", ".join(f"{key}: {each:.2f}" for key, each in value.items()))
        else:
            print(f"{name}: {value:.2f}")
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
