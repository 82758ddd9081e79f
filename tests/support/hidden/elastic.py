"""Injects causes into the gear's stiffness, friction, load and hysteresis."""

import cmath
import math

from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.loaded_plant import GRAVITY_M_S2
from hdbridge.sim.truth import MaxwellSlip, RollingFriction, SlipElement
from support.hidden.site import ARCSEC_PER_RAD, Hidden, Site, solve


def hang_mass(site: Site, torque_nm: float) -> float:
    """Adds an eccentric mass with this peak torque to the load; returns the angle at which it hangs down."""
    arm_m = site.uniform(0.08, 0.25)
    down_deg = site.angle_deg()
    site.load["gravity"] = {
        "mass_kg": torque_nm / GRAVITY_M_S2 / arm_m,
        "arm_m": arm_m,
        "down_deg": down_deg,
        "tilt_deg": 0.0,
    }
    return down_deg


def compliance(site: Site) -> Hidden:
    """Injects an eccentric mass on the load, with a linear or a stiffening gear."""
    stiffness = site.truth.gear.stiffness_nm_per_rad
    torque_nm = site.size_arcsec / ARCSEC_PER_RAD * stiffness
    if site.rng.random() < 0.5:
        # Typical catalogue values, but no stiffer than the simulation's time step resolves.
        third = min(site.uniform(1.4, 2.0), 0.98 * site.truth.highest_stiffness_nm_per_rad / stiffness)
        second = site.uniform(1.0 + 0.3 * (third - 1.0), 1.0 + 0.7 * (third - 1.0))
        first_nm, second_nm = site.uniform(0.3, 0.5) * torque_nm, site.uniform(0.6, 0.9) * torque_nm
        site.gear["stiffening"] = {
            "first_torque_nm": first_nm,
            "second_stiffness_nm_per_rad": second * stiffness,
            "second_torque_nm": second_nm,
            "third_stiffness_nm_per_rad": third * stiffness,
        }
        whole = first_nm + (second_nm - first_nm) / second + (torque_nm - second_nm) / third
        for key in ("first_torque_nm", "second_torque_nm"):
            site.gear["stiffening"][key] *= torque_nm / whole
        torque_nm *= torque_nm / whole
    down_deg = hang_mass(site, torque_nm)
    return Hidden(
        "compliance",
        site.size_arcsec,
        "wind-up under the highest torque",
        f"a mass of {torque_nm:.2f} Nm on a spring of {stiffness:.0f} Nm/rad"
        + (", stiffer in two stages" if site.gear["stiffening"] else ""),
        {
            "torque_nm": torque_nm,
            "down_deg": down_deg,
            "stiffness_nm_per_rad": stiffness,
            "compliance_arcsec_per_nm": site.size_arcsec / torque_nm,
        },
    )


def inertial_windup(site: Site) -> Hidden:
    """Injects a heavier load and a softer gear; the wind-up is at least that of the unchanged axis."""
    acceleration = math.radians(site.run.load_acceleration_deg_s2)
    inertia = site.truth.load_.whole_inertia_kg_m2
    present = inertia * acceleration / site.truth.gear.stiffness_nm_per_rad * ARCSEC_PER_RAD
    size = max(site.size_arcsec, present)
    more = size / present
    heavier = more ** site.uniform(0.2, 0.5)
    site.load["inertia_kg_m2"] += (heavier - 1.0) * inertia
    site.gear["stiffness_nm_per_rad"] *= heavier / more
    # Keeps the damping ratio.
    site.gear["damping_nm_s_per_rad"] *= heavier / math.sqrt(more)
    frequency_hz = math.sqrt(acceleration / size * ARCSEC_PER_RAD) / math.tau
    _commission_servo(site, heavier, frequency_hz)
    return Hidden(
        "inertial_windup",
        size,
        f"wind-up at {site.run.load_acceleration_deg_s2:g} deg/s^2",
        f"load on its spring at {frequency_hz:.1f} Hz",
        {"frequency_hz": frequency_hz, "seconds_squared": 1.0 / (math.tau * frequency_hz) ** 2},
    )


def _commission_servo(site: Site, heavier: float, frequency_hz: float) -> None:
    """Adjusts the servo's feed-forward to the new load, as a commissioning would."""
    known = site.part("servo")["load_feedforward"]
    if known is not None:
        known["inertia_kg_m2"] *= heavier
        known["frequency_hz"] = frequency_hz


def velocity_windup(site: Site) -> Hidden:
    """Injects shear-thinning grease at the output, with a little Coulomb friction."""
    stiffness = site.truth.gear.stiffness_nm_per_rad
    torque_nm = site.size_arcsec / ARCSEC_PER_RAD * stiffness
    speed = math.radians(site.run.load_speed_deg_s)
    share = site.uniform(0.0, 0.1)
    thinning = {"speed_rad_s": speed * site.stretched(0.2, 3.0), "exponent": site.uniform(0.2, 0.6)}
    thinned = (1.0 + speed / thinning["speed_rad_s"]) ** thinning["exponent"]
    site.load["viscous_nm_s_per_rad"] += (1.0 - share) * torque_nm / speed * thinned
    site.load["coulomb_nm"] += share * torque_nm
    site.load["thinning"] = thinning
    return Hidden(
        "velocity_windup",
        site.size_arcsec,
        f"wind-up at {site.run.load_speed_deg_s:g} deg/s",
        f"drag of {torque_nm:.3g} Nm on the output, {100 * share:.0f} % of it Coulomb friction",
        {
            "torque_nm": torque_nm,
            "coulomb_nm": share * torque_nm,
            "viscous_nm_s_per_rad": site.load["viscous_nm_s_per_rad"],
            **thinning,
        },
    )


def backlash(site: Site) -> Hidden:
    """Injects backlash behind the gear: between gear and load, or in the load encoder's coupling."""
    play_arcsec = 2.0 * site.size_arcsec
    if site.load["encoder"]["coupling"] is not None and site.rng.random() < 0.5:
        site.load["encoder"]["coupling"]["play_arcsec"] += play_arcsec
        where = "the coupling to the load encoder"
    else:
        # Friction holds the load within the backlash. It adds some wind-up, which is subtracted.
        inertia = site.truth.load_.whole_inertia_kg_m2
        friction_nm = 1.5 * inertia * math.radians(site.run.load_acceleration_deg_s2)
        per_nm = ARCSEC_PER_RAD / site.truth.gear.stiffness_nm_per_rad
        friction_nm = min(friction_nm, 0.3 * site.size_arcsec / per_nm)
        site.load["coulomb_nm"] = max(site.load["coulomb_nm"], friction_nm)
        site.gear["backlash_arcsec"] += play_arcsec - 2.0 * friction_nm * per_nm
        where = "the coupling between gear and load"
    return Hidden(
        "backlash",
        site.size_arcsec,
        "half of the play, either side of the middle",
        f"play of {play_arcsec:.2f} arcsec in {where}",
        {"gap_arcsec": play_arcsec},
    )


def _rolling(site: Site) -> RollingFriction:
    law = site.truth.gear.hysteresis
    if not isinstance(law, RollingFriction):
        raise ValueError("this needs an axis with the hysteresis law rolling_friction")
    return law


def remembering(law: RollingFriction, share: float = 1.0, elements: int = 18) -> MaxwellSlip:
    """Returns the Maxwell slip law whose branches from saturation are those of a rolling friction law."""
    n = law.exponent

    def crossed(part: float) -> float:
        if n == 2.0:
            return part * (1.0 - math.log(part))
        return float((part ** (n - 1.0) - (n - 1.0) * part) / (2.0 - n))

    # Ends of the straight segments that approximate the branch, spaced for equal maximum errors.
    points = [(each / elements) ** (2.0 / (n - 1.0)) for each in range(elements + 1)]
    heights = [0.0] + [crossed(each) for each in points[1:]]
    pairs = zip(zip(points, heights, strict=True), zip(points[1:], heights[1:], strict=False), strict=False)
    slopes = [(h1 - h0) / (x1 - x0) for (x0, h0), (x1, h1) in pairs] + [0.0]
    return MaxwellSlip(
        law="maxwell_slip",
        elements=tuple(
            SlipElement(
                limit_arcsec=max(
                    0.0, share * law.offset_arcsec * (slopes[i] - slopes[i + 1]) * points[i + 1]
                ),
                yield_deg=0.5 * points[i + 1] * law.width_deg,
            )
            for i in range(elements)
        ),
    )


def hysteresis_memory(site: Site) -> Hidden:
    """Injects return-point memory into part of the hysteresis loop, or into all of it."""
    law = _rolling(site)
    whole = _missed_arcsec(law)
    share = min(1.0, site.size_arcsec / whole)
    memory = remembering(law, share, site.rng.randint(10, 24))
    if share < 1.0:
        less = {"offset_arcsec": (1.0 - share) * law.offset_arcsec, "start_arcsec": 0.0}
        site.gear["hysteresis"] = law.model_copy(update=less).model_dump()
        site.gear["second_hysteresis"] = memory.model_dump()
    else:
        site.gear["hysteresis"] = memory.model_dump()
    return Hidden(
        "hysteresis_memory",
        share * whole,
        "highest miss of the law without memory after a return within the loop",
        f"{100 * share:.0f} % of the loop has return-point memory",
        {"share": share},
    )


def _missed_arcsec(law: RollingFriction) -> float:
    """Returns the maximum difference between the laws with and without memory on nested loops, arcsec."""
    worst = 0.0
    for back in (0.05, 0.1, 0.2, 0.4):
        forgetting, memory = law_of(law, 0.0), law_of(remembering(law), 0.0)
        assert forgetting is not None
        assert memory is not None
        here = 0.0
        for goal in (3.0, 2.5, 2.5 + back, 2.5 - back, 1.0):
            for step in range(1, 101):
                at_deg = (here + (goal - here) * step / 100.0) * law.width_deg
                worst = max(worst, abs(forgetting.advance(at_deg) - memory.advance(at_deg)))
            here = goal
    return worst


def hysteresis_parameters(site: Site) -> Hidden:
    """Injects a hysteresis loop that differs from the calibrated one in height, or is wider."""
    law = _rolling(site)
    changed = {"start_arcsec": 0.0}
    size = site.size_arcsec
    if site.rng.random() < 0.5:
        rises = site.rng.random() < 0.5 or size > 0.6 * law.offset_arcsec
        changed["offset_arcsec"] = law.offset_arcsec + (size if rises else -size)
    else:
        wider = law.model_copy(update={"start_arcsec": 0.0})

        def miss(factor: float) -> float:
            return _crossing_miss(law, wider.model_copy(update={"width_deg": factor * law.width_deg}))

        factor = solve(miss, size, 1.001, 4.0)
        size = miss(factor)
        changed["width_deg"] = factor * law.width_deg
    there = law.model_copy(update=changed)
    site.gear["hysteresis"] = there.model_dump()
    return Hidden(
        "hysteresis_parameters",
        size,
        "highest difference between the loops",
        f"offset {law.offset_arcsec:.1f} is now {there.offset_arcsec:.1f} arcsec, "
        f"width {law.width_deg:.1f} is now {there.width_deg:.1f} deg",
        {"offset_arcsec": there.offset_arcsec, "width_deg": there.width_deg, "exponent": there.exponent},
    )


def _crossing_miss(one: RollingFriction, other: RollingFriction) -> float:
    worst = 0.0
    laws = [law_of(one, 0.0), law_of(other, 0.0)]
    for step in range(200):
        at_deg = 20.0 * one.width_deg if step == 0 else (20.0 - step / 50.0) * one.width_deg
        errors = [law.advance(at_deg) for law in laws if law is not None]
        worst = max(worst, abs(errors[0] - errors[1]))
    return worst


def rate_dependence(site: Site) -> Hidden:
    """Injects a hysteresis loop that grows with speed."""
    law = site.truth.gear.hysteresis
    if law is None:
        raise ValueError("this needs an axis with hysteresis")
    if isinstance(law, MaxwellSlip):
        offset = sum(each.limit_arcsec for each in law.elements)
    else:
        offset = law.offset_arcsec
    speed = site.run.load_speed_deg_s * site.truth.gear.ratio
    from_deg_s = site.stretched(1.0, 10.0)
    per_decade = site.size_arcsec / offset / math.log10(1.0 + speed / from_deg_s)
    site.gear["rate_dependence"] = {
        "growth_per_decade": per_decade,
        "from_deg_s": from_deg_s,
        "time_constant_s": site.stretched(0.02, 0.2),
    }
    return Hidden(
        "rate_dependence",
        site.size_arcsec,
        f"growth of the offset at {site.run.load_speed_deg_s:g} deg/s of the load",
        f"the loop grows by {100 * per_decade:.1f} % per decade of speed above {from_deg_s:.1f} motor deg/s",
        {"growth_per_decade": per_decade, "from_deg_s": from_deg_s},
    )


def vibration(site: Site) -> Hidden:
    """Injects the vibration of a machine nearby."""
    frequency_hz = site.stretched(2.0, 18.0)
    gear, load = site.truth.gear, site.truth.load_
    turn = math.tau * frequency_hz
    inertia = load.whole_inertia_kg_m2
    stiffness = gear.stiffness_nm_per_rad - inertia * turn**2 + 1j * turn * gear.damping_nm_s_per_rad
    per_nm = ARCSEC_PER_RAD / cmath.polar(stiffness)[0]
    coupling = load.encoder.coupling
    if coupling is not None:
        part = frequency_hz / coupling.frequency_hz
        lag = 2j * coupling.damping_ratio * part
        per_nm *= cmath.polar((1.0 + lag) / (1.0 - part**2 + lag))[0]
    shake = {
        "frequency_hz": frequency_hz,
        "torque_nm": site.size_arcsec / per_nm,
        "phase_deg": site.angle_deg(),
    }
    site.load["vibration"] = (*site.load["vibration"], shake)
    text = f"a machine nearby shakes the load at {frequency_hz:.3f} Hz"
    return Hidden(
        "vibration",
        site.size_arcsec,
        "amplitude with the motor held",
        text,
        {"frequency_hz": frequency_hz, "amplitude_arcsec": site.size_arcsec},
    )
