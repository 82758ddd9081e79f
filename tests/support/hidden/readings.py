"""Injects causes into the encoders: geometry, signals, late samples, lost counts."""

import math
from typing import Any

from hdbridge.sim.encoder import Signals
from hdbridge.sim.truth.encoder import TrueSignals
from support.hidden.site import ARCSEC_PER_RAD, ARCSEC_PER_TURN, Hidden, Site


def _disc(site: Site, arcsec: float, second: float) -> dict[str, Any]:
    """Returns a disc with a first-order error of ``arcsec`` at its shaft, and a second-order error that is
    ``second`` times as large.
    """
    radius_mm = site.stretched(12.0, 60.0)
    off_um = arcsec / ARCSEC_PER_RAD * radius_mm * 1000.0
    return {
        "radius_mm": radius_mm,
        "eccentricity_um": off_um,
        "eccentric_at_deg": site.angle_deg(),
        "ovality_um": second * off_um,
        "oval_at_deg": site.angle_deg(),
    }


def motor_encoder_eccentricity(site: Site) -> Hidden:
    """Injects an eccentric disc of the motor encoder."""
    second = site.rng.choice((0.0, site.uniform(0.1, 0.3)))
    disc = _disc(site, site.size_arcsec * site.truth.gear.ratio, second)
    site.part("motor", "encoder")["disc"] = disc
    return Hidden(
        "motor_encoder_eccentricity",
        site.size_arcsec,
        "amplitude of the first order",
        f"motor encoder's disc {disc['eccentricity_um']:.1f} um off, radius {disc['radius_mm']:.1f} mm",
        {"amplitude_arcsec": site.size_arcsec, "second_arcsec": second * site.size_arcsec},
    )


def load_order(site: Site) -> Hidden:
    """Injects an eccentric disc of the load encoder, or a pitch error of the spline."""
    second = site.rng.choice((0.0, site.uniform(0.1, 0.4)))
    if site.rng.random() < 0.5:
        disc = _disc(site, site.size_arcsec, second)
        site.load["encoder"]["disc"] = disc
        text = (
            f"load encoder's disc {disc['eccentricity_um']:.2f} um off at a radius of "
            f"{disc['radius_mm']:.1f} mm"
        )
    else:
        terms = [{"order": 1, "amplitude_arcsec": site.size_arcsec, "phase_deg": site.angle_deg()}]
        if second:
            amplitude = second * site.size_arcsec
            terms.append({"order": 2, "amplitude_arcsec": amplitude, "phase_deg": site.angle_deg()})
        site.gear["load_orders"] = terms
        text = "pitch error of the spline, once per turn of the load"
    return Hidden(
        "load_order",
        site.size_arcsec,
        "amplitude of the first order",
        text,
        {"amplitude_arcsec": site.size_arcsec, "second_arcsec": second * site.size_arcsec},
    )


def channel_skew(site: Site) -> Hidden:
    """Injects a delay of one encoder's samples relative to the other's."""
    late_ms = site.size_arcsec / (site.run.load_speed_deg_s * 3600.0) * 1000.0
    load = site.rng.random() < 0.5
    encoder = site.load["encoder"] if load else site.part("motor", "encoder")
    encoder["late_ms"] += late_ms
    return Hidden(
        "channel_skew",
        site.size_arcsec,
        f"error at {site.run.load_speed_deg_s:g} deg/s of the load",
        f"the {'load' if load else 'motor'} encoder's sample is {late_ms:.3f} ms old",
        {"delay_ms": late_ms if load else -late_ms},
    )


def subdivisional_error(site: Site) -> Hidden:
    """Injects imperfect sine and cosine signals of the load encoder."""
    part = site.stretched(0.006, 0.04)
    lines = max(180, min(15_000, round(part * ARCSEC_PER_TURN / site.size_arcsec)))
    shares = [site.uniform(0.2, 1.0), site.uniform(0.0, 1.0), site.uniform(0.0, 0.4)]
    turned = math.radians(site.angle_deg())
    signals = {
        "sine_offset": shares[0] * math.sin(turned),
        "cosine_offset": shares[0] * math.cos(turned),
        "gain_mismatch": site.sign() * shares[1],
        "phase_mismatch_deg": site.sign() * math.degrees(site.uniform(0.0, 0.5)) * shares[1],
        "third_harmonic": site.sign() * shares[2],
    }
    scale = 0.01
    for _ in range(4):  # the error is nearly linear in the imperfections
        scaled = {key: value * scale for key, value in signals.items()}
        errs = Signals(TrueSignals(lines_per_turn=lines, **scaled))
        peak = max(abs(errs.error_deg(360.0 * each / 500 / lines)) for each in range(500)) * 3600.0
        scale = min(scale * site.size_arcsec / peak, 0.3)
    truth = {"lines_per_turn": lines, **{key: value * scale for key, value in signals.items()}}
    site.load["encoder"]["signals"] = truth
    return Hidden(
        "subdivisional_error",
        peak,
        "peak within a line",
        f"signals of {lines} lines per turn with offsets, unequal gains and harmonics of {100 * scale:.1f} %",
        {"lines_per_turn": lines},
    )


def count_loss(site: Site) -> Hidden:
    """Injects a loss of encoder counts at a random time."""
    motor = site.rng.random() < 0.4
    encoder = site.part("motor", "encoder") if motor else site.load["encoder"]
    per_count = ARCSEC_PER_TURN / encoder["counts_per_turn"] / (site.truth.gear.ratio if motor else 1.0)
    counts = max(1, round(site.size_arcsec / per_count))
    time_s = site.uniform(0.15, 0.85) * site.run.duration_s
    sign = 1 if site.rng.random() < 0.5 else -1
    loss = {"time_s": time_s, "counts": sign * counts}
    encoder["losses"] = (*encoder["losses"], loss)
    forward = sign * encoder["direction"] * (-1.0 if motor else 1.0)
    return Hidden(
        "count_loss",
        counts * per_count,
        "step",
        f"{counts} counts of the {'motor' if motor else 'load'} encoder lost at {time_s:.1f} s",
        {"time_s": time_s, "step_arcsec": forward * counts * per_count},
    )
