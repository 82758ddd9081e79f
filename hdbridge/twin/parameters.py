"""Parameters of the simulated drive that a fit may change, and their usual values.

Each parameter has a path in the truth file. Positive parameters are fitted by their logarithm, so half and
double the value are equally distant; delays and parameters that may be zero are fitted directly.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from hdbridge.axis import AxisConfig
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.encoder import TrueCoupling
from hdbridge.sim.truth.resonance import Resonance

# ----------------------------------------------------------------
# Parameters of the simulated drive that a fit may change.

RESOLVED = 0.98
"""Maximum phase advance of the fastest resonance per time step, in radians; a truth file may have up to 1."""
FOLLOWING, TORQUE, LOAD = "following error", "motor torque", "load error"
"""Channels in which a replay is compared with a recording."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the plant that a fit may change."""

    name: str
    path: str
    """Dotted keys of the truth file."""
    unit: str
    least: float
    most: float
    """Upper bound of the value in a fit."""
    spread: float
    """Prior standard deviation about the start: of the natural logarithm, or in ``unit`` if `linear`."""
    least_change: float
    """Smallest relevant change, in the unit of `spread`; smaller changes are not reported."""
    cause: str
    """Reported cause if the parameter has changed; several parameters may share a cause."""
    move: str
    """Motion that separates the parameter from parameters with similar effects."""
    linear: bool = False

    def coordinate(self, value: float) -> float:
        """Returns the fit's coordinate of a value."""
        return value if self.linear else math.log(value)

    def value(self, coordinate: float) -> float:
        """Returns the value at a coordinate, clipped to its bounds."""
        value = coordinate if self.linear else math.exp(min(coordinate, 700.0))
        return min(max(value, self.least), self.most)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds as coordinates."""
        return self.coordinate(self.least), self.coordinate(self.most)


_STEPS = "steps at the axis's full acceleration, the load left to ring after each"
_SPEEDS = "motion at constant speed, at three speeds at least"
_REVERSALS = "slow reversals"
_SINES = "sines of several frequencies up to the bandwidth of the loops"
_WARM = "the same motion cold and warm, with the temperature recorded"
_FULL = "an acceleration at which the drive reaches its torque limit"
_LOOPS = "slow sines of several amplitudes, some smaller than the width"

FRICTION: Final = "friction"
SERVO: Final = "servo gains"
INERTIA_FEEDFORWARD: Final = "inertia feed-forward"
FRICTION_FEEDFORWARD: Final = "friction feed-forward"
ELASTIC: Final = "elastic loop"

PARAMETERS: Final[tuple[Parameter, ...]] = (
    Parameter("motor inertia", "motor.inertia_kg_m2", "kg m2", 1e-9, 10.0, 0.7, 0.1, "motor inertia", _STEPS),
    Parameter("Coulomb friction", "motor.coulomb_nm", "Nm", 1e-6, 1e3, 0.7, 0.15, FRICTION, _REVERSALS),
    Parameter("viscous friction", "motor.viscous_nm_s_per_rad", "Nm s/rad", 1e-9, 100.0, 0.7, 0.25, FRICTION,
        _SPEEDS),
    Parameter("friction's rise at rest", "motor.stribeck.rise", "", 0.0, 10.0, 0.3, 0.1, FRICTION, _REVERSALS,
        linear=True),
    Parameter("Stribeck speed", "motor.stribeck.speed_rad_s", "rad/s", 0.01, 1e3, 0.7, 0.5, FRICTION,
        _SPEEDS),
    Parameter("friction growth", "temperature.friction_growth_per_k", "1/K", -0.1, 0.1, 0.01, 0.005, FRICTION,
        _WARM, linear=True),
    Parameter("load inertia", "load.inertia_kg_m2", "kg m2", 1e-7, 1e5, 0.7, 0.1, "load inertia", _STEPS),
    Parameter("gear stiffness", "gear.stiffness_nm_per_rad", "Nm/rad", 1.0, 1e9, 0.7, 0.1, "gear stiffness",
        _STEPS),
    Parameter("gear damping", "gear.damping_nm_s_per_rad", "Nm s/rad", 1e-6, 1e6, 0.7, 0.4, "gear damping",
        _STEPS),
    Parameter("position gain", "servo.position_gain_per_s", "1/s", 1.0, 5e3, 0.7, 0.15, SERVO, _SINES),
    Parameter("velocity gain", "servo.velocity_gain_nm_s_per_rad", "Nm s/rad", 1e-6, 1e3, 0.7, 0.15, SERVO,
        _SINES),
    Parameter("integral time", "servo.integral_time_ms", "ms", 0.1, 1e4, 0.7, 0.25, SERVO, _REVERSALS),
    Parameter("command filter", "servo.command_filter_ms", "ms", 0.05, 100.0, 0.7, 0.3, "command filter",
        _SINES),
    Parameter("moving average", "servo.moving_average_ms", "ms", 0.0, 7.0, 2.0, 0.5, "command filter", _SINES,
        linear=True),
    Parameter("speed filter", "servo.speed_filter_ms", "ms", 0.02, 20.0, 0.7, 0.4, SERVO, _SINES),
    Parameter("torque filter", "servo.torque_filter_ms", "ms", 0.02, 20.0, 0.7, 0.4, SERVO, _SINES),
    Parameter("notch frequency", "servo.notch.frequency_hz", "Hz", 5.0, 800.0, 0.3, 0.1, SERVO, _STEPS),
    Parameter("notch depth", "servo.notch.depth", "", 0.0, 1.0, 0.3, 0.2, SERVO, _STEPS, linear=True),
    Parameter("notch width", "servo.notch.width", "", 0.05, 5.0, 0.7, 0.4, SERVO, _STEPS),
    Parameter("observer frequency", "servo.observer.frequency_hz", "Hz", 1.0, 300.0, 0.7, 0.3, SERVO,
        _REVERSALS),
    Parameter("observer share", "servo.observer.share", "", 0.0, 1.0, 0.3, 0.2, SERVO, _REVERSALS,
        linear=True),
    Parameter("observer inertia", "servo.observer.inertia_kg_m2", "kg m2", 1e-9, 10.0, 0.7, 0.3, SERVO,
        _STEPS),
    Parameter("velocity feed-forward", "servo.velocity_feedforward", "", 0.0, 1.5, 0.1, 0.03,
        "velocity feed-forward", _SPEEDS, linear=True),
    Parameter("inertia feed-forward", "servo.inertia_feedforward_kg_m2", "kg m2", 1e-9, 10.0, 0.7, 0.2,
        INERTIA_FEEDFORWARD, _STEPS),
    Parameter("load feed-forward", "servo.load_feedforward.inertia_kg_m2", "kg m2", 1e-9, 10.0, 0.7, 0.2,
        INERTIA_FEEDFORWARD, _STEPS),
    Parameter("load feed-forward frequency", "servo.load_feedforward.frequency_hz", "Hz", 1.0, 500.0, 0.7,
        0.2, INERTIA_FEEDFORWARD, _STEPS),
    Parameter("viscous feed-forward", "servo.viscous_feedforward_nm_s_per_rad", "Nm s/rad", 1e-9, 100.0, 0.7,
        0.5, FRICTION_FEEDFORWARD, _SPEEDS),
    Parameter("friction feed-forward", "servo.friction_feedforward_nm", "Nm", 1e-6, 1e3, 0.7, 0.2,
        FRICTION_FEEDFORWARD, _REVERSALS),
    Parameter("servo dead time", "servo.dead_time_ms", "ms", 0.0, 20.0, 2.0, 0.3, "servo dead time", _SINES,
        linear=True),
    Parameter("load encoder delay", "load.encoder.late_ms", "ms", 0.0, 20.0, 2.0, 0.3, "load encoder delay",
        _SPEEDS, linear=True),
    Parameter("encoder coupling", "load.encoder.coupling.frequency_hz", "Hz", 10.0, 5e3, 0.7, 0.2,
        "encoder coupling", _STEPS),
    Parameter("motor encoder delay", "motor.encoder.late_ms", "ms", 0.0, 20.0, 2.0, 0.3,
        "motor encoder delay", _SPEEDS, linear=True),
    Parameter("current limit", "servo.torque_limit_percent", "%", 1.0, 1e3, 0.7, 0.05, "current limit",
        _FULL),
    Parameter("loop offset", "gear.hysteresis.offset_arcsec", "arcsec", 0.01, 3.6e4, 0.3, 0.05, ELASTIC,
        _LOOPS),
    Parameter("loop width", "gear.hysteresis.width_deg", "deg", 0.01, 3.6e3, 0.7, 0.15, ELASTIC, _LOOPS),
    Parameter("loop yield", "gear.hysteresis.yield_deg", "deg", 0.01, 3.6e3, 0.7, 0.15, ELASTIC, _LOOPS),
    Parameter("loop exponent", "gear.hysteresis.exponent", "", 1.0, 5.0, 0.5, 0.2, ELASTIC, _LOOPS),
    Parameter("loop reaction", "gear.hysteresis_reaction", "", 0.0, 1.0, 0.5, 0.2, "loop reaction", _STEPS,
        linear=True),
    Parameter("load friction", "load.coulomb_nm", "Nm", 0.0, 1e4, 5.0, 0.5, "load friction", _REVERSALS,
        linear=True),
    Parameter("temperature", "temperature.ambient_c", "\N{DEGREE SIGN}C", -60.0, 100.0, 15.0, 3.0, "warmth",
        "the same motion with the temperature recorded", linear=True),
)  # fmt: skip
"""All parameters, in the order of a fit."""

BY_NAME: Final[Mapping[str, Parameter]] = {each.name: each for each in PARAMETERS}


def by_cause(parameters: Iterable[Parameter]) -> dict[str, tuple[Parameter, ...]]:
    """Groups parameters by their cause."""
    groups: dict[str, tuple[Parameter, ...]] = {}
    for each in parameters:
        groups[each.cause] = (*groups.get(each.cause, ()), each)
    return groups


def named(*names: str) -> tuple[Parameter, ...]:
    """Returns the parameters of these names."""
    return tuple(BY_NAME[name] for name in names)


def value_in(truth: Truth, parameter: Parameter) -> float | None:
    """Returns a parameter's value in a truth; None if its section is missing or the law lacks it."""
    place: Any = truth
    for key in parameter.path.split("."):
        place = getattr(place, "load_" if key == "load" else key, None)
        if place is None:
            return None
    return float(place)


def free_value(truth: Truth, parameter: Parameter) -> float:
    """Returns the value of a parameter that must exist."""
    value = value_in(truth, parameter)
    assert value is not None, parameter.name
    return value


def with_values(truth: Truth, values: Mapping[str, float]) -> Truth:
    """Returns the truth with these values by parameter name, validated like a file."""
    return Truth.model_validate(_with(truth, values))


def with_load_encoder(truth: Truth, **fields: Any) -> Truth:
    """Returns the truth with these fields of the load encoder, which may be whole sections; unchecked."""
    encoder = truth.load_.encoder.model_copy(update=fields)
    return truth.model_copy(update={"load_": truth.load_.model_copy(update={"encoder": encoder})})


def _with(truth: Truth, values: Mapping[str, float]) -> dict[str, Any]:
    """Returns the content of the truth with these values."""
    data = truth.model_dump(by_alias=True, exclude_none=True)
    for name, value in values.items():
        *sections, key = BY_NAME[name].path.split(".")
        place = data
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = value
    return data


def coordinates(truth: Truth, parameters: Iterable[Parameter]) -> list[float]:
    """Returns the coordinates of a truth; values beyond a bound are set to the bound."""
    found = []
    for each in parameters:
        value = free_value(truth, each)
        found.append(each.coordinate(min(max(value, each.least), each.most)))
    return found


def at_coordinates(truth: Truth, parameters: Sequence[Parameter], place: Sequence[float]) -> Truth:
    """Returns the truth at these coordinates, with a spring no stiffer than its time step resolves.

    A fit may try a stiffer spring, because a recording hardly shows resonances of hundreds of hertz.
    """
    data = _with(truth, {each.name: each.value(float(x)) for each, x in zip(parameters, place, strict=True)})
    gear = data["gear"]
    later = gear.get("stiffening") or {}
    springs = [(gear, "stiffness_nm_per_rad"), *((later, key) for key in later if "stiffness" in key)]
    fastest = Resonance.of(data)
    share = fastest.stiffest_nm_per_rad(RESOLVED / truth.substep_s) / fastest.stiffness_nm_per_rad
    if 0.0 < share < 1.0:
        for section, key in springs:
            section[key] *= share
    return Truth.model_validate(data)


# ----------------------------------------------------------------
# Default plant from the axis file alone: the twin before any measurement.


TORQUE_PER_INERTIA: Final = 10_000.0
"""Acceleration of the bare rotor of a small brushless servo motor at its rated torque, rad/s^2."""
INERTIA_RATIO: Final = 3.0
"""Load inertia, seen by the motor, over motor inertia; the article's bench has 3."""
RESONANCE_HZ: Final = 40.0
"""Resonance of the load on the gear's spring: 15 to 80 Hz for arms on strain wave gears."""
DAMPING_RATIO: Final = 0.2
"""Damping ratio of the load on the gear's spring: material and grease; the article's bench has 0.2."""
COULOMB_SHARE: Final = 0.1
"""No-load running torque of strain wave gears at the motor, as a fraction of the rated torque: 5 to 15 %."""
VISCOUS_SHARE: Final = 0.2
"""Viscous friction of the grease in strain wave gears at 20 deg C and 3000 rpm, as a fraction of the rated
torque."""
RATED_SPEED_RAD_S: Final = 3000.0 * math.tau / 60.0
"""Rated speed of small servo motors."""
STRIBECK_RAD_S: Final = 5.0
"""Stribeck speed of bearings and teeth in grease: the film forms at some tens of revolutions per minute."""
COUPLING_HZ: Final = 1000.0
"""Assumed resonance of an encoder whose coupling is unknown; too high to be visible in a recording."""
COUPLING_DAMPING: Final = 0.1
"""Damping ratio of metal bellows couplings: 0.05 to 0.2 with the bearings of the encoder."""
NOTCH_HZ: Final = 100.0
"""Frequency of a notch on the resonance of motor and load: 40 to 200 Hz."""
OBSERVER_HZ: Final = 50.0
"""Bandwidth of disturbance observers: one to three velocity loops, 20 to 150 Hz."""
SHORTEST_FILTER_MS: Final = 0.02
"""Time constant of a negligible filter: a tenth of a short substep."""
BRAKE_SHARE: Final = 3.0
"""Torque of a holding brake, as a multiple of the rated torque."""
POSITION_GAIN_PER_S: Final = 200.0
"""Position gain of a stiff loop with direct sine/cosine feedback."""
VELOCITY_BANDWIDTH_RAD_S: Final = 1000.0
"""Bandwidth of the velocity loop on the motor's own inertia: 160 Hz."""
INTEGRAL_TIME_MS: Final = 15.0
"""Integral time: two to three periods of the velocity loop's bandwidth."""
COMMAND_FILTER_MS: Final = 1.0
"""Time constant of the short filter with which drives interpolate the demand between SYNCs."""
FRICTION_FEEDFORWARD_SHARE: Final = 0.8
"""Friction feed-forward as a fraction of the friction; small enough to avoid overshoot at reversals."""
TORQUE_LIMIT_PERCENT: Final = 300.0
"""Peak torque of small servo motors, in per cent of the rated torque."""
NOISE_COUNTS: Final = 0.3
"""Rms noise of an encoder in counts, usually below one."""
SUBSTEP_MS: Final = 0.5


def default_truth(axis: AxisConfig) -> Truth:
    """Returns the simulated drive for an axis file: no transmission error, usual mechanics."""
    ratio, rated_nm = axis.gear.ratio, axis.drive.rated_torque_nm
    inertia = rated_nm / TORQUE_PER_INERTIA
    load_inertia = INERTIA_RATIO * inertia * ratio**2
    turn = math.tau * RESONANCE_HZ
    coulomb = COULOMB_SHARE * rated_nm
    viscous = VISCOUS_SHARE * rated_nm / RATED_SPEED_RAD_S
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
            "brake_nm": BRAKE_SHARE * rated_nm,
            "encoder": _encoder(axis.motor_encoder),
        },
        "servo": {
            "position_gain_per_s": POSITION_GAIN_PER_S,
            "velocity_gain_nm_s_per_rad": inertia * VELOCITY_BANDWIDTH_RAD_S,
            "integral_time_ms": INTEGRAL_TIME_MS,
            "command_filter_ms": COMMAND_FILTER_MS,
            "inertia_feedforward_kg_m2": inertia,
            "load_feedforward": {
                "inertia_kg_m2": load_inertia / ratio**2,
                "frequency_hz": RESONANCE_HZ,
                "damping_ratio": DAMPING_RATIO,
            },
            "viscous_feedforward_nm_s_per_rad": viscous,
            "friction_feedforward_nm": FRICTION_FEEDFORWARD_SHARE * coulomb,
            "torque_limit_percent": max(TORQUE_LIMIT_PERCENT, axis.limits.torque_percent),
        },
        "gear": {
            "ratio": ratio,
            "stiffness_nm_per_rad": load_inertia * turn**2,
            "damping_nm_s_per_rad": 2.0 * DAMPING_RATIO * load_inertia * turn,
        },
        "load": {
            "inertia_kg_m2": load_inertia,
            "encoder": _encoder(axis.load_encoder)
            | {"noise_arcsec": NOISE_COUNTS * axis.load_encoder.resolution_arcsec},
        },
    }
    if axis.gear.teeth is not None:
        data["gear"]["teeth"] = getattr(axis.gear.teeth, axis.gear.teeth.output)
    return Truth.model_validate(data)


def with_sections(truth: Truth, parameters: Iterable[Parameter]) -> Truth:
    """Returns the truth with the sections of these parameters added, without effect where possible."""
    names = {each.name for each in parameters}
    if truth.load_.encoder.coupling is None and "encoder coupling" in names:
        rigid = TrueCoupling(frequency_hz=COUPLING_HZ, damping_ratio=COUPLING_DAMPING)
        truth = with_load_encoder(truth, coupling=rigid)
    inertia_kg_m2, values = truth.motor.inertia_kg_m2, dict[str, float]()
    for section, added in (
        (truth.motor.stribeck, {"friction's rise at rest": 0.0, "Stribeck speed": STRIBECK_RAD_S}),
        (truth.servo.notch, {"notch frequency": NOTCH_HZ, "notch depth": 1.0, "notch width": 1.0}),
        (
            truth.servo.observer,
            {"observer frequency": OBSERVER_HZ, "observer share": 0.0, "observer inertia": inertia_kg_m2},
        ),
        (truth.servo.speed_filter_ms, {"speed filter": SHORTEST_FILTER_MS}),
        (truth.servo.torque_filter_ms, {"torque filter": SHORTEST_FILTER_MS}),
    ):
        if not section and names & {*added}:
            values |= added
    return with_values(truth, values) if values else truth


def _encoder(encoder: Any) -> dict[str, Any]:
    return {"counts_per_turn": max(4, encoder.counts_per_turn), "direction": encoder.direction}
