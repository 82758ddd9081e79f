"""Consistency of encoder counts, directions and gear ratio with a measured turn; finds the wrong key. Pure.

They are judged by a single ratio, load counts per motor count. It is the quotient of three keys of the axis
file and two directions, so a wrong one cannot be computed from it. It can be *inferred* from the values that
the drive and the teeth confirm, and from common mistakes and values (counts confused with lines, the other
output of the gear, round numbers).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from hdbridge.commissioning.bringup.checks import Verdict, failed, passed

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig

TOOTH_SHARE: Final = 0.35
"""Maximum error of a ratio, as a share of the distance to its neighbour (N and N + 1 differ by 1/N)."""
CLOSE_SHARE: Final = 0.001
"""Accuracy with which a motor turn shows the ratio of a sound gear: 26 arcsec at N = 50."""
DEAD_SHARE: Final = 0.02
"""A load encoder that moves less than this share of the expected travel counts as not moving."""
USUAL_RATIOS: Final = frozenset(
    each + output for each in (30, 50, 60, 64, 72, 80, 88, 100, 110, 120, 128, 160, 200) for output in (0, 1)
)
"""Commercial ratios of harmonic gears, with the flexspline or the circular spline as the output."""

LOAD_COUNTS: Final = "load_encoder.counts_per_turn"
MOTOR_COUNTS: Final = "motor_encoder.counts_per_turn"
RATIO: Final = "gear.ratio"
SOURCE: Final = "load_encoder.source"


class Turned(NamedTuple):
    """Travel of both encoders between two standstills approached from the same side; counts."""

    motor_counts: float
    load_counts: float


@dataclass(frozen=True, slots=True)
class Accusation:
    """Key of the axis file whose value would explain the measurement."""

    key: str
    found: float
    expected: float
    weight: float
    """Weight of the evidence, relative to the other keys."""
    why: str

    def text(self, axis: AxisConfig) -> str:
        """For example ``axis.yaml:31:3: gear.ratio: found 50, expected 51 (...)``."""
        where = axis.where(self.key)
        return f"{where}: found {_plain(self.found)}, expected {_plain(self.expected)} ({self.why})"


def expected_load_per_motor(axis: AxisConfig) -> float:
    """Returns the signed load counts per motor count according to the axis file."""
    motor, load = axis.motor_encoder, axis.load_encoder
    return (load.direction * load.counts_per_turn) / (
        motor.direction * motor.counts_per_turn * axis.gear.ratio
    )


def judge_turn(
    axis: AxisConfig, forward: Turned, backward: Turned, confirmed: frozenset[str] = frozenset()
) -> Verdict:
    """Checks directions, counts of both encoders and ratio against moves in both directions.

    ``confirmed`` are the keys that the drive's own objects confirm.
    """
    motor = forward.motor_counts - backward.motor_counts
    load = forward.load_counts - backward.load_counts
    measured = load / motor
    factor = measured / expected_load_per_motor(axis)
    tolerance = max(TOOTH_SHARE / axis.gear.ratio, 4.0 / max(abs(load), 1.0))
    turns = abs(motor) / 2.0 / axis.motor_encoder.counts_per_turn
    lost = abs(forward.load_counts + backward.load_counts)
    figures = {
        "motor_turns": turns,
        "forward_motor_counts": forward.motor_counts,
        "forward_load_counts": forward.load_counts,
        "backward_motor_counts": backward.motor_counts,
        "backward_load_counts": backward.load_counts,
        "load_per_motor_counts": measured,
        "factor_against_axis_file": factor,
        "ratio_measured": axis.gear.ratio / factor if factor else None,
        "tolerance": tolerance,
    }
    text = (
        f"{turns:.3g} motor turn{'' if turns == 1 else 's'} each way: motor {forward.motor_counts:+.0f} / "
        f"{backward.motor_counts:+.0f}, load {forward.load_counts:+.1f} / {backward.load_counts:+.1f} counts"
    )
    if abs(factor) < DEAD_SHARE:
        return failed(
            f"{text}: the load encoder does not move",
            f"{axis.where(SOURCE)}: object {_source(axis)} does not follow the load; check the encoder, its "
            "cable and supply, and that the object is the load encoder's",
            f"if it is the right object: {axis.where(LOAD_COUNTS)}: found "
            f"{axis.load_encoder.counts_per_turn}, far too many for what it moves",
            **figures,
        )
    if math.isclose(abs(measured), 1.0, rel_tol=1e-3) and not math.isclose(abs(factor), 1.0, rel_tol=0.01):
        return failed(
            f"{text}: the same as the motor's",
            f"{axis.where(SOURCE)}: object {_source(axis)} reads the motor's encoder; expected the object of "
            "the load encoder",
            **figures,
        )
    remedies = []
    if factor < 0:
        remedies += _direction(axis)
    if abs(abs(factor) - 1.0) > tolerance:
        remedies += [each.text(axis) for each in accuse(axis, abs(factor), tolerance, confirmed)]
    elif lost > 4.0 + 0.05 * abs(load) / 2.0:
        remedies.append(
            f"{axis.where(SOURCE)}: the load encoder came back {lost:.0f} counts from where it had been; "
            "check it for lost counts and the coupling for slip"
        )
    ratio = f"ratio {axis.gear.ratio / abs(factor):.4g} against {axis.gear.ratio:g}"
    sign = "" if factor > 0 else ", reversed"
    text += f"; {ratio}{sign} (within {100 * tolerance:.2g} %)" if not remedies else f"; {ratio}{sign}"
    return failed(text, *remedies, **figures) if remedies else passed(text, **figures)


def _direction(axis: AxisConfig) -> list[str]:
    load, motor = axis.load_encoder.direction, axis.motor_encoder.direction
    return [
        f"{axis.where('load_encoder.direction')}: found {load}, expected {-load} (the load encoder counts "
        f"the other way round); or, if the load turned to the wrong side, "
        f"{axis.where('motor_encoder.direction')}: found {motor}, expected {-motor}"
    ]


def accuse(
    axis: AxisConfig, factor: float, tolerance: float, confirmed: frozenset[str] = frozenset()
) -> list[Accusation]:
    """Returns the keys that explain a load travel of ``factor`` times the expected one, the likeliest first.

    ``tolerance`` is the relative uncertainty of the factor.
    """
    load, motor = axis.load_encoder.counts_per_turn, axis.motor_encoder.counts_per_turn
    rows = [
        _counts(LOAD_COUNTS, load, load * factor, tolerance, 0.5),
        _counts(MOTOR_COUNTS, motor, motor / factor, tolerance, 0.0),
        _ratio(axis, axis.gear.ratio / factor, tolerance),
    ]
    weighed = []
    for row in rows:
        taken = -4.0 if row.key in confirmed else 0.0
        why = f"{row.why}; but the drive itself confirms {_plain(row.found)}" if taken else row.why
        weighed.append(Accusation(row.key, row.found, row.expected, row.weight + taken, why))
    return sorted(weighed, key=lambda each: -each.weight)


def _counts(key: str, found: int, wanted: float, tolerance: float, weight: float) -> Accusation:
    for power in range(-8, 9):
        multiple = found * 2.0**power
        if power and abs(multiple / wanted - 1.0) <= tolerance:
            if power in (2, -2):
                why = "lines taken for counts" if power > 0 else "counts taken for lines"
                return Accusation(key, found, round(multiple), weight + 3.0, why)
            return Accusation(key, found, round(multiple), weight + 2.0, f"{2.0**power:g} times")
    tidy = _roundest(wanted)
    digits = len(str(tidy).rstrip("0"))
    if digits == 1 or tidy & (tidy - 1) == 0:
        return Accusation(key, found, tidy, weight + 2.0, "a round number")
    return Accusation(key, found, tidy, weight + (1.0 if digits == 2 else 0.0), "it would explain it")


def _ratio(axis: AxisConfig, wanted: float, tolerance: float) -> Accusation:
    found, teeth = axis.gear.ratio, axis.gear.teeth
    if teeth is not None:
        other = found + (1.0 if teeth.output == "flexspline" else -1.0)
        if abs(other / wanted - 1.0) <= tolerance:
            held = "circular_spline" if teeth.output == "flexspline" else "flexspline"
            return Accusation(RATIO, found, other, 4.0, f"the output is the other one: teeth.output {held}")
    whole = round(wanted)
    if whole >= 1 and abs(whole / wanted - 1.0) <= tolerance:
        # Teeth that give the ratio of the file are evidence for it.
        less = 1.0 if teeth is not None else 0.0
        if abs(whole - found) == 1.0:
            return Accusation(RATIO, found, whole, 3.5 - less, "the other output of the same gear")
        if whole in USUAL_RATIOS:
            return Accusation(RATIO, found, whole, 2.0 - less, "a usual ratio")
        return Accusation(RATIO, found, whole, 1.0 - less, "a whole number")
    return Accusation(
        RATIO, found, float(f"{wanted:.5g}"), -2.0, "it would explain it, but is not a whole number"
    )


def _roundest(value: float) -> int:
    """Returns the close number with the fewest digits, or a power of two if there is one."""
    power = 2 ** round(math.log2(value)) if value >= 1.0 else 1
    if abs(power / value - 1.0) <= CLOSE_SHARE:
        return power
    for digits in range(1, 12):
        tidy = float(f"{value:.{digits - 1}e}")
        if abs(tidy / value - 1.0) <= CLOSE_SHARE and tidy >= 1.0:
            return round(tidy)
    return max(round(value), 1)


def _source(axis: AxisConfig) -> str:
    source = axis.load_encoder.source
    node = f" of node {source.node}" if source.node is not None else ""
    return f"{source.index:04X}h:{source.subindex:02X}{node}"


def _plain(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else f"{value:g}"
