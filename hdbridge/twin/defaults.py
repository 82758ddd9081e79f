"""Default plant from the axis file alone: the twin before any measurement.

Each value that is not in the axis file is a usual one for servo axes of this kind, in proportion to the
values in it. These are the start values of a fit, and remain unless a measurement contradicts them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from hdbridge.axis import AxisConfig
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.encoder import TrueCoupling
from hdbridge.sim.truth.motor import TrueNotch
from hdbridge.twin.parameters import Parameter, with_load_encoder, with_values


@dataclass(frozen=True, slots=True)
class Usual:
    """An assumed value, with its unit and source."""

    value: float
    unit: str
    source: str


TORQUE_PER_INERTIA: Final = Usual(
    10_000.0, "rad/s^2", "small brushless servo motors: rated torque accelerates the bare rotor at about 1e4"
)
INERTIA_RATIO: Final = Usual(3.0, "", "load over motor inertia seen by the motor; the article's bench has 3")
RESONANCE_HZ: Final = Usual(
    40.0, "Hz", "load on the gear's spring: 15 to 80 Hz for arms on strain wave gears"
)
DAMPING_RATIO: Final = Usual(0.2, "", "of that resonance: material and grease; the article's bench has 0.2")
COULOMB_SHARE: Final = Usual(
    0.1, "of the rated torque", "no-load running torque of strain wave gears at the motor: 5 to 15 %"
)
VISCOUS_SHARE: Final = Usual(
    0.2, "of the rated torque at 3000 rpm", "grease of strain wave gears at 20 deg C"
)
RATED_SPEED_RAD_S: Final = Usual(3000.0 * math.tau / 60.0, "rad/s", "rated speed of small servo motors")
STRIBECK_RAD_S: Final = Usual(
    5.0, "rad/s", "bearings and teeth in grease: a film carries from some tens of turns a minute on"
)
COUPLING_HZ: Final = Usual(
    1000.0, "Hz", "an encoder whose coupling is not known: stiffer than a recording shows"
)
COUPLING_DAMPING: Final = Usual(
    0.1, "", "metal bellows couplings: 0.05 to 0.2 with the bearings of the encoder"
)
NOTCH_HZ: Final = Usual(100.0, "Hz", "a notch on the resonance of motor and load: 40 to 200 Hz")
SHORTEST_FILTER_MS: Final = Usual(0.02, "ms", "a filter that is as good as none: a tenth of a short substep")
BRAKE_SHARE: Final = Usual(
    3.0, "of the rated torque", "holding brakes are built for more than the motor gives"
)
POSITION_GAIN_PER_S: Final = Usual(200.0, "1/s", "stiff position loop of a direct sine/cosine feedback drive")
VELOCITY_BANDWIDTH_RAD_S: Final = Usual(1000.0, "rad/s", "velocity loop on the motor's own inertia: 160 Hz")
INTEGRAL_TIME_MS: Final = Usual(15.0, "ms", "some three times the period of the velocity loop's bandwidth")
COMMAND_FILTER_MS: Final = Usual(1.0, "ms", "drives interpolate the demand between SYNCs by a short filter")
FRICTION_TOLD: Final = Usual(
    0.8, "of the friction", "as much as is fed forward without overshoot at reversals"
)
TORQUE_LIMIT_PERCENT: Final = Usual(300.0, "%", "peak over rated torque of small servo motors")
NOISE_COUNTS: Final = Usual(0.3, "counts rms", "an encoder's noise is below its count as a rule")
SUBSTEP_MS: Final = 0.5


def default_truth(axis: AxisConfig) -> Truth:
    """Returns the simulated drive for an axis file: no transmission error, usual mechanics."""
    ratio, rated_nm = axis.gear.ratio, axis.drive.rated_torque_nm
    inertia = rated_nm / TORQUE_PER_INERTIA.value
    load_inertia = INERTIA_RATIO.value * inertia * ratio**2
    turn = math.tau * RESONANCE_HZ.value
    coulomb = COULOMB_SHARE.value * rated_nm
    viscous = VISCOUS_SHARE.value * rated_nm / RATED_SPEED_RAD_S.value
    data: dict[str, Any] = {
        "schema": "hdbridge.truth/1",
        "name": axis.name,
        "provenance": {"values": "usual"},
        "substep_ms": SUBSTEP_MS,
        "motor": {
            "inertia_kg_m2": inertia,
            "rated_torque_nm": rated_nm,
            "coulomb_nm": coulomb,
            "viscous_nm_s_per_rad": viscous,
            "brake_nm": BRAKE_SHARE.value * rated_nm,
            "encoder": _encoder(axis.motor_encoder),
        },
        "servo": {
            "position_gain_per_s": POSITION_GAIN_PER_S.value,
            "velocity_gain_nm_s_per_rad": inertia * VELOCITY_BANDWIDTH_RAD_S.value,
            "integral_time_ms": INTEGRAL_TIME_MS.value,
            "command_filter_ms": COMMAND_FILTER_MS.value,
            "inertia_feedforward_kg_m2": inertia,
            "load_feedforward": {
                "inertia_kg_m2": load_inertia / ratio**2,
                "frequency_hz": RESONANCE_HZ.value,
                "damping_ratio": DAMPING_RATIO.value,
            },
            "viscous_feedforward_nm_s_per_rad": viscous,
            "friction_feedforward_nm": FRICTION_TOLD.value * coulomb,
            "torque_limit_percent": max(TORQUE_LIMIT_PERCENT.value, axis.limits.torque_percent),
        },
        "gear": {
            "ratio": ratio,
            "stiffness_nm_per_rad": load_inertia * turn**2,
            "damping_nm_s_per_rad": 2.0 * DAMPING_RATIO.value * load_inertia * turn,
        },
        "load": {
            "inertia_kg_m2": load_inertia,
            "encoder": _encoder(axis.load_encoder)
            | {"noise_arcsec": NOISE_COUNTS.value * axis.load_encoder.resolution_arcsec},
        },
    }
    if axis.gear.teeth is not None:
        data["gear"]["teeth"] = getattr(axis.gear.teeth, axis.gear.teeth.output)
    return Truth.model_validate(data)


def with_sections(truth: Truth, parameters: Iterable[Parameter]) -> Truth:
    """Returns the truth with the sections of these parameters added, without effect where possible."""
    wanted = {section for each in parameters for section in each.path}
    if truth.motor.stribeck is None and "stribeck" in wanted:
        truth = with_values(truth, {"friction's rise at rest": 0.0, "Stribeck speed": STRIBECK_RAD_S.value})
    if truth.load_.encoder.coupling is None and "coupling" in wanted:
        rigid = TrueCoupling(frequency_hz=COUPLING_HZ.value, damping_ratio=COUPLING_DAMPING.value)
        truth = with_load_encoder(truth, coupling=rigid)
    servo: dict[str, Any] = {}
    if truth.servo.notch is None and "notch" in wanted:
        servo["notch"] = TrueNotch(frequency_hz=NOTCH_HZ.value, depth=1.0, width=1.0)
    for name in ("speed_filter_ms", "torque_filter_ms"):
        if name in wanted and not getattr(truth.servo, name):
            servo[name] = SHORTEST_FILTER_MS.value
    return truth.model_copy(update={"servo": truth.servo.model_copy(update=servo)}) if servo else truth


def _encoder(encoder: Any) -> dict[str, Any]:
    return {"counts_per_turn": max(4, encoder.counts_per_turn), "direction": encoder.direction}
