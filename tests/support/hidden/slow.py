"""Injects slow causes: temperature, wear, creep."""

import math

from support.hidden.site import Hidden, Site


def _warm(site: Site) -> float:
    """Makes the axis warm up or cool down during the run; returns the change in kelvin."""
    heat = site.part("temperature")
    duration_s = site.run.duration_s
    change_k = site.sign() * site.uniform(4.0, 12.0)
    heat["time_constant_s"] = site.uniform(0.25, 0.8) * duration_s
    if site.rng.random() < 0.6:
        # The axis starts cold or warm and approaches the ambient temperature.
        passed = -math.expm1(-duration_s / heat["time_constant_s"])
        heat["start_c"] = heat["ambient_c"] - change_k / passed
    else:
        # The ambient temperature changes, and the axis follows.
        tau = heat["time_constant_s"]
        followed = duration_s - tau * -math.expm1(-duration_s / tau)
        heat["ambient_k_per_hour"] = change_k / followed * 3600.0
    return change_k


def zero_drift(site: Site) -> Hidden:
    """Injects a zero drift with temperature."""
    change_k = _warm(site)
    per_k = site.sign() * site.size_arcsec / abs(change_k)
    site.part("temperature")["zero_drift_arcsec_per_k"] = per_k
    return Hidden(
        "zero_drift",
        site.size_arcsec,
        "change from start to end",
        f"the zero moves by {per_k:.3f} arcsec/K, {change_k:+.1f} K from start to end",
        {"arcsec_per_k": per_k, "change_k": change_k},
    )


def amplitude_drift(site: Site) -> Hidden:
    """Injects a tooth error that changes with temperature, sometimes together with the friction."""
    change_k = _warm(site)
    heat = site.part("temperature")
    heat["reference_c"] = heat["ambient_c"] if heat["start_c"] is None else heat["start_c"]
    per_k = site.sign() * min(site.size_arcsec / site.tooth_peak_arcsec(), 0.8) / abs(change_k)
    heat["tooth_growth_per_k"] = per_k
    if site.rng.random() < 0.3:
        heat["friction_growth_per_k"] = 0.1 * per_k
    return Hidden(
        "amplitude_drift",
        abs(per_k * change_k) * site.tooth_peak_arcsec(),
        "peak of the change from start to end",
        f"the tooth error grows by {100 * per_k:.2f} %/K, {change_k:+.1f} K from start to end",
        {"growth_per_k": per_k, "change_k": change_k},
    )


def wear(site: Site) -> Hidden:
    """Injects lost motion between the teeth that grows with the motor's travel."""
    exponent = site.uniform(0.7, 1.0)
    per_1000 = site.size_arcsec / (site.run.motor_turns / 1000.0) ** exponent
    site.gear["wear"] = {"arcsec_per_1000_turns": per_1000, "exponent": exponent}
    return Hidden(
        "wear",
        site.size_arcsec,
        "lost motion, one way, at the end",
        f"lost motion grows to {site.size_arcsec:.2f} arcsec in {site.run.motor_turns:.0f} motor turns",
        {"arcsec_per_1000_turns": per_1000, "exponent": exponent, "end_arcsec": site.size_arcsec},
    )


def creep(site: Site) -> Hidden:
    """Injects creep of the gear, which yields in motion and recovers after a stop."""
    times = [site.stretched(1.0, 4.0)]
    shares = [1.0]
    if site.rng.random() < 0.5:
        times.append(times[0] * site.uniform(4.0, 8.0))
        shares = [site.uniform(0.4, 0.7)]
        shares.append(1.0 - shares[0])
    site.gear["creep"] = [
        {"time_constant_s": time_s, "amplitude_arcsec": share * site.size_arcsec}
        for time_s, share in zip(times, shares, strict=True)
    ]
    text = " and ".join(
        f"{share * site.size_arcsec:.2f} arcsec in {time_s:.2f} s"
        for time_s, share in zip(times, shares, strict=True)
    )
    return Hidden(
        "creep",
        site.size_arcsec,
        "yield after long motion, all elements",
        f"the gear yields by {text}",
        {"amplitude_arcsec": site.size_arcsec, "time_constant_s": times[0]},
    )
