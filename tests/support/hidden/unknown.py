"""Injects causes outside the catalogue, for which "unexplained" is the right finding."""

from support.hidden.site import Hidden, Site


def roller(site: Site) -> Hidden:
    """Injects a roller on the motor's hub, with its own order, that is pressed on near one load angle."""
    truth = {
        "order": site.uniform(0.55, 4.5),
        "amplitude_arcsec": site.size_arcsec,
        "phase_deg": site.angle_deg(),
        "pressed_at_deg": site.load_angle_deg() % 360.0,
        "sharpness": site.stretched(1.5, 8.0),
    }
    site.gear["roller"] = truth
    text = f"a roller with {truth['order']:.4f} turns per motor turn, pressed on near one load angle"
    return Hidden("unexplained", site.size_arcsec, "amplitude where it is pressed on most", text, truth)


def seat(site: Site) -> Hidden:
    """Injects a bearing ring that slips in its seat at random angles."""
    truth = {
        "slip_arcsec": site.size_arcsec,
        "travel_deg": site.stretched(60.0, 400.0),
        "seed": site.rng.randrange(10**6),
    }
    site.gear["seat"] = truth
    text = f"a bearing ring is carried along by up to {site.size_arcsec:.1f} arcsec, and slips at random"
    return Hidden("unexplained", site.size_arcsec, "highest before it slips", text, truth)


def cable(site: Site) -> Hidden:
    """Injects a cable that pulls the load encoder's body beyond a load angle."""
    low, high = site.run.load_reach_deg
    from_deg = low + site.uniform(0.35, 0.65) * (high - low)
    drag = site.uniform(0.2, 0.5)
    truth = {
        "taut_from_deg": from_deg,
        "arcsec_per_deg": site.sign() * site.size_arcsec / (high - from_deg) / (1.0 + drag),
        "drag": drag,
    }
    site.load["encoder"]["cable"] = truth
    text = f"the load encoder's cable pulls its body beyond {from_deg:.0f} deg"
    return Hidden("unexplained", site.size_arcsec, "at the end of the reach, on the way out", text, truth)


def sensor_warming(site: Site) -> Hidden:
    """Injects warming of the load encoder in proportion to the square of its speed."""
    time_constant_s = site.uniform(0.02, 0.06) * site.run.duration_s
    truth = {
        "arcsec_at_10_deg_s": site.sign() * site.size_arcsec * (10.0 / site.run.load_speed_deg_s) ** 2,
        "time_constant_s": time_constant_s,
    }
    site.load["encoder"]["sensor_warming"] = truth
    text = f"the load encoder warms with the square of its speed, with {time_constant_s:.0f} s"
    return Hidden("unexplained", site.size_arcsec, "after long motion at the highest speed", text, truth)
