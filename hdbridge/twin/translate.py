"""Translates an axis file and a model to a truth file, each effect to the physics of the simulated plant.

A model describes the error of the load; the plant has components that cause this error. `TABLE` assigns such
a component to each effect of the catalogue, and a translation reports whether each effect of a model was
translated in full, in part or not at all. The transmission error comes from the model alone. Everything else
(motor, loops, friction, load, and the spring unless the model describes one) comes from the given truth, else
from usual values (`hdbridge.twin.parameters`).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from hdbridge.axis import AxisConfig, effects
from hdbridge.axis.effects.direction_phase import STEEPEST
from hdbridge.axis.effects.elastic_loop import rise
from hdbridge.axis.effects.motion import FloatArray
from hdbridge.axis.effects.warmth import Warmed
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.resonance import Resonance
from hdbridge.strictness import complaint
from hdbridge.twin.parameters import RESOLVED, default_truth
from hdbridge.units import ARCSEC_PER_DEG

# ----------------------------------------------------------------
# Draft of a truth file, written effect by effect.

ARCSEC_PER_RAD = math.degrees(1.0) * ARCSEC_PER_DEG


@dataclass(slots=True)
class Draft:
    """Content of a truth file (`data`), which is changed in place."""

    data: dict[str, Any]
    axis: AxisConfig
    sets_servo: bool
    """True if the drive's feed-forward is set for the load in the truth file, as after commissioning."""
    place: str | None = None
    """Path, in the truth file, of the counterpart of the effect being translated; None if the plant has
    none."""
    notes: list[str] = field(default_factory=list)
    """Differences between the effect being translated and its counterpart in the truth file."""

    def note(self, difference: str) -> None:
        """Records a difference between the effect being translated and its counterpart; ignores
        repetitions.
        """
        if difference not in self.notes:
            self.notes.append(difference)

    def refuse(self, why: str) -> None:
        """Records why the plant has no counterpart of the effect being translated."""
        self.place, self.notes = None, [why]

    @property
    def gear(self) -> dict[str, Any]:
        return self.part("gear")

    @property
    def load(self) -> dict[str, Any]:
        return self.part("load")

    def part(self, *names: str) -> dict[str, Any]:
        """Returns a nested section, which is created if missing."""
        place = self.data
        for name in names:
            if place.get(name) is None:
                place[name] = {}
            place = place[name]
        return place

    @property
    def ratio(self) -> float:
        """Ratio of the axis file, to which the model's orders and travels refer."""
        return self.axis.gear.ratio

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Stiffness of the spring's first stage."""
        return float(self.gear["stiffness_nm_per_rad"])

    def set_stiffness(self, nm_per_rad: float) -> None:
        """Sets the stiffness without changing the damping ratio of the load."""
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(nm_per_rad / self.stiffness_nm_per_rad)
        self.gear["stiffness_nm_per_rad"] = nm_per_rad

    @property
    def hanging_kg_m2(self) -> float:
        """Inertia of the hanging mass, which is not part of the load's own inertia."""
        mass = self.load.get("gravity")
        return float(mass["mass_kg"] * mass["arm_m"] ** 2) if mass else 0.0

    @property
    def inertia_kg_m2(self) -> float:
        """Total inertia of the load."""
        return float(self.load["inertia_kg_m2"]) + self.hanging_kg_m2

    def set_inertia(self, kg_m2: float) -> None:
        """Sets the total inertia of the load, which must exceed that of the hanging mass; keeps the damping
        ratio.
        """
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(kg_m2 / self.inertia_kg_m2)
        self.load["inertia_kg_m2"] = kg_m2 - self.hanging_kg_m2

    @property
    def highest_stiffness_nm_per_rad(self) -> float:
        """Maximum stiffness: half of the stiffest spring that the plant's shortest time step resolves."""
        return Resonance.of({**self.data, "load": {**self.load, "presliding": ()}}).stiffest_nm_per_rad(
            math.sqrt(0.5) / (SHORTEST_MS / 1e3)
        )

    @property
    def spare_stiffness_nm_per_rad(self) -> float:
        """Maximum stiffness of sliders at the load whose resonance the current time step resolves."""
        return Resonance.of(self.data).most_held_nm_per_rad(RESOLVED / (self.data["substep_ms"] / 1e3))

    def finish(self) -> None:
        """Sets the load feed-forward, and a time step that resolves the fastest resonance."""
        servo, load = self.data["servo"], self.inertia_kg_m2
        if self.sets_servo and servo.get("load_feedforward"):
            turn = math.sqrt(self.stiffness_nm_per_rad / load)
            servo["load_feedforward"] = {
                "inertia_kg_m2": load / self.ratio**2,
                "frequency_hz": min(500.0, max(1.0, turn / math.tau)),
                "damping_ratio": min(2.0, self.gear["damping_nm_s_per_rad"] / (2.0 * load * turn)),
            }
        fastest = Resonance.of(self.data).rad_s
        while fastest * self.data["substep_ms"] / 1e3 > RESOLVED and self.data["substep_ms"] > SHORTEST_MS:
            self.data["substep_ms"] = max(SHORTEST_MS, 0.5 * self.data["substep_ms"])


SHORTEST_MS = 0.0625
"""Shortest time step; a sixteenth of a millisecond."""


# ----------------------------------------------------------------
# The branch of an elastic loop as parallel slip elements.


def branch(exponent: float, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Returns xi from 0 to 1 and the branch g(xi), dense at its bend, shape (nodes + 1,) each."""
    xi = np.linspace(0.0, 1.0, nodes + 1) ** (2.0 / min(max(exponent - 1.0, 0.2), 1.0))
    return xi, rise(xi, exponent)


def elements(travel: FloatArray, height: FloatArray) -> list[tuple[float, float]]:
    """Returns limit and travel to slipping of each element of a concave curve through the origin.

    The curve is the sum of the elements from rest. The points of the curve are in order and start at (0, 0);
    beyond the last point the curve is flat.
    """
    slopes = [(h1 - h0) / (t1 - t0) for (t0, h0), (t1, h1) in pairwise(zip(travel, height, strict=True))]
    return [
        (float((slope - after) * end), float(end))
        for slope, after, end in zip(slopes, [*slopes[1:], 0.0], travel[1:], strict=True)
        if slope > after and end > 0.0
    ]


# ----------------------------------------------------------------
# Effects of teeth and ratio.

HIGHEST_ORDER: Final = 512
FLANK_TRAVEL_DEG: Final = 0.5
"""Motor travel from flank to flank: a fraction of a degree, like the play between teeth."""
MOST_YIELD: Final = 0.9
"""Maximum compliance of the teeth, as a fraction of the spring's; at one the plant is unstable."""


def ratio_error(effect: effects.RatioError, draft: Draft) -> None:
    """Sets the true ratio of the gear."""
    draft.gear["ratio"] = effect.true_ratio(draft.ratio)


def orders(key: str, effect: Any, draft: Draft) -> None:
    """Adds the effect's orders to the tooth error selected by ``key``, such as ``motor_orders``."""
    sums: dict[int, complex] = {
        each["order"]: cmath.rect(each["amplitude_arcsec"], math.radians(each["phase_deg"]))
        for each in draft.gear.get(key, ())
    }
    beyond = [str(each.order) for each in effect.orders if each.order > HIGHEST_ORDER]
    for each in effect.orders:
        if each.order <= HIGHEST_ORDER:
            phasor = cmath.rect(each.amplitude_arcsec, math.radians(each.phase_deg))
            sums[each.order] = sums.get(each.order, 0j) + phasor
    draft.gear[key] = [
        {"order": order, "amplitude_arcsec": abs(phasor), "phase_deg": math.degrees(cmath.phase(phasor))}
        for order, phasor in sorted(sums.items())
    ]
    draft.place = f"gear.{key}"
    if beyond:
        draft.note(f"without order {', '.join(beyond)}: the plant's go up to {HIGHEST_ORDER}")


def direction_phase(effect: effects.DirectionPhase, draft: Draft) -> None:
    """Sets the two flanks of the teeth. The model's orders are the mean of both flanks; the plant's orders
    are those of one flank.
    """
    held, flanks = list[str](), list[dict[str, Any]]()
    for each in draft.gear.get("motor_orders", ()):
        shift = math.radians(each["order"] * effect.shift_deg)
        share = math.cos(shift)
        if abs(math.tan(shift)) > STEEPEST or share <= 0.0:
            held.append(str(each["order"]))
            share = 1.0 / math.hypot(1.0, STEEPEST)
        flanks.append({**each, "amplitude_arcsec": each["amplitude_arcsec"] / share})
    draft.gear["motor_orders"] = flanks
    draft.gear["flank"] = {"shift_deg": effect.shift_deg, "travel_deg": FLANK_TRAVEL_DEG}
    draft.note(f"crosses within {FLANK_TRAVEL_DEG:g} motor deg, where the model jumps")
    if held:
        numbers = ", ".join(held)
        draft.note(
            f"order {numbers}: the shift is too large to find its amplitude from both directions' mean"
        )


def torque_modulation(effect: effects.TorqueModulation, draft: Draft) -> None:
    """Sets the growth of the tooth error with the magnitude of the torque."""
    if effect.signed:
        draft.refuse("the plant's teeth grow with the size of the torque, not with its sign")
        return
    per_nm = 0.01 * effect.growth_percent_per_nm
    if effect.torque == "motor_torque_nm":
        per_nm /= draft.ratio
        draft.note("driven by the motor's torque times the ratio, including the motor's own friction")
    teeth = draft.gear.get("motor_orders", ())
    carried = {each.order for each in effect.orders}
    if any(each["order"] not in carried for each in teeth):
        draft.note("all motor orders grow, also those that the effect does not carry")
    yields = sum(each["amplitude_arcsec"] for each in teeth) / ARCSEC_PER_RAD * draft.stiffness_nm_per_rad
    if yields * abs(per_nm) > MOST_YIELD:
        held = math.copysign(MOST_YIELD / yields, per_nm)
        draft.note(
            f"limited to {100 * held:.3g} %/Nm: at {100 * per_nm:.3g} the teeth would yield more than the "
            "spring"
        )
        per_nm = held
    draft.gear["torque_growth_per_nm"] = per_nm


def local_defect(effect: effects.LocalDefect, draft: Draft) -> None:
    """Sets a damaged tooth with the raised cosine of the effect."""
    width = min(180.0, 2.0 * effect.half_width_deg)
    bump = {"at_deg": effect.centre_deg, "width_deg": width, "height_arcsec": effect.height_arcsec}
    draft.gear["damage"] = [*draft.gear.get("damage", ()), bump]
    if 2.0 * effect.half_width_deg > width:
        draft.note("no wider than half a turn")


# ----------------------------------------------------------------
# Encoder errors.

RADIUS_MM: Final = 20.0
"""Assumed radius of a disc's graduation. Only its ratio to the eccentricity has an effect."""
LATEST_MS: Final = 100.0
SMALL_ARCSEC: Final = 0.05
"""Maximum deviation of a translation that is not noted: about a tenth of a typical encoder count."""
_LIMITS: Final = {
    "sine_offset": 0.5, "cosine_offset": 0.5, "gain_mismatch": 0.5, "phase_mismatch_deg": 45.0,
    "third_harmonic": 0.3,
}  # fmt: skip


def motor_eccentricity(effect: effects.MotorEncoderEccentricity, draft: Draft) -> None:
    """Sets the disc of the motor encoder. The drive controls its reading, so the load has the opposite error.

    A disc reads too much by (e / r) sin(a - a0), so the load lags by this divided by the ratio.
    """
    # -sin(a - a0) = cos(a + 90 deg - a0), and the same for twice the angle.
    disc = _disc(effect.orders, draft.ratio, lambda phase_deg: 90.0 - phase_deg)
    draft.part("motor", "encoder")["disc"] = disc
    draft.note(f"radius assumed as {RADIUS_MM:g} mm")


def load_orders(effect: effects.LoadOrders, draft: Draft) -> None:
    """Sets the load encoder's disc if it is the known source, else a pitch error of the spline."""
    if effect.origin != "load_encoder":
        if effect.origin == "unknown":
            draft.note("origin unknown: taken for the gear's")
        orders("load_orders", effect, draft)
        return
    few = [each for each in effect.orders if each.order <= 2]
    more = tuple(each for each in effect.orders if each.order > 2)
    # sin(a - a0) = cos(a - a0 - 90 deg)
    draft.part("load", "encoder")["disc"] = _disc(few, 1.0, lambda phase_deg: -90.0 - phase_deg)
    if more:
        orders("load_orders", effect.model_copy(update={"orders": more}), draft)
        draft.notes.insert(0, "orders above 2 are written to gear.load_orders, because a disc has none")
    draft.notes.insert(0, f"radius assumed as {RADIUS_MM:g} mm")
    draft.place = "load.encoder.disc"


def _disc(orders: Iterable[effects.MotorOrder], ratio: float, at_deg: Any) -> dict[str, Any]:
    disc: dict[str, Any] = {"radius_mm": RADIUS_MM}
    for each in orders:
        off_um = each.amplitude_arcsec * ratio / ARCSEC_PER_RAD * RADIUS_MM * 1000.0
        at = math.remainder(at_deg(each.phase_deg), 360.0)
        if each.order == 1:
            disc |= {"eccentricity_um": off_um, "eccentric_at_deg": at}
        else:
            disc |= {"ovality_um": off_um, "oval_at_deg": 0.5 * at}
    return disc


def channel_skew(effect: effects.ChannelSkew, draft: Draft) -> None:
    """Sets the motor encoder's delay if the load encoder is sampled later, else the load encoder's delay."""
    delay_ms = effect.delay_ms
    late = "motor" if delay_ms > 0.0 else "load"
    draft.part(late, "encoder")["late_ms"] = min(abs(delay_ms), LATEST_MS)
    draft.place = f"{late}.encoder.late_ms"
    if abs(delay_ms) > LATEST_MS:
        draft.note(f"no more than {LATEST_MS:g} ms")
    rest_ms2 = effect.second_order_ms2 - delay_ms**2
    most = 0.5e-6 * abs(rest_ms2) * draft.axis.limits.acceleration_deg_s2 * 3600.0
    if most > SMALL_ARCSEC:
        draft.note(
            f"a pure delay: up to {most:.2g} arcsec of the model's acceleration term are not reproduced"
        )


def subdivisional_error(effect: effects.SubdivisionalError, draft: Draft) -> None:
    """Sets offsets, gain, phase and third harmonic of the signals, to first order.

    The angle read from (1 + g) sin p - t sin 3p + s and cos(p + d) + t cos 3p + c is off by
    s cos p - c sin p + g/2 sin 2p - d/2 cos 2p - t sin 4p, in radians of a line.
    """
    line_arcsec = ARCSEC_PER_RAD / effect.lines_per_turn
    signals: dict[str, float] = {"lines_per_turn": effect.lines_per_turn}
    lost_arcsec = 0.0
    for each in effect.orders:
        part = each.amplitude_arcsec / line_arcsec
        cosine, sine = (part * of(math.radians(each.phase_deg)) for of in (math.cos, math.sin))
        if each.order == 1:
            signals |= {"sine_offset": cosine, "cosine_offset": sine}
        elif each.order == 2:
            signals |= {"gain_mismatch": -2.0 * sine, "phase_mismatch_deg": math.degrees(-2.0 * cosine)}
        else:
            signals["third_harmonic"] = sine
            lost_arcsec = abs(cosine) * line_arcsec
    if lost_arcsec > SMALL_ARCSEC:
        draft.note(f"{lost_arcsec:.2g} arcsec of the fourth order are no third harmonic of either signal")
    for name, limit in _LIMITS.items():
        if abs(signals.get(name, 0.0)) > limit:
            draft.note(f"{name} limited to {limit:g}: {signals[name]:.2g} is not plausible")
            signals[name] = math.copysign(limit, signals[name])
    draft.part("load", "encoder")["signals"] = signals


def count_loss(effect: effects.CountLoss, draft: Draft) -> None:
    """Sets count losses of the load encoder, at the effect's times after switching on."""
    counts_per_arcsec = draft.axis.load_encoder.counts(1.0) / 3600.0
    losses = [
        {"time_s": each.time_s, "counts": round(each.size_arcsec * counts_per_arcsec)}
        for each in effect.steps
        if each.time_s >= 0.0
    ]
    if not losses:
        draft.refuse("it occurred before the record's time zero, and the encoders' zero already includes it")
        return
    draft.part("load", "encoder")["losses"] = losses
    draft.note("repeats at this time after each switching on; whole counts")


# ----------------------------------------------------------------
# Effects of temperature, travel and time.

LINEAR_BUILD_UP: Final = 0.5
"""The plant deviates if the build-up ratio is below this or above its inverse, because its element strains
and releases with equal time constants."""


def zero_drift(effect: effects.ZeroDrift, draft: Draft) -> None:
    """Sets a shift with the temperature, delayed as in the model and zero at the ambient temperature."""
    heat = draft.part("temperature")
    heat["zero_drift_arcsec_per_k"] = effect.drift_arcsec_per_k
    if effect.driven_by == "time":
        _warm_up(effect, draft)
    else:
        heat["zero_time_constant_s"] = effect.tau_s
        draft.note("zero at the ambient temperature: an offset")


def amplitude_drift(effect: effects.AmplitudeDrift, draft: Draft) -> None:
    """Sets the growth of tooth error and friction with the temperature."""
    heat = draft.part("temperature")
    heat["tooth_growth_per_k"] = 0.01 * effect.ripple_percent_per_k
    heat["friction_growth_per_k"] = 0.01 * effect.friction_percent_per_k
    if effect.driven_by == "time":
        _warm_up(effect, draft)
        heat["reference_c"] = heat["start_c"]
    else:
        heat["reference_c"] = effect.reference_c
        draft.note(f"follows the temperature at once; the model has a time constant of {effect.tau_s:.3g} s")
    if effect.friction_percent_per_k:
        draft.note("the motor's friction grows with the loop")


def wear(effect: effects.Wear, draft: Draft) -> None:
    """Sets a gap between the teeth that grows with the travel; refuses a model whose elastic loop widens."""
    if effect.growth_arcsec_per_kiloturn > 0.0:
        draft.refuse("the model's elastic loop widens; wear of the plant's teeth only opens a gap")
        return
    draft.gear["wear"] = {
        "arcsec_per_1000_turns": -0.5 * effect.growth_arcsec_per_kiloturn,
        "exponent": effect.exponent,
    }
    draft.note("crossed within the gap's own travel")
    if effect.turns_before:
        draft.note(f"starts at zero turns, without the {effect.turns_before:.0f} turns before")


def creep(effect: effects.Creep, draft: Draft) -> None:
    """Sets Kelvin-Voigt elements. The model's strain leads in the direction of motion, whereas the plant's
    elements yield to the drag.
    """
    parts = [
        {"time_constant_s": each.tau_s, "amplitude_arcsec": -each.amplitude_arcsec} for each in effect.parts
    ]
    draft.gear["creep"] = [*draft.gear.get("creep", ()), *parts]
    if not LINEAR_BUILD_UP <= effect.build_up <= 1.0 / LINEAR_BUILD_UP:
        draft.note(
            f"builds up as slowly as it relaxes; the model's build-up takes {effect.build_up:.2g} of that "
            "time"
        )


def _warm_up(effect: Warmed, draft: Draft) -> None:
    """Sets the plant's initial temperature below ambient by the model's warm-up."""
    heat = draft.part("temperature")
    ambient_c = heat.get("ambient_c", 22.0)
    heat["start_c"] = max(-60.0, ambient_c - effect.warm_up_k)
    heat["time_constant_s"] = effect.tau_s
    draft.note(
        f"starts {effect.warm_up_k:g} K below the ambient temperature, with a time constant of "
        f"{effect.tau_s:.3g} s"
    )


# ----------------------------------------------------------------
# Effects of stiffness, friction, backlash and hysteresis.

NODES: Final = 24
"""Number of nodes of a branch; linear interpolation is then accurate to a hundredth of the offset."""
SLIDERS: Final = 16
"""Maximum number of sliders at the load in a truth file."""
DRY_TIME_S: Final = 0.01
"""Time constant of the creep element for a drag that depends only on direction: two or three control
cycles."""
HIGHEST_SHAKE_HZ: Final = 500.0
HOLDS: Final = 1.5
"""Ratio of the friction that holds the load in a dead zone to its inertial torque at the highest
acceleration."""
MOST_HELD: Final = 0.3
"""Maximum wind-up of the spring by the friction that holds the load in a dead zone, as a fraction of half the
gap."""


def compliance(effect: effects.Compliance, draft: Draft) -> None:
    """Sets the spring in up to three stages, within the torque range of the effect.

    Motor torque is load torque divided by the ratio.
    """
    times = draft.ratio if effect.torque == "motor_torque_nm" else 1.0
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
            draft.note(f"{stages[-1]:.3g} Nm/rad is the stiffest spring that the plant's time step resolves")
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
        draft.note("driven by the motor's torque times the ratio, including friction")
    else:
        draft.load["torque_sense"] = effect.sense


def inertial_windup(effect: effects.InertialWindup, draft: Draft) -> None:
    """Sets the load's inertia or the spring's stiffness according to the effect's J / K, after subtracting
    that of the load encoder's coupling.
    """
    seconds2 = effect.inertia_over_stiffness_s2
    coupling = draft.part("load", "encoder").get("coupling")
    if coupling:
        seconds2 -= 1.0 / (math.tau * coupling["frequency_hz"]) ** 2
    least = draft.inertia_kg_m2 / draft.highest_stiffness_nm_per_rad
    if seconds2 < least:
        draft.note(
            f"{math.sqrt(1 / least) / math.tau:.0f} Hz is the highest resonance that the plant resolves"
        )
        seconds2 = least
    inertia = seconds2 * draft.stiffness_nm_per_rad
    known = draft.gear.get("stiffening") is not None or not draft.sets_servo
    if known and inertia > draft.hanging_kg_m2:
        draft.set_inertia(inertia)
        draft.place = "load.inertia_kg_m2"
        draft.note("the spring is already known, so the load's inertia follows from it")
        return
    draft.set_stiffness(draft.inertia_kg_m2 / seconds2)
    draft.place = "gear.stiffness_nm_per_rad"
    draft.note("with the load's inertia as assumed")


def velocity_windup(effect: effects.VelocityWindup, draft: Draft) -> None:
    """Sets shear-thinning viscous friction at the load, and the dry part as a fast creep element.

    The wind-up of Coulomb friction at the load would remain at rest, unlike that of the model.
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
    draft.place = ", ".join(places) or "load.viscous_nm_s_per_rad"


def hysteresis_parameters(effect: effects.HysteresisParameters, draft: Draft) -> None:
    """Replaces the loop of the model by the changed loop of the effect."""
    draft.gear.pop("hysteresis", None)
    draft.load.pop("presliding", None)
    hysteresis(effect.changed().law(), draft)


def hysteresis(effect: effects.Hysteresis | effects.HysteresisMemory, draft: Draft) -> None:
    """Sets the effect's law as the gear's hysteresis if the load leads, or friction at the load if it lags.

    A law with return-point memory becomes parallel sliders.
    """
    draft.place = "gear.hysteresis"
    if effect.offset_arcsec < 0.0:
        _lagging(effect, draft)
    elif isinstance(effect, effects.HysteresisMemory):
        xi, height = branch(effect.exponent, NODES)
        # The virgin curve has half the size of a branch: offset g(2 x / width).
        parts = elements(0.5 * effect.width_deg * xi, effect.offset_arcsec * height)
        slips = [{"limit_arcsec": limit, "yield_deg": travel} for limit, travel in parts]
        if slips:
            draft.gear["hysteresis"] = {"law": "maxwell_slip", "elements": slips}
        draft.note(f"linear between {NODES} points of a branch")
    else:
        draft.gear["hysteresis"] = {
            "law": "rolling_friction",
            "offset_arcsec": effect.offset_arcsec,
            "width_deg": effect.width_deg,
            "exponent": effect.exponent,
        }


def _lagging(effect: effects.Hysteresis | effects.HysteresisMemory, draft: Draft) -> None:
    """Sets presliding friction at the load, which winds up the gear's spring, so that the load lags.

    Over a branch the motor moves by x and the load's lag grows by 2 offset g(x / width). The rest of x is the
    load's travel, over which the friction grows. If nothing remains, the load does not move.
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
    draft.place = "load.presliding, load.coulomb_nm"
    draft.note("friction at the load; after a fast stop the load's inertia pushes it on")
    if not isinstance(effect, effects.HysteresisMemory):
        draft.note("with return-point memory, which the model's law lacks")


def backlash(effect: effects.Backlash, draft: Draft) -> None:
    """Sets a dead zone between spring and load, with friction that holds the load within it."""
    half, per_nm = 0.5 * effect.gap_arcsec, ARCSEC_PER_RAD / draft.stiffness_nm_per_rad
    acceleration = math.radians(draft.axis.limits.acceleration_deg_s2)
    already_nm = float(draft.load.get("coulomb_nm") or 0.0)
    friction_nm = min(HOLDS * draft.inertia_kg_m2 * acceleration, MOST_HELD * half / per_nm)
    friction_nm = max(friction_nm - already_nm, 0.0)
    draft.load["coulomb_nm"] = already_nm + friction_nm
    draft.gear["backlash_arcsec"] = effect.gap_arcsec - 2.0 * friction_nm * per_nm
    draft.note(
        f"{friction_nm:.2g} Nm of friction hold the load on its side; a stop harder than "
        f"{math.degrees(friction_nm / draft.inertia_kg_m2):.0f} deg/s^2 makes it cross the gap"
    )


def rate_dependence(effect: effects.RateDependence, draft: Draft) -> None:
    """Sets the growth of the loop with speed."""
    if draft.gear.get("hysteresis") is None:
        draft.refuse("there is no leading loop that could grow")
        return
    draft.gear["rate_dependence"] = {
        "growth_per_decade": 0.01 * effect.growth_percent,
        "from_deg_s": effect.reference_deg_s,
    }
    draft.note("follows the speed within 50 ms")


def vibration(effect: effects.Vibration, draft: Draft) -> None:
    """Sets a torque that shakes the load with the effect's amplitude while the motor is held."""
    if effect.frequency_hz > HIGHEST_SHAKE_HZ:
        draft.refuse(f"the plant is shaken by up to {HIGHEST_SHAKE_HZ:g} Hz")
        return
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
    draft.note("phase at the moment when the axis is switched on")


# ----------------------------------------------------------------

OF_GEAR: Final = (
    "motor_orders", "flexspline_orders", "load_orders", "hysteresis", "second_hysteresis", "flank", "jumps",
    "torque_growth_per_nm", "backlash_arcsec", "rate_dependence", "wear", "ageing", "creep", "damage",
    "roller", "seat",
)  # fmt: skip
"""Keys of the section `gear` for transmission error, which a translation removes before it adds a model's."""
OF_ENCODERS: Final = ("disc", "late_ms", "losses", "signals", "cable", "sensor_warming")
OF_TEMPERATURE: Final = (
    "zero_drift_arcsec_per_k", "zero_time_constant_s", "reference_c", "tooth_growth_per_k",
    "friction_growth_per_k",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """Result of the translation of one effect."""

    effect: str
    counterpart: str | None
    """Dotted paths in the truth file; None if the plant has no counterpart."""
    note: str
    """Differences, or the reason for the lack of a counterpart; empty for an exact translation."""


@dataclass(frozen=True, slots=True)
class Translation:
    """A translated truth, with the result for each effect."""

    truth: Truth
    rows: tuple[Row, ...]
    """One row per effect of the model, in catalogue order; effects outside the catalogue come last."""


class Entry(NamedTuple):
    """One row of `TABLE`."""

    counterpart: str
    """Dotted paths in the truth file."""
    write: Callable[[Any, Draft], None]
    """Writes an effect of this kind to a draft; also sets the path if there are several, and notes
    differences."""


TABLE: Final[Mapping[str, Entry]] = MappingProxyType(
    {
        # In the order of writing: the spring is first, because torques are derived from it.
        "ratio_error": Entry("gear.ratio", ratio_error),
        "compliance": Entry("gear.stiffness_nm_per_rad, gear.stiffening", compliance),
        "inertial_windup": Entry("gear.stiffness_nm_per_rad or load.inertia_kg_m2", inertial_windup),
        "velocity_windup": Entry("load.viscous_nm_s_per_rad, load.thinning, gear.creep", velocity_windup),
        "synchronous": Entry("gear.motor_orders", partial(orders, "motor_orders")),
        "motor_order": Entry("gear.motor_orders", partial(orders, "motor_orders")),
        "flexspline_order": Entry("gear.flexspline_orders", partial(orders, "flexspline_orders")),
        "load_order": Entry("gear.load_orders or load.encoder.disc", load_orders),
        "motor_encoder_eccentricity": Entry("motor.encoder.disc", motor_eccentricity),
        "direction_phase": Entry("gear.flank", direction_phase),
        "torque_modulation": Entry("gear.torque_growth_per_nm", torque_modulation),
        "hysteresis": Entry("gear.hysteresis or load.presliding", hysteresis),
        "hysteresis_memory": Entry("gear.hysteresis or load.presliding", hysteresis),
        "hysteresis_parameters": Entry("gear.hysteresis", hysteresis_parameters),
        "backlash": Entry("gear.backlash_arcsec, load.coulomb_nm", backlash),
        "rate_dependence": Entry("gear.rate_dependence", rate_dependence),
        "channel_skew": Entry("motor.encoder.late_ms or load.encoder.late_ms", channel_skew),
        "subdivisional_error": Entry("load.encoder.signals", subdivisional_error),
        "count_loss": Entry("load.encoder.losses", count_loss),
        "zero_drift": Entry("temperature.zero_drift_arcsec_per_k", zero_drift),
        "amplitude_drift": Entry(
            "temperature.tooth_growth_per_k, temperature.friction_growth_per_k", amplitude_drift
        ),
        "wear": Entry("gear.wear", wear),
        "creep": Entry("gear.creep", creep),
        "local_defect": Entry("gear.damage", local_defect),
        "vibration": Entry("load.vibration", vibration),
    }
)
"""One row per effect of the catalogue."""
UNKNOWN: Final = "the simulated drive has no part for an effect that is not of hdbridge's own catalogue"


def translate(
    axis: AxisConfig, model: TransmissionModel | None = None, base: Truth | None = None
) -> Translation:
    """Returns the simulated drive with the model's errors, on the axis of the axis file.

    ``base`` (default: usual values) provides everything that the model does not describe. Without a model,
    ``base`` keeps its transmission error. InputError if the model has a different gear ratio, or a value that
    the plant cannot have.
    """
    truth = _of_axis(axis, base) if base is not None else default_truth(axis)
    if model is None:
        return Translation(truth, ())
    model.check_ratio(axis)
    draft = Draft(_without_error(truth, axis), axis, sets_servo=base is None)
    by_name = {each.name: each for each in model.effects}
    rows = {name: Row(name, None, UNKNOWN) for name in (*effects.CATALOGUE, *by_name) if name in by_name}
    for name, entry in TABLE.items():
        if name in by_name:
            draft.place, draft.notes = entry.counterpart, []
            entry.write(by_name[name], draft)
            rows[name] = Row(name, draft.place, "; ".join(draft.notes))
    draft.finish()
    return Translation(_validated(draft.data), tuple(rows.values()))


def _validated(data: dict[str, Any]) -> Truth:
    try:
        return Truth.model_validate(data)
    except ValidationError as problem:
        first = complaint(problem.errors()[0])
        raise InputError(
            f"the model needs a value that the simulated drive does not allow: {first}; "
            "look at the effect of the model that requires it"
        ) from None


def _of_axis(axis: AxisConfig, base: Truth) -> Truth:
    """Returns the plant with encoders and rated torque of the axis file; its provenance keeps ``values``."""
    data = base.model_dump(by_alias=True)
    data["name"] = axis.name
    data["motor"]["rated_torque_nm"] = axis.drive.rated_torque_nm
    for section, encoder in (("motor", axis.motor_encoder), ("load", axis.load_encoder)):
        data[section]["encoder"]["counts_per_turn"] = max(4, encoder.counts_per_turn)
        data[section]["encoder"]["direction"] = encoder.direction
    values = base.provenance.get("values")
    data["intervals"], data["provenance"] = {}, {} if values is None else {"values": values}
    return Truth.model_validate(data)


def _without_error(truth: Truth, axis: AxisConfig) -> dict[str, Any]:
    """Returns the truth file's content without the transmission errors that a model describes."""
    data = truth.model_dump(by_alias=True)
    data["gear"]["ratio"] = axis.gear.ratio
    parts = (
        (data["gear"], OF_GEAR),
        (data["motor"]["encoder"], OF_ENCODERS),
        (data["load"]["encoder"], OF_ENCODERS),
        (data["temperature"], OF_TEMPERATURE),
        (data["load"], ("vibration",)),
    )
    for part, names in parts:
        for name in names:
            part.pop(name, None)
    return data
