"""Compensation setting of an axis, as sent by the service to the control process."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation
from hdbridge.enums import Scheme
from hdbridge.errors import InputError


@dataclass(frozen=True, slots=True)
class CompensationSetting:
    """Model of an axis, the part of it that compensates, and the state of the load loop."""

    model: TransmissionModel
    scheme: Scheme
    version: int | None = None
    """Number of the model in the profile's history; None if it is not in the history."""
    file: Path | None = None
    """File of the model; None if it was not read from a file."""
    load_loop: bool = False
    """True if the load loop is on."""
    adapted: TransmissionModel | None = None
    """Model with adapted parameters; None without adaptation."""

    @property
    def compensating(self) -> TransmissionModel:
        """Compensating model: the adapted parameters with the effects of the scheme."""
        return self.scheme.of(self.adapted or self.model)

    def compensation(self, axis: AxisConfig) -> Compensation:
        """Returns the inverse model for the control loop; if the scheme is `NONE`, that of the whole model.

        Raises InputError if the model does not fit the axis.
        """
        whole = self.adapted or self.model
        return compensation_for(axis, whole if self.scheme is Scheme.NONE else self.scheme.of(whole))

    def to_json(self) -> bytes:
        """Returns the setting as JSON, which `from_json` restores exactly."""
        return json.dumps(
            {
                "model": self.model.document(),
                "scheme": self.scheme.value,
                "version": self.version,
                "file": str(self.file) if self.file is not None else None,
                "load_loop": self.load_loop,
                "adapted": self.adapted.document() if self.adapted is not None else None,
            },
            default=str,
        ).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Self:
        """Restores a setting from `to_json`; raises InputError for anything else."""
        try:
            given = json.loads(data)
            file = None if given["file"] is None else Path(given["file"])
            adapted = given["adapted"]
            return cls(
                model=TransmissionModel.from_document(given["model"], file),
                scheme=Scheme(given["scheme"]),
                version=given["version"],
                file=file,
                load_loop=given["load_loop"],
                adapted=None if adapted is None else TransmissionModel.from_document(adapted, file),
            )
        except (ValueError, TypeError, KeyError, RecursionError) as problem:
            raise InputError(f"the compensation setting cannot be read: {problem}") from problem
