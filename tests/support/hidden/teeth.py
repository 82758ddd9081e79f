"""Injects causes into the teeth: orders, flanks, damage, number of teeth."""

from hdbridge.sim.loaded_plant import GRAVITY_M_S2
from support.hidden.elastic import hang_mass
from support.hidden.site import ARCSEC_PER_RAD, ARCSEC_PER_TURN, Hidden, Site, solve


def motor_order(site: Site) -> Hidden:
    """Injects a motor order that the axis does not have yet."""
    taken = {each.order for each in site.truth.gear.motor_orders}
    order = site.rng.choice([k for k in (3, 5, 7, 9, 10, 11, 12) if k not in taken])
    term = {"order": order, "amplitude_arcsec": site.size_arcsec, "phase_deg": site.angle_deg()}
    site.gear["motor_orders"] = (*site.gear["motor_orders"], term)
    return Hidden(
        "motor_order", site.size_arcsec, "amplitude", f"order {order} of the motor in the tooth error", term
    )


def flexspline_order(site: Site) -> Hidden:
    """Injects an order of the angle between wave generator and flexspline."""
    taken = {each.order for each in site.truth.gear.flexspline_orders}
    order = site.rng.choice([k for k in (1, 2, 2, 3, 4, 5, 6) if k not in taken])
    term = {"order": order, "amplitude_arcsec": site.size_arcsec, "phase_deg": site.angle_deg()}
    site.gear["flexspline_orders"] = (*site.gear["flexspline_orders"], term)
    text = f"order {order} of the flexspline's teeth, {order} (1 + 1/N) of the motor"
    return Hidden("flexspline_order", site.size_arcsec, "amplitude", text, term)


def direction_phase(site: Site) -> Hidden:
    """Injects a shifted tooth error of the other flank, which carries the load after a reversal."""
    shift_deg = solve(site.tooth_peak_arcsec, site.size_arcsec, 0.01, 15.0)
    flank = {"shift_deg": site.sign() * shift_deg, "travel_deg": site.stretched(0.2, 2.0)}
    site.gear["flank"] = flank
    return Hidden(
        "direction_phase",
        site.tooth_peak_arcsec(shift_deg),
        "peak of the change against the mean of both flanks",
        f"tooth error of the two flanks {2 * flank['shift_deg']:.2f} motor deg apart",
        flank,
    )


def torque_modulation(site: Site) -> Hidden:
    """Injects a tooth error that grows with the torque of an eccentric mass on the load."""
    load, size = site.truth.load_, site.size_arcsec
    nm_per_arcsec = site.truth.gear.stiffness_nm_per_rad / ARCSEC_PER_RAD
    brings: tuple[str, ...] = ("compliance",)
    if load.gravity is None:
        # The tooth error changes less than the gear winds up.
        torque_nm = site.uniform(3.0, 6.0) * size * nm_per_arcsec
        hang_mass(site, torque_nm)
    else:
        torque_nm = load.gravity.mass_kg * load.gravity.arm_m * GRAVITY_M_S2
        size = min(size, 0.5 * torque_nm / nm_per_arcsec)
        brings = ()
    per_nm = size / torque_nm / site.tooth_peak_arcsec()
    site.gear["torque_growth_per_nm"] = per_nm
    return Hidden(
        "torque_modulation",
        size,
        "peak of the change at the highest torque",
        f"tooth error grows by {100 * per_nm:.2f} % per Nm, under a mass of {torque_nm:.2f} Nm",
        {"growth_per_nm": per_nm, "torque_nm": torque_nm},
        brings,
    )


def ratio_error(site: Site) -> Hidden:
    """Injects a gear ratio that differs from the axis file."""
    ratio = site.truth.gear.ratio
    part = site.sign() * site.size_arcsec / ARCSEC_PER_TURN
    site.gear["ratio"] = ratio / (1.0 + part)
    return Hidden(
        "ratio_error",
        site.size_arcsec,
        "error after one turn of the load",
        f"ratio {site.gear['ratio']:.7g} in place of {ratio:.7g}",
        {"ratio": site.gear["ratio"], "arcsec_per_motor_turn": part * ARCSEC_PER_TURN / ratio},
    )


def local_defect(site: Site) -> Hidden:
    """Injects a damaged tooth."""
    bump = {
        "at_deg": (site.load_angle_deg() + 180.0) % 360.0 - 180.0,
        "width_deg": site.stretched(2.0, 10.0),
        "height_arcsec": site.sign() * site.size_arcsec,
    }
    site.gear["damage"] = (*site.gear["damage"], bump)
    text = f"a bump {bump['width_deg']:.1f} deg wide at load angle {bump['at_deg']:.1f} deg"
    return Hidden("local_defect", site.size_arcsec, "height", text, bump)
