"""From an axis file and a model to a truth file: each effect to the simulated plant's own physics.

A model says how the load errs; the plant has parts that make it err. One row per effect of the catalogue
says which part that is (`TABLE`), and a translation says of each effect of a model what became of it: in
full, in part, or that the plant has no counterpart. All of the transmission error comes from the model; all
else (motor, loops, friction, load, spring where the model is silent) from the truth that is given, else from
usual values (`hdbridge.twin.defaults`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pydantic import ValidationError

from hdbridge.axis import AxisConfig
from hdbridge.effects import CATALOGUE, Effect
from hdbridge.errors import InputError
from hdbridge.model import TransmissionModel
from hdbridge.sim.truth import Truth
from hdbridge.twin import encoder_effects, gear_effects, slow_effects, spring_effects
from hdbridge.twin.defaults import default_truth
from hdbridge.twin.draft import Draft, Said, none

OF_GEAR: Final = (
    "motor_orders", "flexspline_orders", "load_orders", "hysteresis", "second_hysteresis", "flank", "jumps",
    "torque_growth_per_nm", "backlash_arcsec", "rate_dependence", "wear", "ageing", "creep", "damage",
    "roller", "seat",
)  # fmt: skip
"""What the section `gear` says of transmission error: with a model, the model says it."""
OF_ENCODERS: Final = ("disc", "late_ms", "losses", "signals", "cable", "sensor_warming")
OF_TEMPERATURE: Final = (
    "zero_drift_arcsec_per_k", "zero_time_constant_s", "reference_c", "tooth_growth_per_k",
    "friction_growth_per_k",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """What became of one effect."""

    effect: str
    counterpart: str | None
    """Places in the truth file, dotted; None where the plant has no counterpart."""
    note: str
    """What is different there, or why there is none; empty where nothing is lost."""


@dataclass(frozen=True, slots=True)
class Translation:
    """A truth file and how it came about."""

    truth: Truth
    rows: tuple[Row, ...]
    """One per effect of the model, in the order of the catalogue; last what the catalogue does not have."""


class Entry(NamedTuple):
    """One row of the table."""

    counterpart: str
    """Places in the truth file."""
    write: Callable[[Any, Draft], Said]
    """Puts an effect of this kind into a draft, and says what is different there."""


TABLE: Final[Mapping[str, Entry]] = MappingProxyType(
    {
        # In the order in which they are put in: the spring first, because torques are told by it.
        "ratio_error": Entry("gear.ratio", gear_effects.ratio_error),
        "compliance": Entry("gear.stiffness_nm_per_rad, gear.stiffening", spring_effects.compliance),
        "inertial_windup": Entry(
            "gear.stiffness_nm_per_rad or load.inertia_kg_m2", spring_effects.inertial_windup
        ),
        "velocity_windup": Entry(
            "load.viscous_nm_s_per_rad, load.thinning, gear.creep", spring_effects.velocity_windup
        ),
        "synchronous": Entry("gear.motor_orders", gear_effects.motor_orders),
        "motor_order": Entry("gear.motor_orders", gear_effects.motor_orders),
        "flexspline_order": Entry("gear.flexspline_orders", gear_effects.flexspline_orders),
        "load_order": Entry("gear.load_orders or load.encoder.disc", encoder_effects.load_orders),
        "motor_encoder_eccentricity": Entry("motor.encoder.disc", encoder_effects.motor_eccentricity),
        "direction_phase": Entry("gear.flank", gear_effects.direction_phase),
        "torque_modulation": Entry("gear.torque_growth_per_nm", gear_effects.torque_modulation),
        "hysteresis": Entry("gear.hysteresis or load.presliding", spring_effects.hysteresis),
        "hysteresis_memory": Entry("gear.hysteresis or load.presliding", spring_effects.hysteresis_memory),
        "hysteresis_parameters": Entry("gear.hysteresis", spring_effects.hysteresis_parameters),
        "backlash": Entry("gear.backlash_arcsec, load.coulomb_nm", spring_effects.backlash),
        "rate_dependence": Entry("gear.rate_dependence", spring_effects.rate_dependence),
        "channel_skew": Entry("motor.encoder.late_ms or load.encoder.late_ms", encoder_effects.channel_skew),
        "subdivisional_error": Entry("load.encoder.signals", encoder_effects.subdivisional_error),
        "count_loss": Entry("load.encoder.losses", encoder_effects.count_loss),
        "zero_drift": Entry("temperature.zero_drift_arcsec_per_k", slow_effects.zero_drift),
        "amplitude_drift": Entry(
            "temperature.tooth_growth_per_k, temperature.friction_growth_per_k", slow_effects.amplitude_drift
        ),
        "wear": Entry("gear.wear", slow_effects.wear),
        "creep": Entry("gear.creep", slow_effects.creep),
        "local_defect": Entry("gear.damage", gear_effects.local_defect),
        "vibration": Entry("load.vibration", spring_effects.vibration),
    }
)
"""One row per effect of the catalogue."""
UNKNOWN: Final = none("the simulated drive has no part for an effect that is not of hdbridge's own catalogue")
"""Of an effect that somebody has registered."""


def translate(
    axis: AxisConfig, model: TransmissionModel | None = None, base: Truth | None = None
) -> Translation:
    """The simulated drive that errs as the model says, on the axis of the axis file.

    ``base`` says what the model does not speak of; without it usual values do. Without a model its
    transmission error stays as it is. InputError where the model is of another gear ratio, or where the
    plant cannot have what it says.
    """
    truth = _of_axis(axis, base) if base is not None else default_truth(axis)
    if model is None:
        return Translation(truth, ())
    model.check_ratio(axis)
    draft = Draft(_without_error(truth, axis), axis, tells_servo=base is None)
    by_name = {each.name: each for each in model.effects}
    said = {
        name: entry.write(by_name[name], draft)
        for name, entry in TABLE.items()
        if by_name.get(name) is not None
    }
    draft.finish()
    order = [name for name in (*CATALOGUE, *by_name) if name in by_name]
    rows = tuple(_row(by_name[name], said.get(name, UNKNOWN)) for name in dict.fromkeys(order))
    return Translation(_validated(draft.data), rows)


def _row(effect: Effect, said: Said) -> Row:
    return Row(effect.name, said.counterpart, "; ".join(said.notes))


def _validated(data: dict[str, Any]) -> Truth:
    try:
        return Truth.model_validate(data)
    except ValidationError as problem:
        first = problem.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(
            f"the model asks the simulated drive for what it cannot be: {place}: {first['msg']}; look at the "
            "effect of the model that says so"
        ) from None


def _of_axis(axis: AxisConfig, base: Truth) -> Truth:
    """The same plant with encoders and rated torque of the axis file; of its origin ``values`` is left."""
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
    """The truth file's content without any transmission error that a model speaks of."""
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
