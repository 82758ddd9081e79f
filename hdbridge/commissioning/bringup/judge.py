"""Judgement of the measured figures, separate from their measurement. Pure."""

from collections.abc import Mapping, Sequence
from statistics import fmean, pstdev

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.commissioning.bringup.checks import Verdict, failed, passed
from hdbridge.commissioning.bringup.scale import SOURCE, Turned
from hdbridge.units import ARCSEC_PER_DEG


def judge_rest(axis: AxisConfig, motor: Sequence[int], load: Sequence[int]) -> Verdict:
    """Checks that both encoders stand still without power, and measures their noise."""
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
    return failed(text, *remedies, **figures) if remedies else passed(text, **figures)


def judge_channels(
    axis: AxisConfig, readings: Mapping[str, float | None], waited_s: float, rest: Verdict
) -> Verdict:
    """Adds load torque and temperature to the verdict on rest; None is no plausible reading."""
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
                f"{axis.where(key)}: nothing comes that can be believed (within {channel.scale.least:g} to "
                f"{channel.scale.greatest:g} {BY_KEY[key].unit}); check the sensor, the object and its unit"
            )
    return failed(text, *remedies, **figures) if remedies else passed(text, **figures)


def judge_hold(axis: AxisConfig, before: Turned, readings: Sequence[Turned]) -> Verdict:
    """Checks that enabling the drive at rest caused no movement."""
    counts = axis.motor_encoder.counts_per_turn
    motor = max(abs(each.motor_counts - before.motor_counts) for each in readings)
    load = max(abs(each.load_counts - before.load_counts) for each in readings)
    load_arcsec = load * axis.load_encoder.resolution_arcsec
    text = f"enabled at rest: motor within {motor:.0f} counts, load within {load_arcsec:.3g} arcsec"
    figures = {"motor_moved_counts": motor, "load_moved_arcsec": load_arcsec}
    if motor > max(3.0, 0.5 / 360.0 * counts):
        return failed(
            text,
            "the axis jumps when power comes: check the drive's commutation and tuning, and that its brake "
            "opens after it holds",
            **figures,
        )
    return passed(text, **figures)


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
    """Compares the following error of a slow move with the window."""
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
    """Compares the torque of a slow move with its limit."""
    worst = max(map(abs, torques_permille)) / 10.0
    text = f"at most {worst:.1f} % of the rated torque, allowed {limit_percent:g} %"
    figures = {
        "torque_percent": worst,
        "torque_nm": worst / 100.0 * axis.drive.rated_torque_nm,
        "limit_percent": limit_percent,
    }
    if worst < 0.9 * limit_percent:
        return passed(text, **figures)
    return failed(
        text,
        "a slow move needs all the torque that it may have: check brake, load and lubrication; or allow "
        f"more: --torque-percent, at most {axis.where('limits.torque_percent')}",
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
    text = f"within {band_arcsec:.2g} arcsec {1e3 * settle_s:.0f} ms after the end of the move"
    figures = {"settling_s": settle_s, "band_arcsec": band_arcsec}
    if settle_s <= 0.7 * len(load_counts) * period_s:
        return passed(text, **figures)
    return failed(
        f"not at rest within {band_arcsec:.2g} arcsec {1e3 * settle_s:.0f} ms after the end of the move",
        "the axis hunts or swings: tune the drive with its own software",
        **figures,
    )


def judge_stop(
    axis: AxisConfig, speed_deg_s: float, distance_deg: float, time_s: float, what: str, reaction_s: float
) -> Verdict:
    """Checks that the axis stopped within the time and travel that its ramp allows.

    Speed and distance are the motor's. ``reaction_s`` may pass before braking starts.
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
    if distance_deg <= way_allowed_deg and time_s <= time_allowed_s:
        return passed(text, **figures)
    return failed(
        text,
        f"the drive brakes more slowly than its ramp: {axis.where('drive.quick_stop_option')} (605Ah) says "
        f"which ramp, {axis.where('limits.acceleration_deg_s2')} how steep it is (6085h); see the drive's "
        "manual",
        **figures,
    )
