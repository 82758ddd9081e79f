"""Pure functions that judge measured values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, pstdev
from typing import Final, NamedTuple

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.commissioning.bringup.checks import Verdict, failed, judged, passed
from hdbridge.units import ARCSEC_PER_DEG, rounded

TOOTH_SHARE: Final = 0.35
"""Maximum error of a ratio, relative to the distance to its neighbour (N and N + 1 differ by 1/N)."""
CLOSE_SHARE: Final = 0.001
"""Relative error of a sound gear's ratio over one motor turn: 26 arcsec at the load for N = 50."""
DEAD_SHARE: Final = 0.02
"""Fraction of the expected travel below which a load encoder counts as not moving."""
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
class SuspectEntry:
    """Suspected key of the axis file, with the value that would explain the measurement."""

    key: str
    found: float
    expected: float
    weight: float
    """Score of the evidence; the key with the highest score is the most likely."""
    why: str

    def text(self, axis: AxisConfig) -> str:
        """Returns one line, for example ``axis.yaml:31:3: gear.ratio: found 50, expected 51 (...)``."""
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
    """Checks directions, counts per turn of both encoders and gear ratio by moves in both directions.

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
            f"{axis.load_encoder.counts_per_turn}, far too many for its motion",
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
        load_way, motor_way = axis.load_encoder.direction, axis.motor_encoder.direction
        remedies.append(
            f"{axis.where('load_encoder.direction')}: found {load_way}, expected {-load_way} (the load "
            "encoder counts the other way round); or, if the load turned to the wrong side, "
            f"{axis.where('motor_encoder.direction')}: found {motor_way}, expected {-motor_way}"
        )
    if abs(abs(factor) - 1.0) > tolerance:
        remedies += [each.text(axis) for each in suspect_entries(axis, abs(factor), tolerance, confirmed)]
    elif lost > 4.0 + 0.05 * abs(load) / 2.0:
        remedies.append(
            f"{axis.where(SOURCE)}: the load encoder returned {lost:.0f} counts off its initial reading; "
            "check it for lost counts and the coupling for slip"
        )
    ratio = f"ratio {axis.gear.ratio / abs(factor):.4g} against {axis.gear.ratio:g}"
    sign = "" if factor > 0 else ", reversed"
    text += f"; {ratio}{sign} (within {100 * tolerance:.2g} %)" if not remedies else f"; {ratio}{sign}"
    return judged(not remedies, text, *remedies, **figures)


def suspect_entries(
    axis: AxisConfig, factor: float, tolerance: float, confirmed: frozenset[str] = frozenset()
) -> list[SuspectEntry]:
    """Returns the keys that explain a load travel of ``factor`` times the expected travel, most likely
    first.

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
        weighed.append(SuspectEntry(row.key, row.found, row.expected, row.weight + taken, why))
    return sorted(weighed, key=lambda each: -each.weight)


def _counts(key: str, found: int, wanted: float, tolerance: float, weight: float) -> SuspectEntry:
    for power in range(-8, 9):
        multiple = found * 2.0**power
        if power and abs(multiple / wanted - 1.0) <= tolerance:
            if power in (2, -2):
                why = "lines taken for counts" if power > 0 else "counts taken for lines"
                return SuspectEntry(key, found, round(multiple), weight + 3.0, why)
            return SuspectEntry(key, found, round(multiple), weight + 2.0, f"{2.0**power:g} times")
    tidy = _roundest(wanted)
    digits = len(str(tidy).rstrip("0"))
    if digits == 1 or tidy & (tidy - 1) == 0:
        return SuspectEntry(key, found, tidy, weight + 2.0, "a round number")
    return SuspectEntry(key, found, tidy, weight + (1.0 if digits == 2 else 0.0), "it would explain it")


def _ratio(axis: AxisConfig, wanted: float, tolerance: float) -> SuspectEntry:
    found, teeth = axis.gear.ratio, axis.gear.teeth
    if teeth is not None:
        other = found + (1.0 if teeth.output == "flexspline" else -1.0)
        if abs(other / wanted - 1.0) <= tolerance:
            held = "circular_spline" if teeth.output == "flexspline" else "flexspline"
            return SuspectEntry(
                RATIO, found, other, 4.0, f"the output is the other part: teeth.output {held}"
            )
    whole = round(wanted)
    if whole >= 1 and abs(whole / wanted - 1.0) <= tolerance:
        # Numbers of teeth that give the ratio of the axis file are evidence for that ratio.
        less = 1.0 if teeth is not None else 0.0
        if abs(whole - found) == 1.0:
            return SuspectEntry(RATIO, found, whole, 3.5 - less, "the other output of the same gear")
        if whole in USUAL_RATIOS:
            return SuspectEntry(RATIO, found, whole, 2.0 - less, "a usual ratio")
        return SuspectEntry(RATIO, found, whole, 1.0 - less, "a whole number")
    return SuspectEntry(RATIO, found, rounded(wanted), -2.0, "it would explain it, but is not a whole number")


def _roundest(value: float) -> int:
    """Returns the roundest number within `CLOSE_SHARE`: a power of two, or that with the fewest digits."""
    power = 2 ** round(math.log2(value)) if value >= 1.0 else 1
    if abs(power / value - 1.0) <= CLOSE_SHARE:
        return power
    for digits in range(1, 12):
        tidy = rounded(value, digits)
        if abs(tidy / value - 1.0) <= CLOSE_SHARE and tidy >= 1.0:
            return round(tidy)
    return max(round(value), 1)


def _source(axis: AxisConfig) -> str:
    source = axis.load_encoder.source
    node = f" of node {source.node}" if source.node is not None else ""
    return f"{source.index:04X}h:{source.subindex:02X}{node}"


def _plain(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else f"{value:g}"


def judge_rest(axis: AxisConfig, motor: Sequence[int], load: Sequence[int]) -> Verdict:
    """Checks that both encoder readings are constant without power, and measures their noise."""
    motor_deg = 360.0 / axis.motor_encoder.counts_per_turn
    load_arcsec = axis.load_encoder.resolution_arcsec
    motor_span, load_span = max(motor) - min(motor), max(load) - min(load)
    noise_arcsec = pstdev(load) * load_arcsec
    figures = {
        "samples": len(motor),
        "motor_counts": motor[-1],
        "load_counts": load[-1],
        "motor_noise_counts": pstdev(motor),
        "motor_span_counts": motor_span,
        "load_noise_arcsec": noise_arcsec,
        "load_span_arcsec": load_span * load_arcsec,
    }
    text = (
        f"motor at {motor[-1]}, load at {load[-1]} counts; over {len(motor)} cycles noise "
        f"{figures['motor_noise_counts']:.2g} motor counts, {noise_arcsec:.2g} arcsec load "
        f"(span {motor_span} and {load_span} counts)"
    )
    remedies = []
    if motor_span > max(3.0, 0.1 / motor_deg):
        remedies.append(
            "the motor's encoder moves while the power is off: something turns the axis, or its encoder is "
            "noisy; check brake, shield and earth"
        )
    if load_span > max(4.0, 60.0 / load_arcsec):
        remedies.append(
            f"{axis.where(SOURCE)}: the load encoder moves by {load_span * load_arcsec:.0f} arcsec while the "
            "power is off; check that the object is a position, and the encoder's shield and mounting"
        )
    return judged(not remedies, text, *remedies, **figures)


def judge_channels(
    axis: AxisConfig, readings: Mapping[str, float | None], waited_s: float, rest: Verdict
) -> Verdict:
    """Adds the additional channels to the verdict on rest; None means that no reading was plausible."""
    text, figures, remedies = rest.measured, dict(rest.figures), list(rest.remedies)
    for key, value in readings.items():
        channel = axis.channels[key]
        name = key.replace("_", " ")
        if value is not None:
            text += f"; {name} {value:.4g} {BY_KEY[key].unit}"
            figures[BY_KEY[key].value] = value
        elif 2 * channel.every_cycles * axis.drive.cycle_s < waited_s:
            text += f"; no {name}"
            remedies.append(
                f"{axis.where(key)}: no plausible reading arrives (within {channel.scale.least:g} to "
                f"{channel.scale.greatest:g} {BY_KEY[key].unit}); check the sensor, the object and its unit"
            )
    return judged(not remedies, text, *remedies, **figures)


def judge_hold(axis: AxisConfig, before: Turned, readings: Sequence[Turned]) -> Verdict:
    """Checks that enabling the drive at rest caused no movement."""
    counts = axis.motor_encoder.counts_per_turn
    motor = max(abs(each.motor_counts - before.motor_counts) for each in readings)
    load = max(abs(each.load_counts - before.load_counts) for each in readings)
    load_arcsec = load * axis.load_encoder.resolution_arcsec
    text = f"enabled at rest: motor within {motor:.0f} counts, load within {load_arcsec:.3g} arcsec"
    figures = {"motor_moved_counts": motor, "load_moved_arcsec": load_arcsec}
    return judged(
        motor <= max(3.0, 0.5 / 360.0 * counts),
        text,
        "the axis jumps when power is switched on: check the drive's commutation and tuning, and that the "
        "brake opens only once the drive holds the axis",
        **figures,
    )


def judge_nudge(axis: AxisConfig, asked_counts: float, out_counts: float, back_counts: float) -> Verdict:
    """Checks that the motor followed a very small move, out and back."""
    figures = {"asked_counts": asked_counts, "out_counts": out_counts, "back_counts": back_counts}
    degrees = abs(axis.motor_encoder.degrees(asked_counts))
    went = f"went {out_counts:+.0f} and {back_counts:+.0f} counts"
    text = f"{degrees:.3g} motor deg: asked {asked_counts:+.0f}, {went}"
    slack = max(0.2 * abs(asked_counts), 3.0)
    if abs(out_counts - asked_counts) <= slack and abs(out_counts + back_counts) <= slack:
        return passed(text, **figures)
    still = abs(out_counts) <= slack
    return failed(
        f"{text}: the motor {'does not move' if still else 'does not follow'}",
        "check that the brake opens and that nothing blocks the axis; allow more torque: --torque-percent"
        if still
        else "check the drive's tuning and commutation with its own software",
        **figures,
    )


def judge_following(axis: AxisConfig, errors_counts: Sequence[int]) -> Verdict:
    """Compares the following error of a slow move with the window of the axis file."""
    worst = max(map(abs, errors_counts))
    worst_deg = abs(axis.motor_encoder.degrees(worst))
    allowed = axis.drive.following_error_deg
    share = worst_deg / allowed
    text = f"at most {worst_deg:.3g} motor deg, {100 * share:.0f} % of the window of {allowed:g} deg"
    figures = {"following_error_deg": worst_deg, "share_of_window": share}
    if share <= 0.5:
        return passed(text, **figures)
    key = axis.where("drive.following_error_deg")
    return failed(
        f"{text}, in a slow move",
        f"tune the drive; or {key}: found {allowed:g}, expected at least {3 * worst_deg:.2g}",
        **figures,
    )


def judge_torque(axis: AxisConfig, torques_permille: Sequence[float], limit_percent: float) -> Verdict:
    """Compares the motor torque of a slow move with its limit."""
    worst = max(map(abs, torques_permille)) / 10.0
    text = f"at most {worst:.1f} % of the rated torque, allowed {limit_percent:g} %"
    figures = {
        "torque_percent": worst,
        "torque_nm": worst / 100.0 * axis.drive.rated_torque_nm,
        "limit_percent": limit_percent,
    }
    return judged(
        worst < 0.9 * limit_percent,
        text,
        "a slow move needs all of the permitted torque: check brake, load and lubrication; or allow more: "
        f"--torque-percent, at most {axis.where('limits.torque_percent')}",
        **figures,
    )


def judge_settling(
    axis: AxisConfig, load_counts: Sequence[int], period_s: float, noise_arcsec: float
) -> Verdict:
    """Measures the settling time of the load; ``load_counts`` start at the end of the move."""
    tail = load_counts[-max(len(load_counts) // 5, 2) :]
    final = fmean(tail)
    band = max(2.0, (5.0 + 5.0 * noise_arcsec) / axis.load_encoder.resolution_arcsec)
    late = [place for place, each in enumerate(load_counts) if abs(each - final) > band]
    settle_s = (late[-1] + 1) * period_s if late else 0.0
    band_arcsec = band * axis.load_encoder.resolution_arcsec
    settled = settle_s <= 0.7 * len(load_counts) * period_s
    band_text = f"within {band_arcsec:.2g} arcsec {1e3 * settle_s:.0f} ms after the end of the move"
    return judged(
        settled,
        band_text if settled else f"not at rest {band_text}",
        "the axis hunts or swings: tune the drive with its own software",
        settling_s=settle_s,
        band_arcsec=band_arcsec,
    )


def judge_stop(
    axis: AxisConfig, speed_deg_s: float, distance_deg: float, time_s: float, what: str, reaction_s: float
) -> Verdict:
    """Checks that the axis stopped within the time and distance permitted by its ramp.

    Speed and distance are those of the motor. ``reaction_s`` is the time allowed before braking starts.
    """
    deceleration = axis.limits.acceleration_deg_s2 * axis.gear.ratio
    cycles_s = 3.0 * axis.drive.cycle_s + reaction_s
    time_allowed_s = cycles_s + speed_deg_s / deceleration + 0.2
    way_allowed_deg = speed_deg_s * (cycles_s + 0.05) + speed_deg_s**2 / (2.0 * deceleration) + 1.0
    figures = {
        "speed_motor_deg_s": speed_deg_s,
        "distance_motor_deg": distance_deg,
        "distance_load_arcsec": distance_deg / axis.gear.ratio * ARCSEC_PER_DEG,
        "time_s": time_s,
        "allowed_motor_deg": way_allowed_deg,
        "allowed_s": time_allowed_s,
    }
    text = (
        f"{what}: from {speed_deg_s:.3g} motor deg/s in {distance_deg:.3g} deg and {1e3 * time_s:.0f} ms "
        f"(allowed {way_allowed_deg:.3g} deg, {1e3 * time_allowed_s:.0f} ms)"
    )
    return judged(
        distance_deg <= way_allowed_deg and time_s <= time_allowed_s,
        text,
        f"the drive brakes more slowly than its ramp: {axis.where('drive.quick_stop_option')} (605Ah) "
        f"selects the ramp, {axis.where('limits.acceleration_deg_s2')} its slope (6085h); see the drive's "
        "manual",
        **figures,
    )
