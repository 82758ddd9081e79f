"""True parameters of a finding: the hidden cause in the finding's units and conventions.

The secret has the hidden cause and the plant; model.yaml is the reference of the diagnosis. If a parameter
does not have the same meaning in both, it is left out; the reason is stated next to each cause.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from support.hidden.site import ARCSEC_PER_RAD

Data = Mapping[str, Any]
Values = dict[str, float]
FINE = 1024
"""Number of angles per turn, or per line, for the separation of orders."""
TWINS = {"motor_order": "motor_encoder_eccentricity", "motor_encoder_eccentricity": "motor_order"}
"""Pairs of causes whose orders have the same amplitudes and phases under either name."""
ALWAYS_THERE = ("inertial_windup", "compliance")
"""Causes that exist without being hidden; the plant gives their size."""


@dataclass(frozen=True)
class Secret:
    """Known truth of a case."""

    parameters: Data
    """Parameters of the cause; empty if it is present without having been hidden."""
    found: Data = field(default_factory=dict)
    """Values of the finding, by name."""
    truth: Data = field(default_factory=dict)
    """The plant, as a truth file."""
    model: Data = field(default_factory=dict)
    """model.yaml."""

    @property
    def gear(self) -> Data:
        """Section ``gear`` of the plant."""
        return self.truth.get("gear", {})

    @property
    def load(self) -> Data:
        """Section ``load`` of the plant."""
        return self.truth.get("load", {})

    @property
    def stiffness(self) -> float:
        """Stiffness at the load, Nm/rad."""
        return float(self.gear["stiffness_nm_per_rad"])


def _phasor(amplitude: float, phase_deg: float) -> complex:
    return amplitude * cmath.exp(1j * math.radians(phase_deg))


def _polar(order: float, value: complex) -> Values:
    """Returns amplitude and phase by their names in a finding; empty if the amplitude is zero."""
    if abs(value) < 1e-9:
        return {}
    name = f"order_{order:.0f}"
    return {f"{name}_amplitude_arcsec": abs(value), f"{name}_phase_deg": math.degrees(cmath.phase(value))}


def _sum_of(rows: Any) -> dict[float, complex]:
    total: dict[float, complex] = {}
    for each in rows or ():
        order = float(each["order"])
        total[order] = total.get(order, 0j) + _phasor(each["amplitude_arcsec"], each.get("phase_deg", 0.0))
    return total


def _disc(disc: Data, arcsec_per_rad: float) -> dict[float, complex]:
    """Returns orders 1 and 2 of a disc's reading error: (e / R) sin(a - at), (d / R) sin 2 (a - at)."""
    scale = arcsec_per_rad / float(disc["radius_mm"]) * 1e-3
    first = _phasor(scale * disc.get("eccentricity_um", 0.0), -disc.get("eccentric_at_deg", 0.0) - 90.0)
    second = _phasor(scale * disc.get("ovality_um", 0.0), -2.0 * disc.get("oval_at_deg", 0.0) - 90.0)
    return {1.0: first, 2.0: second}


def _read_by(disc: Data, teeth: dict[float, complex], ratio: float) -> dict[float, complex]:
    """Returns the orders of the total error over the *reading* of a motor disc, arcsec at the load.

    The drive keeps the reading at its command, so the motor is off by the disc's error. The load is off by
    that error divided by the ratio, and by the tooth error at the actual motor angle, so orders 2 and 4 of
    the teeth contribute to order 1.
    """
    reading = math.tau * np.arange(FINE) / FINE
    off = np.zeros(FINE)
    for _ in range(20):
        at = reading - off
        off = sum(
            (value * np.exp(1j * order * at)).real for order, value in _disc(disc, 1.0).items()
        ) + np.zeros(FINE)
    error = -off * ARCSEC_PER_RAD / ratio
    for order, value in teeth.items():
        error = error + (value * np.exp(1j * order * (reading - off))).real
    waves = 2.0 * np.fft.fft(error) / FINE
    return {float(order): complex(waves[order]) for order in range(1, FINE // 4)}


def _motor_orders(secret: Secret) -> Values:
    """Returns the change against model.yaml: the hidden cause plus the calibration's error of that order."""
    total = _sum_of(secret.gear.get("motor_orders"))
    disc = secret.truth["motor"]["encoder"].get("disc")
    if disc:
        total = _read_by(disc, total, float(secret.gear["ratio"]))
    shift_deg = float(secret.gear.get("flank", {}).get("shift_deg", 0.0))
    # A finding reports the mean over both flanks.
    total = {order: each * math.cos(math.radians(order * shift_deg)) for order, each in total.items()}
    given = _sum_of(
        row
        for each in secret.model.get("effects", ())
        if each["effect"] == "synchronous"
        for row in each["parameters"]["orders"]
    )
    hidden = {float(secret.parameters.get("order", 1.0))}
    if secret.parameters.get("second_arcsec"):
        hidden.add(2.0)
    result: Values = {}
    for order in hidden:
        result |= _polar(order, total.get(order, 0j) - given.get(order, 0j))
    return result


def _flexspline(secret: Secret) -> Values:
    known = secret.parameters
    return _polar(known["order"], _phasor(known["amplitude_arcsec"], known["phase_deg"]))


def _load_orders(secret: Secret) -> Values:
    total = _sum_of(secret.gear.get("load_orders"))
    disc = secret.load.get("encoder", {}).get("disc")
    if disc:
        for order, value in _disc(disc, ARCSEC_PER_RAD).items():
            total[order] = total.get(order, 0j) + value
    return {name: value for order, each in total.items() for name, value in _polar(order, each).items()}


def _compliance(secret: Secret) -> Values:
    """Returns compliance and torque limit of each stage.

    For a finding without stages, returns the wind-up under the highest torque divided by that torque. If
    another cause, hidden later, has softened the spring, this value is increased in proportion.
    """
    stiffness = secret.stiffness
    first = ARCSEC_PER_RAD / stiffness
    stages = secret.gear.get("stiffening")
    if "torque1_nm" not in secret.found or not stages:
        softer = float(secret.parameters.get("stiffness_nm_per_rad", stiffness)) / stiffness
        return {"c1_arcsec_per_nm": softer * float(secret.parameters.get("compliance_arcsec_per_nm", first))}
    return {
        "c1_arcsec_per_nm": first,
        "c2_arcsec_per_nm": ARCSEC_PER_RAD / float(stages["second_stiffness_nm_per_rad"]),
        "c3_arcsec_per_nm": ARCSEC_PER_RAD / float(stages["third_stiffness_nm_per_rad"]),
        "torque1_nm": float(stages["first_torque_nm"]),
        "torque2_nm": float(stages["second_torque_nm"]),
    }


def _inertial(secret: Secret) -> Values:
    """Returns J / K of the load on the gear plus that of the encoder on its coupling."""
    gravity = secret.load.get("gravity") or {}
    inertia = secret.load["inertia_kg_m2"] + gravity.get("mass_kg", 0.0) * gravity.get("arm_m", 0.0) ** 2
    coupling = secret.load.get("encoder", {}).get("coupling")
    lag = (math.tau * coupling["frequency_hz"]) ** -2 if coupling else 0.0
    return {"inertia_over_stiffness_s2": float(inertia) / secret.stiffness + lag}


def _velocity(secret: Secret) -> Values:
    """Returns the Coulomb part only: the viscous slope at rest would depend on the law of shear thinning."""
    dry = secret.parameters.get("coulomb_nm")
    return {"coulomb_arcsec": float(dry) / secret.stiffness * ARCSEC_PER_RAD} if dry else {}


def _loop(secret: Secret) -> Values:
    """Returns the parameters of the axis's loop; friction of the load winds it up against the offset."""
    values = _named(offset_arcsec="offset_arcsec", width_deg="width_deg", exponent="exponent")(secret)
    dry = secret.load.get("coulomb_nm")
    if dry and "offset_arcsec" in values:
        values["offset_arcsec"] -= float(dry) / secret.stiffness * ARCSEC_PER_RAD
    return values


def _loop_height(secret: Secret) -> Values:
    """Returns half the height of the loops of both hysteresis laws together.

    Width and exponent have no true values, because the plant obeys a different law.
    """
    height = 0.0
    for name in ("hysteresis", "second_hysteresis"):
        law = secret.gear.get(name) or {}
        height += float(law.get("offset_arcsec", 0.0))
        height += sum(float(each["limit_arcsec"]) for each in law.get("elements", ()))
    return {"offset_arcsec": height} if height else {}


def _interpolation(secret: Secret) -> Values:
    """Returns the line count, and the amplitudes of the harmonics of the error within a line.

    They are computed from the signals, because the imperfections multiply each other: with an unequal gain,
    the harmonic of an offset of a tenth changes by 4 %.
    """
    result = {"lines_per_turn": float(secret.parameters["lines_per_turn"])}
    signals = secret.load.get("encoder", {}).get("signals")
    if signals:
        phase = math.tau * np.arange(FINE) / FINE
        third = signals.get("third_harmonic", 0.0)
        shifted = phase + math.radians(signals.get("phase_mismatch_deg", 0.0))
        sine = (1.0 + signals.get("gain_mismatch", 0.0)) * np.sin(phase) - third * np.sin(3.0 * phase)
        cosine = np.cos(shifted) + third * np.cos(3.0 * phase)
        read = cosine + signals.get("cosine_offset", 0.0) + 1j * (sine + signals.get("sine_offset", 0.0))
        error = np.angle(read * np.exp(-1j * phase)) * ARCSEC_PER_RAD / float(signals["lines_per_turn"])
        waves = np.abs(np.fft.rfft(error)) * 2.0 / FINE
        result |= {f"order_{order}_amplitude_arcsec": float(waves[order]) for order in (1, 2, 4)}
    return result


def _zero_drift(secret: Secret) -> Values:
    """Returns the drift per kelvin of the temperature channel, and the time constant if the plant has one."""
    result = {"drift_arcsec_per_k": float(secret.parameters["arcsec_per_k"])}
    tau_s = secret.truth.get("temperature", {}).get("zero_time_constant_s")
    return result | ({"tau_s": float(tau_s)} if tau_s else {})


def _amplitude_drift(secret: Secret) -> Values:
    """Returns the growth of ripple and friction, per cent/K at the plant's reference temperature."""
    warmth = secret.truth.get("temperature", {})
    growths = {
        "ripple_percent_per_k": warmth.get("tooth_growth_per_k", secret.parameters.get("growth_per_k")),
        "friction_percent_per_k": warmth.get("friction_growth_per_k"),
    }
    return {name: 100.0 * float(growth) for name, growth in growths.items() if growth}


def _wear(secret: Secret) -> Values:
    """Returns the growth of the lost motion between the two directions, with the sign of a lag: -2 times the
    growth in one direction.

    A finding without an exponent grows linearly with the travel r, but the plant grows as r^p. The true value
    is therefore the slope of the best straight-line fit to r^p over uniformly distributed travel, which is 6
    p / ((p + 1) (p + 2)) times the mean growth.
    """
    known = secret.parameters
    if "exponent" in secret.found:
        growth = -2.0 * float(known["arcsec_per_1000_turns"])
        return {"growth_arcsec_per_kiloturn": growth, "exponent": float(known["exponent"])}
    power, end = float(known.get("exponent", 1.0)), float(known["end_arcsec"])
    kiloturns = (end / float(known["arcsec_per_1000_turns"])) ** (1.0 / power)
    slope = 6.0 * power / ((power + 1.0) * (power + 2.0))
    return {"growth_arcsec_per_kiloturn": -2.0 * end / kiloturns * slope}


def _count_loss(secret: Secret) -> Values:
    """Returns the step of the finding that is nearest in time."""
    known = secret.parameters
    times = {name: value for name, value in secret.found.items() if name.endswith("_time_s")}
    nearest = min(times, key=lambda name: abs(times[name] - known["time_s"]), default="step_1_time_s")
    sizes = nearest.replace("_time_s", "_size_arcsec")
    return {nearest: float(known["time_s"]), sizes: float(known["step_arcsec"])}


def _local_defect(secret: Secret) -> Values:
    known = secret.parameters
    return {
        "centre_deg": float(known["at_deg"]),
        "half_width_deg": 0.5 * float(known["width_deg"]),
        "height_arcsec": float(known["height_arcsec"]),
    }


def _named(**names: str) -> Callable[[Secret], Values]:
    """Converts parameters that differ only in name; keywords are finding's name = secret's name."""
    return lambda secret: {
        mine: float(secret.parameters[theirs])
        for mine, theirs in names.items()
        if theirs in secret.parameters
    }


def _scaled(factor: float, **names: str) -> Callable[[Secret], Values]:
    plain = _named(**names)
    return lambda secret: {name: factor * value for name, value in plain(secret).items()}


TRUE: Mapping[str, Callable[[Secret], Values]] = {
    "motor_order": _motor_orders,
    "motor_encoder_eccentricity": _motor_orders,
    "flexspline_order": _flexspline,
    "load_order": _load_orders,
    # Both values are half of the angle between the two flanks; the forward flank leads.
    "direction_phase": _named(shift_deg="shift_deg"),
    "torque_modulation": _scaled(100.0, growth_percent_per_nm="growth_per_nm"),
    "compliance": _compliance,
    "inertial_windup": _inertial,
    "velocity_windup": _velocity,
    # The secret states the age of the load's sample, the finding the delay at which it is taken.
    "channel_skew": _scaled(-1.0, delay_ms="delay_ms"),
    "backlash": _named(gap_arcsec="gap_arcsec"),
    "hysteresis_parameters": _loop,
    "hysteresis_memory": _loop_height,
    "rate_dependence": lambda secret: {
        **_scaled(100.0, growth_percent="growth_per_decade")(secret),
        **_named(reference_deg_s="from_deg_s")(secret),
    },
    "subdivisional_error": _interpolation,
    "zero_drift": _zero_drift,
    "amplitude_drift": _amplitude_drift,
    "wear": _wear,
    "ratio_error": _named(ramp_arcsec_per_turn="arcsec_per_motor_turn"),
    "count_loss": _count_loss,
    # The amplitude is left out: the secret has the amplitude of the load on its spring, but while the motor
    # rests, the vibration also drives the hysteresis loop, by more than that amplitude.
    "vibration": _named(frequency_hz="frequency_hz"),
    "local_defect": _local_defect,
}
"""Expected parameters by cause, without `creep`: its finding is a sum of exponentials on a fixed grid of time
constants, not the plant's elements.
"""


def true_parameters(cause: str, found: Data, hidden: Data, truth: Data, model: Data) -> Values:
    """Returns the values that a finding of this cause should report; empty if the cause is absent."""
    known = {each["cause"]: each["parameters"] for each in hidden["hidden"]}
    parameters = known.get(cause) or known.get(TWINS.get(cause, ""))
    if parameters is None and truth and cause in ALWAYS_THERE and cause in hidden["also"]:
        parameters = {}
    if parameters is None or cause not in TRUE:
        return {}
    return TRUE[cause](Secret(parameters, found, truth, model))
