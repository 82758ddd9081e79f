"""The partial_residual of a finding: the residual without it, over the coordinate that its cause depends on.

Everything else that was found stays in the model, so what is seen is this finding alone, with the noise.
A cause that scales what the model has (ripple that grows with torque, a loop that grows with speed) is seen
as a scale over that coordinate, by least squares in each bin.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.diagnose.residual_views import BoolArray, Coordinate, Spacing, coordinates
from hdbridge.diagnose.result import Diagnosis, Finding, Traces
from hdbridge.effects import (
    AmplitudeDrift,
    Channel,
    Effect,
    FloatArray,
    Hysteresis,
    HysteresisMemory,
    HysteresisParameters,
    MotorOrder,
    MotorOrders,
    RateDependence,
    SubdivisionalError,
    TorqueModulation,
    Vibration,
    Wear,
    loop_of,
)
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

HOMES: Final[Mapping[str, str]] = {
    "motor_order": "motor angle",
    "motor_encoder_eccentricity": "motor angle",
    "direction_phase": "motor angle",
    "load_order": "load angle",
    "local_defect": "load angle",
    "ratio_error": "position",
    "compliance": "load torque",
    "inertial_windup": "acceleration",
    "velocity_windup": "speed",
    "channel_skew": "speed",
    "backlash": "motor angle since the last reversal",
    "hysteresis_parameters": "motor angle since the last reversal",
    "hysteresis_memory": "motor angle since the last reversal",
    "creep": "time since the last stop or start",
    "zero_drift": "time",
    "count_loss": "time",
}
"""The coordinate that a cause depends on; those that are not here have one of their own."""
LEAST_RESTING: Final = 200
"""Points at rest that a relaxation is looked at on; with fewer, all points."""
SEEN_BINS: Final = 20
_ORDER: Final = re.compile(r"order_(\d+)_amplitude_arcsec")


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """How strongly a part of the model has to be scaled, bin by bin; arrays of one length."""

    of: str
    """What is scaled, in words."""
    place: FloatArray
    measured_percent: FloatArray
    spread_percent: FloatArray
    """Standard deviation of the measured, noise taken for white."""
    finding_percent: FloatArray
    """The same by the finding."""


@dataclass(frozen=True, slots=True, eq=False)
class PartialResidual:
    """A finding over its coordinate; arrays of shape (m,), like those of `Traces`."""

    coordinate: Coordinate
    residual_arcsec: FloatArray
    """Measurement less the model with everything but this finding."""
    own_arcsec: FloatArray | None
    """What the finding does; None where it has no law."""
    rows: BoolArray
    """The points that show it."""
    forward: BoolArray
    """Direction, held at rest."""
    strength: Strength | None = None


def partial_residual(finding: Finding, diagnosis: Diagnosis) -> PartialResidual:
    """Draw one finding of a diagnosis."""
    traces = diagnosis.traces
    effect = _in_model(finding, diagnosis.model)
    own = None if effect is None else _does(effect, traces)
    left = traces.measured_arcsec - traces.extended_arcsec
    home = _home(finding, traces, diagnosis.model.ratio)
    rows = np.ones(len(left), dtype=np.bool_)
    resting = traces.speed_deg_s == 0.0
    if finding.cause == "creep" and np.count_nonzero(resting) >= LEAST_RESTING:
        rows = resting
    residual = left if own is None else left + own
    forward = traces.direction > 0.0
    strength = _strength(effect, traces, home, residual, own)
    return PartialResidual(home, residual, own, rows, forward, strength)


def _in_model(finding: Finding, model: TransmissionModel) -> Effect | None:
    """The finding's effect as the extended model has it, so that picture and model are of one fit."""
    effect = effect_of(finding)
    if isinstance(effect, HysteresisParameters):
        now = loop_of(model.effects)
        return effect.model_copy(update=now.model_dump(exclude={"memory"}))
    return next((each for each in model.effects if type(each) is type(effect)), effect)


def _does(effect: Effect, traces: Traces) -> FloatArray:
    """What an effect does at the points of the traces, arcsec, shape (m,)."""
    does = traces.told(effect)
    if isinstance(effect, HysteresisMemory):  # it stands in the place of the law without memory
        does = does - traces.told(Hysteresis(**effect.parameters()))
    return does


def effect_of(finding: Finding) -> Effect | None:
    """The finding's effect; that of a change of orders from the parameters that it names."""
    if finding.effect is not None:
        return finding.effect
    numbers = [int(found[1]) for name in finding.parameters if (found := _ORDER.fullmatch(name))]
    if not numbers:
        return None
    orders = tuple(
        MotorOrder.model_construct(
            order=number,
            amplitude_arcsec=finding.parameters[f"order_{number}_amplitude_arcsec"].value,
            phase_deg=finding.parameters[f"order_{number}_phase_deg"].value,
        )
        for number in numbers
    )
    return MotorOrders.model_construct(orders=orders)


def _home(finding: Finding, traces: Traces, ratio: float) -> Coordinate:
    known = coordinates(traces, ratio)
    effect = finding.effect
    made = _own_coordinate(effect, traces, ratio)
    if made is not None:
        return made
    if effect is None and finding.lives_in:
        name = finding.lives_in.removesuffix(" and direction")
        if name in known:
            apart = known[name].both_ways and ("direction" in finding.lives_in or "reversal" in name)
            return replace(known[name], both_ways=apart)
    name = HOMES.get(finding.cause, "time")
    if isinstance(effect, AmplitudeDrift):
        name = "temperature"
    elif name == "load torque":
        name = Channel(getattr(effect, "torque", "load_torque_nm")).title
    home = known.get(name) or known["time"]
    return home if name != "load angle" else replace(home, bins=120)


def _own_coordinate(effect: Effect | None, traces: Traces, ratio: float) -> Coordinate | None:
    """Of a cause that depends on none of the usual ones."""
    motion, rows = traces.motion, traces.rows
    if isinstance(effect, SubdivisionalError):
        division = DEG_PER_TURN / effect.lines_per_turn
        load = motion.load_deg[rows] if motion.load_deg is not None else traces.motor_deg / ratio
        within = np.mod(load, division) * ARCSEC_PER_DEG
        return Coordinate(
            f"load angle within a division of {division * ARCSEC_PER_DEG:.4g} arcsec",
            "arcsec",
            within,
            bins=48,
        )
    if isinstance(effect, Vibration):
        period = 1.0 / effect.frequency_hz
        name = f"time within a period of {1e3 * period:.4g} ms"
        return Coordinate(name, "ms", 1e3 * np.mod(traces.time_s, period), bins=48)
    if isinstance(effect, Wear):
        run = np.cumsum(np.abs(np.diff(motion.motor_deg, prepend=motion.motor_deg[:1]))) / DEG_PER_TURN
        return Coordinate("motor turns run", "", run[rows], both_ways=True, bins=SEEN_BINS)
    if isinstance(effect, RateDependence):
        return Coordinate(
            "speed, forward or backward", "motor deg/s", np.abs(traces.speed_deg_s), False, Spacing.FILLED
        )
    if isinstance(effect, TorqueModulation):
        channel = Channel(effect.torque)
        torque, name = motion.channel(channel, effect.name)[rows], channel.title
        values = torque if effect.signed else np.abs(torque)
        return Coordinate(
            name if effect.signed else f"{name}, either direction", "Nm", values, False, Spacing.FILLED
        )
    if effect is not None and effect.name == "flexspline_order":
        angle = traces.motor_deg * (1.0 + 1.0 / ratio)
        return Coordinate("angle of the wave generator to the flexspline", "deg", np.mod(angle, DEG_PER_TURN))
    return None


def _strength(
    effect: Effect | None, traces: Traces, home: Coordinate, residual: FloatArray, own: FloatArray | None
) -> Strength | None:
    scaled = _scaled(effect, traces)
    if scaled is None or own is None:
        return None
    words, part = scaled
    coarse = replace(home, bins=SEEN_BINS)
    number = coarse.numbers()
    square = np.bincount(number, part**2)
    size = float(np.sqrt(np.mean(part**2)))
    kept = square > 50.0 * (0.1 * size) ** 2  # bins in which the part is there at all
    noise = float(np.std(residual - own))

    def percent(y: FloatArray) -> FloatArray:
        return np.asarray(100.0 * np.bincount(number, y * part, len(square))[kept] / square[kept])

    place = np.bincount(number, coarse.values, len(square))[kept] / np.bincount(number)[kept]
    return Strength(words, place, percent(residual), 100.0 * noise / np.sqrt(square[kept]), percent(own))


def _scaled(effect: Effect | None, traces: Traces) -> tuple[str, FloatArray] | None:
    """The part of the model that a cause scales, in words and in arcsec."""
    if isinstance(effect, TorqueModulation):
        return "ripple", traces.told(MotorOrders(orders=effect.orders))
    if isinstance(effect, RateDependence):
        return "elastic loop", traces.told(effect.loop.law())
    if isinstance(effect, AmplitudeDrift):
        ripple = traces.told(MotorOrders(orders=effect.orders))
        loop = traces.told(effect.loop.law())
        by_ripple = abs(effect.ripple_percent_per_k) * float(np.std(ripple))
        by_loop = abs(effect.friction_percent_per_k) * float(np.std(loop))
        return ("ripple", ripple) if by_ripple >= by_loop else ("elastic loop", loop)
    return None
