"""Catalogue of causes: one cause of transmission error per file, looked up by name."""

from hdbridge.axis.effects.amplitude_drift import AmplitudeDrift
from hdbridge.axis.effects.backlash import Backlash
from hdbridge.axis.effects.base import Effect, missing_channels
from hdbridge.axis.effects.carried import BASIC, USUAL_LOOP, Loop, is_ripple, ripple
from hdbridge.axis.effects.channel_skew import ChannelSkew
from hdbridge.axis.effects.combine import compensable, conflicts, extended, fall_bound, in_place, refreshed
from hdbridge.axis.effects.compliance import Compliance
from hdbridge.axis.effects.count_loss import CountLoss, Step
from hdbridge.axis.effects.creep import Creep, Relaxation
from hdbridge.axis.effects.described import (
    Cause,
    Compensable,
    Experiment,
    Moves,
    Observations,
    Part,
    Shape,
    Sought,
    Sum,
    Tracker,
)
from hdbridge.axis.effects.direction_phase import DirectionPhase
from hdbridge.axis.effects.flexspline_order import FlexsplineOrders
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.hysteresis_memory import HysteresisMemory
from hdbridge.axis.effects.hysteresis_parameters import HysteresisParameters
from hdbridge.axis.effects.inertial_windup import InertialWindup
from hdbridge.axis.effects.kinematics import Observer, moments
from hdbridge.axis.effects.load_order import LoadOrders
from hdbridge.axis.effects.local_defect import LocalDefect
from hdbridge.axis.effects.motion import (
    MEASURED,
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    Moment,
    Motion,
    Start,
    readings,
)
from hdbridge.axis.effects.motor_encoder_eccentricity import MotorEncoderEccentricity
from hdbridge.axis.effects.motor_order import MotorOrders
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.effects.rate_dependence import RateDependence
from hdbridge.axis.effects.ratio_error import RatioError
from hdbridge.axis.effects.subdivisional_error import SubdivisionalError
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.effects.torque import TorqueGrowth
from hdbridge.axis.effects.torque_modulation import TorqueModulation
from hdbridge.axis.effects.velocity_windup import VelocityWindup
from hdbridge.axis.effects.vibration import Vibration
from hdbridge.axis.effects.wear import Wear
from hdbridge.axis.effects.zero_drift import ZeroDrift
from hdbridge.errors import InputError

_KINDS: tuple[type[Effect], ...] = (
    Synchronous, Hysteresis, MotorOrders, MotorEncoderEccentricity, LoadOrders, FlexsplineOrders,
    DirectionPhase, TorqueModulation, Compliance, InertialWindup, VelocityWindup, ChannelSkew, Backlash,
    HysteresisMemory, HysteresisParameters, RateDependence, SubdivisionalError, ZeroDrift,
    AmplitudeDrift, Wear, Creep, RatioError, CountLoss, Vibration, LocalDefect,
)  # fmt: skip
CATALOGUE = {each.name: each for each in _KINDS}
"""All effects by canonical name."""


def causes() -> tuple[str, ...]:
    """Returns the names of the causes that a diagnosis can find, all except the two basic model parts."""
    return tuple(name for name in CATALOGUE if name not in BASIC)


def register(kind: type[Effect]) -> type[Effect]:
    """Adds a kind of effect to the catalogue of this process; usable as a decorator for custom effects.

    Model files may then contain the effect, fits and compensation use it, and a diagnosis can find it. Raises
    `InputError` if a different kind already has this name.
    """
    if CATALOGUE.get(kind.name, kind) is not kind:
        raise InputError(
            f"an effect '{kind.name}' is in the catalogue already ({CATALOGUE[kind.name].__module__}); "
            "give yours another name"
        )
    CATALOGUE[kind.name] = kind
    return kind


def withdraw(kind: type[Effect]) -> None:
    """Removes a kind of effect from the catalogue."""
    CATALOGUE.pop(kind.name, None)


def aliases_of(name: str) -> tuple[str, ...]:
    """Returns the causes that either cause declares as an alias of the other, in catalogue order."""
    own = CATALOGUE[name].about.aliases if name in CATALOGUE else ()
    return tuple(other for other, kind in CATALOGUE.items() if other in own or name in kind.about.aliases)


__all__ = [
    "CATALOGUE", "MEASURED", "USUAL_LOOP", "AmplitudeDrift", "Backlash", "BoolArray", "Cause",
    "Channel", "ChannelSkew", "Compensable", "Compliance", "CountLoss", "Creep", "DirectionPhase",
    "Effect", "Experiment", "FlexsplineOrders", "FloatArray", "Hysteresis", "HysteresisMemory",
    "HysteresisParameters", "InertialWindup", "IntArray", "LoadOrders", "LocalDefect", "Loop", "Moment",
    "Motion", "MotorEncoderEccentricity", "MotorOrder", "MotorOrders", "Moves", "Observations",
    "Observer", "Part", "RateDependence", "RatioError", "Relaxation", "Shape", "Sought", "Start",
    "Step", "SubdivisionalError", "Sum", "Synchronous", "TorqueGrowth", "TorqueModulation", "Tracker",
    "VelocityWindup", "Vibration", "Wear", "ZeroDrift", "aliases_of", "causes", "compensable",
    "conflicts", "extended", "fall_bound", "in_place", "is_ripple", "missing_channels", "moments",
    "readings", "refreshed", "register", "ripple", "withdraw",
]  # fmt: skip
