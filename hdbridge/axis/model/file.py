"""Model file: schema, reading with located errors, and writing."""

import math
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from hdbridge.axis import Identity, Teeth
from hdbridge.axis.effects import CATALOGUE, Effect, conflicts
from hdbridge.axis.model.response import Response
from hdbridge.files.expectation import nearest
from hdbridge.files.yamlfile import Document, Hex, Line, dump_yaml
from hdbridge.strictness import Strict

_HEADER = "# The transmission model of an axis, written by hdbridge. docs/files.md describes its keys.\n"


class GearOfModel(Strict):
    """Gear on which a model was measured."""

    ratio: float = Field(gt=0, le=1000, description="N: motor turns per load turn")
    teeth: Teeth | None = Field(None, description="numbers of teeth")


class Provenance(Strict):
    """Origin and binding of a model; unknown keys are preserved."""

    model_config = ConfigDict(extra="allow")

    axis: str | None = Field(None, description="name of the axis")
    drive: Identity | None = Field(None, description="identity of the drive")
    gear: GearOfModel | None = Field(None, description="gear")
    date: str | None = Field(None, description="date, ISO 8601")
    reason: str | None = Field(None, description="reason")


class EffectEntry(Strict):
    """One effect of the model file."""

    effect: str = Field(description="name in the catalogue")
    parameters: dict[str, Any] = Field(description="its parameters, with the unit in the name")
    uncertainty: dict[str, Any] = Field(default_factory=dict, description="half widths of the 95 % intervals")


class ModelFile(BaseModel):
    """Content of a model file. The parameters of an effect are validated by the effect itself."""

    schema_: Literal["hdbridge.model/1"] = Field(
        alias="schema", description="schema and version of this file"
    )
    ratio: float = Field(gt=0, le=1000, description="N: motor turns per load turn")
    effects: tuple[EffectEntry, ...] = Field(description="effects, whose sum is the transmission error")
    provenance: Provenance | None = Field(None, description="origin of the numbers")
    response: Response | None = Field(None, description="response of the axis to the correction in motion")


def effects_of(document: Document, file: ModelFile) -> tuple[tuple[Effect, ...], dict[str, dict[str, Any]]]:
    """Returns the effects of a model file, and their uncertainties by name.

    Raises `InputError` with file:line:column and the nearest valid name.
    """
    effects: list[Effect] = []
    uncertainty: dict[str, dict[str, Any]] = {}
    for number, entry in enumerate(file.effects):
        effect = _effect(document, number, entry, [each.name for each in effects])
        effects.append(effect)
        if entry.uncertainty:
            uncertainty[effect.name] = entry.uncertainty
    for conflict in conflicts(effects, file.ratio):
        raise document.error(("effects",), conflict)
    return tuple(effects), uncertainty


def text_of(document: Mapping[str, Any]) -> str:
    """Returns the text of a model file, from which the same model is read."""
    data = dict(document)
    if "provenance" in data:
        data["provenance"] = hexadecimal(data["provenance"])
    if "response" in data:
        data["response"] = _in_lines(data["response"])
    return _HEADER + dump_yaml(data)


def _effect(document: Document, number: int, entry: EffectEntry, before: list[str]) -> Effect:
    at = ("effects", number)
    kind = CATALOGUE.get(entry.effect)
    if kind is None:
        close = nearest(entry.effect, list(CATALOGUE))
        hint = f"; did you mean '{close}'?" if close else ""
        raise document.error(
            (*at, "effect"),
            f"no effect is called '{entry.effect}'; expected one of {', '.join(CATALOGUE)}{hint}",
        )
    if entry.effect in before:
        raise document.error((*at, "effect"), f"'{entry.effect}' appears twice; expected each effect once")
    for name, value in entry.uncertainty.items():
        where = (*at, "uncertainty", name)
        if name not in kind.model_fields:
            close = nearest(name, list(kind.model_fields))
            hint = f"did you mean '{close}'?" if close else f"expected {', '.join(kind.model_fields)}"
            raise document.error(where, f"unknown parameter of {kind.name}; {hint}", key=True)
        if isinstance(value, int | float) and not (value >= 0 and math.isfinite(value)):
            raise document.error(where, f"found {value}; expected a half width of at least 0")
    return document.validate(kind, (*at, "parameters"))


def hexadecimal(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the provenance with the drive's identity in hexadecimal notation, as in data sheets."""
    data = dict(provenance)
    if isinstance(data.get("drive"), Mapping):
        data["drive"] = {
            name: Hex(value) if isinstance(value, int) else value for name, value in data["drive"].items()
        }
    return data


def _in_lines(data: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the data, marked such that each list is written on one line."""
    return {
        name: Line(value)
        if isinstance(value, list)
        else _in_lines(value)
        if isinstance(value, Mapping)
        else value
        for name, value in data.items()
    }
