"""Effects of spring, friction, play and loop, as the plant has them; see `hdbridge.twin.translation`."""

from __future__ import annotations

import cmath
import math
from typing import Any, Final

import numpy as np

from hdbridge.effects import (
    Backlash,
    Compliance,
    Hysteresis,
    HysteresisMemory,
    HysteresisParameters,
    InertialWindup,
    RateDependence,
    VelocityWindup,
    Vibration,
)
from hdbridge.twin.draft import ARCSEC_PER_RAD, Draft, Said, none
from hdbridge.twin.sliders import branch, elements
from hdbridge.units import ARCSEC_PER_DEG

NODES: Final = 24
"""Of a branch; straight between them it is off by less than a hundredth of the offset."""
SLIDERS: Final = 16
"""As many as a truth file may have at the load."""
DRY_TIME_S: Final = 0.01
"""Within which a drag by the direction alone comes and goes: within two or three control cycles."""
HIGHEST_SHAKE_HZ: Final = 500.0
HOLDS: Final = 1.5
"""Friction over the load's inertia at the axis's highest acceleration, to hold it in a dead zone."""
MOST_HELD: Final = 0.3
"""Of half a gap, the most that this friction may wind up the spring by."""


def compliance(effect: Compliance, draft: Draft) -> Said:
    """The spring in up to three stages, as far as the effect's torque goes.

    A torque at the motor is one at the load divided by the ratio.
    """
    times = draft.ratio if effect.torque == "motor_torque_nm" else 1.0
    notes = []
    stages: list[float] = []
    zones = (
        (0.0, effect.c1_arcsec_per_nm),
        (effect.torque1_nm, effect.c2_arcsec_per_nm),
        (effect.torque2_nm, effect.c3_arcsec_per_nm),
    )
    for begins_nm, softness in zones:
        if begins_nm >= effect.limit_nm:
            stages.append(stages[-1])
            continue
        wanted = ARCSEC_PER_RAD * times / softness if softness else math.inf
        stages.append(min(wanted, draft.highest_stiffness_nm_per_rad))
        if stages[-1] < wanted:
            notes.append(
                f"{stages[-1]:.3g} Nm/rad is the stiffest spring that the plant's time step resolves"
            )
    draft.set_stiffness(stages[0])
    draft.gear.pop("stiffening", None)
    if len(set(stages)) > 1:
        draft.gear["stiffening"] = {
            "first_torque_nm": effect.torque1_nm * times,
            "second_stiffness_nm_per_rad": stages[1],
            "second_torque_nm": effect.torque2_nm * times,
            "third_stiffness_nm_per_rad": stages[2],
        }
    if times != 1.0:
        notes.append("by the motor's torque times the ratio, friction included")
    else:
        draft.load["torque_sense"] = effect.sense
    return Said("gear.stiffness_nm_per_rad, gear.stiffening", tuple(dict.fromkeys(notes)))


def inertial_windup(effect: InertialWindup, draft: Draft) -> Said:
    """J / K of the load on its spring, less what the load encoder's coupling winds up by itself."""
    seconds2 = effect.inertia_over_stiffness_s2
    coupling = draft.part("load", "encoder").get("coupling")
    if coupling:
        seconds2 -= 1.0 / (math.tau * coupling["frequency_hz"]) ** 2
    least = draft.inertia_kg_m2 / draft.highest_stiffness_nm_per_rad
    notes = []
    if seconds2 < least:
        notes.append(
            f"{math.sqrt(1 / least) / math.tau:.0f} Hz is the highest resonance that the plant resolves"
        )
        seconds2 = least
    inertia = seconds2 * draft.stiffness_nm_per_rad
    known = draft.gear.get("stiffening") is not None or not draft.tells_servo
    if known and inertia > draft.hanging_kg_m2:
        draft.set_inertia(inertia)
        return Said(
            "load.inertia_kg_m2", (*notes, "the spring is known otherwise, so the load follows from it")
        )
    draft.set_stiffness(draft.inertia_kg_m2 / seconds2)
    return Said("gear.stiffness_nm_per_rad", (*notes, "with the load's inertia as assumed"))


def velocity_windup(effect: VelocityWindup, draft: Draft) -> Said:
    """Viscous friction at the load that thins; the dry part as an element that yields at once to motion.

    Coulomb friction at the load would leave its wind-up at rest, where the model has none.
    """
    places = []
    if effect.viscous_arcsec_s_per_deg:
        # arcsec per motor deg/s to Nm per load rad/s
        per_load_rad_s = effect.viscous_arcsec_s_per_deg * draft.ratio * math.degrees(1.0)
        draft.load["viscous_nm_s_per_rad"] = per_load_rad_s / ARCSEC_PER_RAD * draft.stiffness_nm_per_rad
        speed = math.radians(effect.shear_deg_s) / draft.ratio
        draft.load["thinning"] = {"speed_rad_s": min(speed, 1000.0), "exponent": 1.0}
        places.append("load.viscous_nm_s_per_rad, load.thinning")
    if effect.coulomb_arcsec:
        dry = {"time_constant_s": DRY_TIME_S, "amplitude_arcsec": effect.coulomb_arcsec}
        draft.gear["creep"] = [*draft.gear.get("creep", ()), dry]
        places.append("gear.creep")
    return Said(", ".join(places) or "load.viscous_nm_s_per_rad")


def hysteresis(effect: Hysteresis, draft: Draft) -> Said:
    """The same law where the load leads; friction at the load where it lags."""
    return _loop(effect, draft, memory=False)


def hysteresis_memory(effect: HysteresisMemory, draft: Draft) -> Said:
    """Parallel sliders, which have return-point memory."""
    return _loop(effect, draft, memory=True)


def hysteresis_parameters(effect: HysteresisParameters, draft: Draft) -> Said:
    """The loop as it is now, in the place of the model's."""
    draft.gear.pop("hysteresis", None)
    draft.load.pop("presliding", None)
    return _loop(effect.changed().law(), draft, memory=effect.base.memory)


def _loop(effect: Hysteresis | HysteresisMemory, draft: Draft, *, memory: bool) -> Said:
    if effect.offset_arcsec < 0.0:
        return _lagging(effect, draft, memory=memory)
    if memory:
        xi, height = branch(effect.exponent, NODES)
        # The virgin curve, of which a branch is twice: offset g(2 x / width).
        parts = elements(0.5 * effect.width_deg * xi, effect.offset_arcsec * height)
        slips = [{"limit_arcsec": limit, "yield_deg": travel} for limit, travel in parts]
        if slips:
            draft.gear["hysteresis"] = {"law": "maxwell_slip", "elements": slips}
        return Said("gear.hysteresis", (f"straight between {NODES} points of a branch",))
    draft.gear["hysteresis"] = {
        "law": "rolling_friction",
        "offset_arcsec": effect.offset_arcsec,
        "width_deg": effect.width_deg,
        "exponent": effect.exponent,
    }
    return Said("gear.hysteresis")


def _lagging(effect: Hysteresis | HysteresisMemory, draft: Draft, *, memory: bool) -> Said:
    """Friction at the load that yields before it slips: it winds up the gear's spring, so the load lags.

    Over a branch the motor goes by x and the load lags by 2 offset g(x / width) more; what is left of x is
    the load's own travel, over which the friction has grown. Where nothing is left the load stands still.
    """
    offset, stiffness = -effect.offset_arcsec, draft.stiffness_nm_per_rad / ARCSEC_PER_RAD
    xi, height = branch(effect.exponent, 4 * NODES)
    travel = xi * effect.width_deg * ARCSEC_PER_DEG / draft.ratio - 2.0 * offset * height
    still = int(np.flatnonzero(travel <= 1e-9)[-1])
    most = draft.spare_stiffness_nm_per_rad
    limit_nm = offset * stiffness
    while True:
        dry_nm = limit_nm * float(height[still])
        wanted = np.linspace(0.0, 1.0, SLIDERS + 1)[1:]
        places = np.unique(np.searchsorted(height[still:], height[still] + wanted * (1.0 - height[still])))
        places = still + np.minimum(places, len(height) - 1 - still)
        reach = np.concatenate([[0.0], 0.5 * (travel[places] - max(travel[still], 0.0))])
        force = np.concatenate([[0.0], limit_nm * (height[places] - height[still])])
        parts = elements(reach, force) if still < len(height) - 1 and np.all(np.diff(reach) > 0.0) else []
        stiff = sum(limit / (travel_arcsec / ARCSEC_PER_RAD) for limit, travel_arcsec in parts)
        if still >= len(height) - 1 or (parts and stiff <= most):
            break
        still += 1
    draft.load["coulomb_nm"] = dry_nm
    draft.load["presliding"] = [
        {"limit_nm": limit, "travel_deg": travel_arcsec / ARCSEC_PER_DEG} for limit, travel_arcsec in parts
    ]
    notes = ["friction at the load; after a fast stop the load's inertia pushes it on"]
    if not memory:
        notes.append("with return-point memory, which the model's law has not")
    return Said("load.presliding, load.coulomb_nm", tuple(notes))


def backlash(effect: Backlash, draft: Draft) -> Said:
    """A dead zone between spring and load, with friction that holds the load in it and winds up a little."""
    half, per_nm = 0.5 * effect.gap_arcsec, ARCSEC_PER_RAD / draft.stiffness_nm_per_rad
    acceleration = math.radians(draft.axis.limits.acceleration_deg_s2)
    already_nm = float(draft.load.get("coulomb_nm") or 0.0)
    friction_nm = min(HOLDS * draft.inertia_kg_m2 * acceleration, MOST_HELD * half / per_nm)
    friction_nm = max(friction_nm - already_nm, 0.0)
    draft.load["coulomb_nm"] = already_nm + friction_nm
    draft.gear["backlash_arcsec"] = effect.gap_arcsec - 2.0 * friction_nm * per_nm
    return Said(
        "gear.backlash_arcsec, load.coulomb_nm",
        (
            f"{friction_nm:.2g} Nm of friction hold the load on its side; a stop that is harder than "
            f"{math.degrees(friction_nm / draft.inertia_kg_m2):.0f} deg/s^2 throws it across",
        ),
    )


def rate_dependence(effect: RateDependence, draft: Draft) -> Said:
    """Growth of the loop with speed."""
    if draft.gear.get("hysteresis") is None:
        return none("there is no leading loop that could grow")
    draft.gear["rate_dependence"] = {
        "growth_per_decade": 0.01 * effect.growth_percent,
        "from_deg_s": effect.reference_deg_s,
    }
    return Said("gear.rate_dependence", ("follows the speed within 50 ms",))


def vibration(effect: Vibration, draft: Draft) -> Said:
    """A torque on the load that shakes it by as much, the motor held."""
    if effect.frequency_hz > HIGHEST_SHAKE_HZ:
        return none(f"the plant is shaken by up to {HIGHEST_SHAKE_HZ:g} Hz")
    turn = math.tau * effect.frequency_hz
    # Load on its spring, then the encoder on its coupling.
    dynamic = complex(
        draft.stiffness_nm_per_rad - draft.inertia_kg_m2 * turn**2, turn * draft.gear["damping_nm_s_per_rad"]
    )
    reads: complex = 1.0 / dynamic
    coupling: dict[str, Any] | None = draft.part("load", "encoder").get("coupling")
    if coupling:
        part = effect.frequency_hz / coupling["frequency_hz"]
        lag = 2j * coupling["damping_ratio"] * part
        reads *= (1.0 + lag) / (1.0 - part**2 + lag)
    # The plant's torque is a sine, the model's movement a cosine.
    phase = effect.phase_deg + 90.0 - math.degrees(cmath.phase(reads))
    shake = {
        "frequency_hz": effect.frequency_hz,
        "torque_nm": effect.amplitude_arcsec / ARCSEC_PER_RAD / abs(reads),
        "phase_deg": math.remainder(phase, 360.0),
    }
    draft.load["vibration"] = [*draft.load.get("vibration", ()), shake]
    return Said("load.vibration", ("phase at the moment when the axis is switched on",))
