"""Transmission model: a gear ratio and a sum of effects, and its file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, Motion, Start, Sum, Tracker
from hdbridge.axis.model.binding import binding, check_binding
from hdbridge.axis.model.file import ModelFile, effects_of, text_of
from hdbridge.axis.model.response import Response
from hdbridge.errors import InputError
from hdbridge.files.profile import no_model
from hdbridge.files.yamlfile import Document, document_from_text, read_yaml, write_atomically


@dataclass(frozen=True)
class TransmissionModel:
    """Transmission error theta_L - theta_M / N as a sum of effects, arcsec at the load.

    The model does not contain the elastic state of the gear. The initial state (`Start`) is passed to
    `predict` and `tracker`, because it depends on the move before the record or the run, not on the gear.
    """

    ratio: float
    """N: motor turns per load turn, positive."""
    effects: tuple[Effect, ...] = ()
    uncertainty: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Half width of the 95 % interval by effect name and parameter name, in the parameter's unit."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Origin of the numbers: recording, date, versions, drive identity (`Provenance`)."""
    response: Response | None = None
    """Response of the axis to the correction in motion; None if it has not been measured."""
    path: Path | None = field(default=None, compare=False)
    """File from which the model was read, if any."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the transmission error at each sample of a motion, arcsec, shape (n,)."""
        total = np.zeros(len(motion))
        for effect in self.effects:
            total += effect.predict(motion, start)
        return total

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """Returns a new on-line tracker of the sum of all effects."""
        return Sum([effect.tracker(start) for effect in self.effects])

    def only(self, names: Iterable[str]) -> Self:
        """Returns the model with only the named effects; unknown names are ignored.

        A law that replaces another one by definition is also selected by the name of the replaced law.
        """
        wanted = set(names)
        kept = (each for each in self.effects if each.name in wanted or each.replaces in wanted)
        return replace(self, effects=tuple(kept))

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a model file; raises `InputError` with file:line:column and the nearest valid name."""
        if not Path(path).exists():
            raise no_model(Path(path))
        return cls._from_document(read_yaml(path))

    @classmethod
    def from_text(cls, text: str, path: Path | str = "model.yaml") -> Self:
        """Reads a model file from its text; ``path`` is used in messages."""
        return cls._from_document(document_from_text(text, path))

    @classmethod
    def _from_document(cls, document: Document) -> Self:
        file = document.validate(ModelFile)
        provenance = document.data.get("provenance") or {}
        return cls(file.ratio, *effects_of(document, file), provenance, file.response, document.path)

    @classmethod
    def from_document(cls, data: Mapping[str, Any], path: Path | None = None) -> Self:
        """Creates a model from the result of `document`, fast enough for the control loop.

        Raises `KeyError` or `ValueError` for any other data.
        """
        entries = data["effects"]
        return cls(
            float(data["ratio"]),
            tuple(CATALOGUE[each["effect"]].model_validate(each["parameters"]) for each in entries),
            {each["effect"]: each["uncertainty"] for each in entries if "uncertainty" in each},
            data.get("provenance", {}),
            Response.model_validate(data["response"]) if "response" in data else None,
            path,
        )

    def document(self) -> dict[str, Any]:
        """Returns the content of the model file as plain data that can be converted to JSON."""
        entries = [
            {"effect": each.name, "parameters": each.parameters()}
            | ({"uncertainty": dict(known)} if (known := self.uncertainty.get(each.name)) else {})
            for each in self.effects
        ]
        data: dict[str, Any] = {"schema": "hdbridge.model/1", "ratio": self.ratio, "effects": entries}
        if self.provenance:
            data["provenance"] = dict(self.provenance)
        if self.response is not None:
            data["response"] = self.response.model_dump(mode="json")
        return data

    def dump(self) -> str:
        """Returns the text of the model file, from which the same model is read."""
        return text_of(self.document())

    def save(self, path: Path | str) -> None:
        """Writes the model file atomically."""
        write_atomically(path, self.dump())

    @property
    def held_out_arcsec(self) -> float | None:
        """Rms residual on held-out data, from the provenance; None if it is not positive or unknown."""
        held_out = self.provenance.get("held_out")
        value = held_out.get("after_arcsec") if isinstance(held_out, dict) else None
        if not isinstance(value, int | float) or not 0.0 < value < math.inf:
            return None
        return float(value)

    def with_provenance(self, **provenance: Any) -> Self:
        """Returns the model with these entries added to its provenance."""
        return replace(self, provenance={**self.provenance, **provenance})

    def bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> Self:
        """Returns the model bound to an axis and a drive identity, by default that of the axis file."""
        return replace(self, provenance={**self.provenance, **binding(axis, identity)})

    def check_ratio(self, axis: AxisConfig) -> None:
        """Raises `InputError` if the gear ratio of the model differs from that of the axis file."""
        if not math.isclose(self.ratio, axis.gear.ratio, rel_tol=1e-9):
            raise InputError(
                f"{self._name()}: ratio: this model is of a gear with ratio {self.ratio:g}, but "
                f"{axis.path} says {axis.gear.ratio:g}; use the model of this gear, or calibrate it"
            )

    def check_bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> None:
        """Raises `InputError` if the model belongs to another drive, axis or gear; see `check_binding`."""
        self.check_ratio(axis)
        check_binding(self.provenance, axis, identity, self._name(), "model", "calibrate it")

    def _name(self) -> str:
        return str(self.path) if self.path else "this model"
